"""The command `echelon analyse`: computes, without a run, whether a formation settles, and what it tolerates."""

import shlex
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal

from echelon.cli.options import Command, option
from echelon.cli.shared import JSON, ScenarioOptions
from echelon.errors import UsageError

if TYPE_CHECKING:
    from echelon.plan.plan import Plan
    from echelon.scenario.law_tables import Law
    from echelon.sim.results.analysis import AnalysisResult

LONG_S: Final = 2.0
"""Progress is shown for what takes longer than this"""


@dataclass(frozen=True, slots=True, kw_only=True)
class AnalyseOptions(ScenarioOptions):
    """Options of `echelon analyse`."""

    members: bool = field(default=False, metadata=option("also what the links of each robot and each group tolerate"))
    policies: bool = field(
        default=False, metadata=option("also what hold, zero, extrapolate and predict buy on each channel")
    )
    figures: Path | None = field(
        default=None, metadata=option("write each figure as a file into this folder, beside the text", "DIR")
    )
    format: tuple[Literal["svg", "pdf", "png"], ...] = field(
        default=(), metadata=option("format of the files of --figures; may be repeated (default: svg)")
    )
    runs: int = field(
        default=64,
        metadata=option("runs of the batch engine for each number that can only be estimated; 0: leave them out", "N"),
    )
    json: bool = field(default=False, metadata=JSON)


def analyse(options: AnalyseOptions) -> int:
    """Computes whether the formation settles and what it tolerates.

    Returns exit code 1 if it does not settle, or if the torque loop of a robot diverges."""
    from echelon.cli.analyse_text import lines_of
    from echelon.cli.scenario_file import read_scenario
    from echelon.sim.forecast.analysing import analysis_of, told_of
    from echelon.sim.forecast.motion import asked_of, torque_loop_warnings
    from echelon.sim.results.rendering import json_text

    if options.format and options.figures is None:
        raise UsageError(f"--format {options.format[0]}: needs --figures DIR, which writes the figures as files")
    scenario, plan = read_scenario(options.scenario, options.overrides)
    asked = asked_of(plan)
    law, progress = scenario.law, _Progress()
    try:
        with told_of(options.scenario):
            found = analysis_of(
                plan,
                law.time_scales,
                law.epsilon,
                asked,
                members=options.members,
                policies=options.policies,
                runs=options.runs,
                say=progress.say,
            )
    finally:
        progress.end()
    written = [] if options.figures is None else _save_figures(options, found, plan, law, progress)
    if options.json:
        print(json_text(found))
    else:
        print("\n".join(lines_of(found, torque_loop_warnings(plan, asked))))
        print(*written, sep="\n", end="\n" if written else "")
    return 0 if found.settles and not found.torque_loop_diverges else 1


def _save_figures(
    options: AnalyseOptions, found: "AnalysisResult", plan: "Plan", law: "Law", progress: "_Progress"
) -> list[Path]:
    """Writes the figures; returns their files.  Raises UsageError if that fails."""
    from echelon.sim.forecast.analysing import scaled_delays
    from echelon.sim.forecast.own_links import calm
    from echelon.sim.report.analysis_figures import analysis_figures

    words = ["echelon", "analyse", options.scenario, *(word for each in options.overrides for word in ("--set", each))]
    try:
        scaled = (
            scaled_delays(calm(plan)[0], law.time_scales, law.epsilon, progress.say)
            if any(one.delay.seconds for one in found.table)
            else ()
        )
    finally:
        progress.end()
    assert options.figures is not None
    pictures = analysis_figures(found, scaled, shlex.join(words))
    written = []
    try:
        options.figures.mkdir(parents=True, exist_ok=True)
        for name, picture in pictures.items():
            for kind in options.format or ("svg",):
                written.append(options.figures / f"{name}.{kind}")
                picture.save(written[-1])
    except OSError as error:
        raise UsageError(f"{error.filename or options.figures}: {error.strerror}") from None
    return written


class _Progress:
    """A line about what is being computed, on a terminal, if it takes long."""

    def __init__(self) -> None:
        self._since = time.monotonic()
        self._shown = False

    def say(self, what: str, done: int, of: int) -> None:
        """Shows what is being computed."""
        if sys.stderr.isatty() and time.monotonic() - self._since > LONG_S:
            self._shown = True
            print(f"\r\x1b[K{what}: {done} of {of}", end="", file=sys.stderr, flush=True)

    def end(self) -> None:
        """Removes the line."""
        if self._shown:
            print("\r\x1b[K", end="", file=sys.stderr, flush=True)
            self._shown = False


ANALYSE: Final = Command(
    name="analyse",
    options=AnalyseOptions,
    work=analyse,
    about="""\
Computes whether the formation settles with the periods and links of the scenario, how each block's
error decays, what that costs, and what links tolerate: a table of layers and channels with the
largest delay and loss and what limits them.  Further how large ε and couplings may be, exactly and
by Lyapunov bounds, and whether the torque loops inside the robots are stable.  It assumes that
robots follow the desired accelerations exactly.  What cannot be computed exactly, as for delays
that vary on several links, is estimated by runs without limits and called so.  Laws that are not
linear are refused: run such scenarios instead.""",
    examples={
        "echelon analyse paper": "states may be up to 6.8 ms late",
        "echelon analyse lab --set 'links=[{channel=\"state\",delay=0.3}]'": "with a delay",
        "echelon analyse lab --policies --members": "also what other policies buy, and what each robot's links tolerate",
        "echelon analyse lab --figures figures --format pdf": "also figures, as PDF",
        "echelon analyse lab --json": "for scripts (`echelon schema analysis` describes it)",
    },
    codes={0: "it settles", 1: "it does not settle, or a torque loop diverges"},
)
