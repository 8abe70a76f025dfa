"""Functions for notebooks and scripts, such as `load`, `run` and `analyse`; their options are named as on the command line."""

import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal, NamedTuple

import tomlkit

from echelon.errors import UserError
from echelon.plan.plan import Plan
from echelon.planning.loading import effective_toml
from echelon.scenario.tables import Scenario
from echelon.scenario.toml_text import toml_value
from echelon.shipped import EFFECTIVE, scenario_path
from echelon.sim import run_folder
from echelon.sim.finished_run import Run
from echelon.sim.launch import Launch, launch
from echelon.sim.parts import loading as parts
from echelon.sim.processes.ends_at import EndsAt

if TYPE_CHECKING:
    from echelon.sim.replay.difference import RunDifference
    from echelon.sim.replay.replay import Replay
    from echelon.sim.results.analysis import AnalysisResult
    from echelon.sim.sweep.origin import Origin
    from echelon.sim.sweep.study import Sweep


_CHOICE: Final = re.compile(r"(?<![\w-])--(clock|engine) (virtual|wall|inprocess|processes)\b")
"""An option with one of its values"""
_OPTION: Final = re.compile(r"(?<![\w-])--(set (?=\S)|[a-z]+(?:-[a-z]+)*)")
_AS_ARGUMENT: Final = {
    "set ": "",
    "replace": "replace=True",
    "keep-going": "keep_going=True",
    "real-bus": "real_bus=True",
}


@contextmanager
def _arguments_for_options() -> Iterator[None]:
    """A context in which the text of a UserError names the arguments of Python's functions, not the command's options: `out`
    instead of `--out`, and a change alone instead of `--set` with a change."""
    try:
        yield
    except UserError as error:
        lines = (_CHOICE.sub(r'\1="\2"', line) for line in error.lines)
        lines = (_OPTION.sub(lambda one: _AS_ARGUMENT.get(one[1], one[1].replace("-", "_")), line) for line in lines)
        raise type(error)(*lines) from error.__cause__


class Loaded(NamedTuple):
    """A scenario with all its defaults, and its plan."""

    scenario: Scenario
    plan: Plan


AnyScenario = str | Path | Mapping[str, Any] | Loaded
"""A scenario: the name of a shipped one, the path of a TOML file or of a run's folder, a dictionary with the tables, or the
result of `load`"""


@_arguments_for_options()
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
        return Loaded(*parts.parse(_toml(scenario), "scenario", overrides))
    return Loaded(*parts.load(scenario_path(str(scenario)), overrides))


def _toml(tables: Mapping[str, Any]) -> str:
    return "".join(f"{tomlkit.key(str(key)).as_string()} = {toml_value(item)}\n" for key, item in tables.items())


@_arguments_for_options()
def run(
    scenario: AnyScenario,
    changes: Mapping[str, Any] | None = None,
    *,
    engine: Literal["processes", "inprocess"] = "processes",
    clock: Literal["virtual", "wall"] = "virtual",
    out: str | Path | None = None,
    can: str | None = None,
    real_bus: bool = False,
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
    real_bus    let a run in virtual time, or one that mirrors torques, send frames onto a bus of hardware
    replace     delete the run of another scenario that is in `out`
    report      write report.html
    quiet       show no progress on standard error
    keep_going  go on when a robot has diverged, instead of stopping there

    A run that broke off, or whose verdict is FAILS, is returned as well: see its `failure` and `verdict`.  Raises UserError for
    a wrong scenario and for options that contradict each other, and OSError if a file cannot be written."""
    loaded = load(scenario, changes)
    options = Launch(
        engine=engine,
        clock=clock,
        out=None if out is None else Path(out),
        can=can,
        real_bus=real_bus,
        report=report,
        quiet=quiet,
        ends_at=EndsAt.NOWHERE if keep_going else EndsAt.DIVERGED,
        replace=replace,
    )
    return launch(loaded.scenario, loaded.plan, options)


@_arguments_for_options()
def sweep(
    scenario: AnyScenario,
    changes: Mapping[str, Any] | None = None,
    *,
    vary: Mapping[str, Any] | None = None,
    design: Literal["grid", "zip", "random", "sobol"] = "grid",
    samples: int = 0,
    find: Mapping[str, str] | None = None,
    share: float = 0.9,
    seeds: int | None = None,
    engine: Literal["batch", "gpu", "inprocess", "processes"] | None = None,
    workers: int | str | None = None,
    out: str | Path | None = None,
    allow_unstable: bool = False,
    quiet: bool = False,
) -> "Sweep":
    """Runs a scenario many times with values that vary: `sweep("lab", vary={"law.lead": "0:1:0.1"}, seeds=20).to_pandas()`.

    `scenario` and `changes` are those of `load`; the other options are those of `echelon sweep` (docs/sweep.md):

    vary            by key a list of values, or a range `"0:0.4:0.02"`
    design          `grid`, `zip`, or `random` and `sobol` with this number of `samples`
    find            the key and range of a search for the largest value that holds: `{"links.uplink.delay": "0:0.5:0.01"}`
    share           a point of the search holds if at least this share of its runs does
    seeds           number of runs at each point, with the same seeds at each
    engine          None: `batch` where it can, otherwise `inprocess`
    workers         their number, or the address of a dask scheduler; None: one for each processor
    out             folder for the tables, in which a sweep that broke off goes on; None: nothing is written
    allow_unstable  sweep though the scenario is unstable before a value is varied
    quiet           show no progress on standard error

    Raises UserError for a wrong scenario, value or option before any run begins, and OSError if a file cannot be written."""
    from echelon.sim.sweep.preparing import Request, prepare
    from echelon.sim.sweep.search import Search
    from echelon.sim.sweep.sweep import run as run_sweep
    from echelon.sim.sweep.values import vary_of
    from echelon.sim.view.sweep_progress import SweepDisplay

    request = Request(
        origin=_origin(scenario, changes),
        varied=tuple(vary_of(key, values) for key, values in (vary or {}).items()),
        kind=design,
        samples=samples,
        search=Search.of_mapping(find or {}),
        share=share,
        seeds=seeds,
        engine=engine,
        allow_unstable=allow_unstable,
    )
    prepared = prepare(request)
    with SweepDisplay(prepared.notes, quiet=quiet) as display:
        return run_sweep(prepared, None if out is None else Path(out), workers, display.show)


@_arguments_for_options()
def analyse(
    scenario: AnyScenario,
    changes: Mapping[str, Any] | None = None,
    *,
    members: bool = False,
    policies: bool = False,
    runs: int = 64,
) -> "AnalysisResult":
    """Computes without a run whether a formation settles, and what it tolerates: `analyse("lab").table`.

    `scenario` and `changes` are those of `load`; the other options and the result are those of `echelon analyse`
    (docs/analyse.md):

    members   also what the links of each robot and each group tolerate
    policies  also what each policy buys on each channel
    runs      runs of the batch engine for each number that can only be estimated; 0: leave them out

    Raises UserError for a wrong scenario or option, and for a scenario that cannot be analysed."""
    from echelon.sim.forecast.analysing import analysis_of, told_of
    from echelon.sim.forecast.motion import asked_of

    found, plan = load(scenario, changes)
    law, asked = found.law, asked_of(plan)
    with told_of(found.name):
        return analysis_of(plan, law.time_scales, law.epsilon, asked, members=members, policies=policies, runs=runs)


def open_sweep(folder: str | Path) -> "Sweep":
    """Returns the sweep in a folder.  Raises UserError if it is not the folder of a sweep, or a file of it cannot be read."""
    from echelon.sim.sweep import study

    return study.open_sweep(folder)


def _origin(scenario: AnyScenario, changes: Mapping[str, Any] | None) -> "Origin":
    """Returns the text of a scenario with its changes."""
    from echelon.sim.sweep.origin import Origin

    overrides = tuple(f"{key}={toml_value(value)}" for key, value in (changes or {}).items())
    if isinstance(scenario, Loaded):
        return Origin(effective_toml(scenario.scenario), scenario.scenario.name, Path(), overrides)
    if isinstance(scenario, Mapping):
        return Origin(_toml(scenario), "scenario", Path(), overrides)
    return Origin.of_file(scenario_path(str(scenario)), overrides)


def open_run(folder: str | Path) -> Run:
    """Returns the run in a folder.  Raises UserError if it is not the folder of a run, or a file of it cannot be read."""
    return run_folder.open_run(Path(folder))


@_arguments_for_options()
def replay(
    run: str | Path | Run,
    changes: Mapping[str, Any] | None = None,
    *,
    scenario: AnyScenario | None = None,
    only: str | Sequence[str] = (),
    tolerance: float = 0.0,
) -> "Replay":
    """Feeds the messages that a run recorded to today's roles, and compares what they say with what was recorded:
    `replay("runs/demo", {"law.epsilon": [0.05, 0.1]}, only="coordinator").first_difference`.

    `run` is the folder of a run, or a run that has one.  The roles are those of its own scenario with `changes`, or of
    another `scenario` of the same tree.  `only` names robots, nodes or groups.  Values that differ by `tolerance` at most are
    equal.  Raises UserError for what cannot be replayed."""
    from echelon.sim.recorded_runs import open_recorded
    from echelon.sim.recorded_runs import replay as replay_recorded

    folder = _folder(run)
    recorded = open_recorded(folder)
    plan = load(folder / EFFECTIVE if scenario is None else scenario, changes).plan
    return replay_recorded(recorded, plan, folder, [only] if isinstance(only, str) else only, tolerance)


def diff(first: str | Path | Run, second: str | Path | Run, *, tolerance: float = 0.0) -> "RunDifference":
    """Says where two runs part: `diff("runs/demo", "runs/again").first_difference` is the first instant, message and value.

    Takes folders of runs, or runs that have one.  Values that differ by `tolerance` at most are equal.  Raises UserError for
    what cannot be read."""
    from echelon.sim.recorded_runs import diff_runs

    return diff_runs(_folder(first), _folder(second), tolerance)


def _folder(run: str | Path | Run) -> Path:
    """Returns the folder of a run.  Raises UserError if it has none."""
    if not isinstance(run, Run):
        return Path(run)
    if run.folder is None:
        raise UserError("this run has no folder, so its messages were not recorded")
    return run.folder
