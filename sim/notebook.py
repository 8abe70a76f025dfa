"""Functions for notebooks and scripts: `load`, `run` and `open_run`, with the same names of options as the command line."""

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
    """A scenario with all its defaults, and its plan."""

    scenario: Scenario
    plan: Plan


AnyScenario = str | Path | Mapping[str, Any] | Loaded
"""A scenario: the name of a shipped one, the path of a TOML file or of a run's folder, a dictionary with the tables, or the
result of `load`"""


def load(scenario: AnyScenario, changes: Mapping[str, Any] | None = None) -> Loaded:
    """Loads a scenario and changes some of its values: `load("lab", {"law.lead": 0.0, "links.0.delay": 0.05})`.

    `changes` has values by keys, as `--set` takes them.  Raises UserError for a wrong scenario, key or value; the text says
    what is allowed."""
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
    """Runs a scenario and returns the finished run: `run("lab", {"law.lead": 0.0}, engine="inprocess")`.

    `scenario` and `changes` are those of `load`; the other options are those of `echelon run`:

    engine      `processes`: every role its own process; `inprocess`: all roles in this process
    clock       `virtual`: as fast as messages come; `wall`: in real time
    out         folder of the run; None: a new one, `runs/<scenario>-<utc time>`
    can         URLs of the CAN buses, with commas between; None: what the scenario says
    replace     delete the run of another scenario that is in `out`
    report      write report.html
    quiet       show no progress on standard error
    keep_going  go on when a robot's state is not finite, instead of stopping there

    A run that broke off, or whose verdict is FAILS, is returned as well: see its `failure` and `verdict`.  Raises UserError for
    a wrong scenario and for options that contradict each other, and OSError if a file cannot be written."""
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
    """Returns the run in a folder.  Raises UserError if it is not the folder of a run, or a file of it cannot be read."""
    return run_folder.open_run(Path(folder))


def toml_value(value: Any) -> str:
    """Returns a Python or numpy value as TOML text.  Raises UserError for a value that has no TOML type."""
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
    raise UserError(f"{value!r}: must be a number, a string, a boolean, a list or a dictionary to be set in a scenario")
