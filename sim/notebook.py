"""What a notebook or a script calls: the commands of `echelon` as functions, with the same words."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple

import tomlkit

from echelon.errors import UserError
from echelon.plan.plan import Plan
from echelon.planning.loading import effective_toml
from echelon.scenario.tables import Scenario
from echelon.shipped import scenario_path
from echelon.sim import run_folder
from echelon.sim.finished_run import Run
from echelon.sim.launch import Launch, launch
from echelon.sim.parts import loading as parts


class Loaded(NamedTuple):
    """A scenario with every default filled in, and the plan that roles are made from."""

    scenario: Scenario
    plan: Plan


AnyScenario = str | Path | Mapping[str, Any] | Loaded
"""The name of a shipped scenario, a TOML file, a run's folder, a table as a dictionary, or what `load` returned"""


def load(scenario: AnyScenario, changes: Mapping[str, Any] | None = None) -> Loaded:
    """Loads a scenario, with some of its values changed: `load("lab", {"law.lead": 0.0, "links.0.delay": 0.05})`.

    Raises UserError for a scenario, a key or a value that is wrong; the text says what is allowed."""
    overrides = [f"{key}={toml_value(value)}" for key, value in (changes or {}).items()]
    if isinstance(scenario, Loaded):
        if not overrides:
            return scenario
        return Loaded(*parts.parse(effective_toml(scenario.scenario), scenario.scenario.name, overrides))
    if isinstance(scenario, Mapping):
        return Loaded(*parts.parse(tomlkit.dumps(dict(scenario)), "scenario", overrides))
    return Loaded(*parts.load(scenario_path(str(scenario)), overrides))


def run(
    scenario: AnyScenario,
    changes: Mapping[str, Any] | None = None,
    *,
    engine: Literal["processes", "inprocess"] = "processes",
    clock: Literal["virtual", "wall"] = "virtual",
    out: str | Path | None = None,
    can: str | None = None,
    replace: bool = False,
    report: bool = False,
    quiet: bool = False,
    keep_going: bool = False,
) -> Run:
    """Runs a scenario and returns what it showed; `run("lab", {"law.lead": 0.0}, engine="inprocess")`.

    Like `echelon run`, it leaves a folder (`out`, by default `runs/<scenario>-<utc time>`), and says on standard error how it
    stands, unless `quiet`.  It stops where a robot's state is first not finite, unless it is to `keep_going`.  A run that
    broke off, or whose verdict fails, is returned too: see `failure` and `verdict`.  If `out` holds the run of another
    scenario, `replace` deletes that.  Raises UserError for what cannot be run."""
    loaded = load(scenario, changes)
    options = Launch(
        engine=engine,
        clock=clock,
        out=None if out is None else Path(out),
        can=can,
        report=report,
        quiet=quiet,
        keep_going=keep_going,
        replace=replace,
    )
    return launch(loaded.scenario, loaded.plan, options)


def open_run(folder: str | Path) -> Run:
    """Opens the folder that a run left.  Raises UserError if it is none, or cannot be read."""
    return run_folder.open_run(Path(folder))


def toml_value(value: Any) -> str:
    """Returns a Python value as TOML writes it.  Raises UserError for one that TOML does not have."""
    if hasattr(value, "tolist"):  # numpy
        value = value.tolist()
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, (int, float)):
        return repr(value)
    if isinstance(value, (str, Path)):
        return tomlkit.item(str(value)).as_string()
    if isinstance(value, (list, tuple)):
        return f"[{', '.join(map(toml_value, value))}]"
    if isinstance(value, Mapping):
        return (
            "{"
            + ", ".join(f"{tomlkit.key(str(key)).as_string()} = {toml_value(item)}" for key, item in value.items())
            + "}"
        )
    raise UserError(f"{value!r} has no place in a scenario: numbers, strings, booleans, lists and dictionaries do")
