"""What `echelon referee` does: it judges the frames on buses, or in the can.log of a run's folder."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from echelon.bridge.referee.referee import Referee, judge_log
from echelon.bridge.reports import RefereeReport
from echelon.bridge.stations.closed import LOG
from echelon.cli.frame_sources import listen, open_buses
from echelon.errors import UsageError
from echelon.plan.plan import Plan
from echelon.sim.run_state import goes_on, read_state
from echelon.sim.view.wheel_table import finding_text


class Terms(NamedTuple):
    """The terms on which the frames of a run are judged."""

    tolerance_ns: int | None
    """How late a cyclic frame may be [ns]; None: as the referee has it"""
    whole: bool
    """True if the log must go to the end of the run.  Of a run that goes on, was stopped or broke off it need not"""
    until_ns: int | None
    """Run time up to which frames are judged [ns], if the run was stopped: what its stop sends is no finding"""


def terms_of(folder: Path, plan: Plan) -> Terms:
    """Returns the terms for a run's can.log, by what its folder says: they are those of the run itself.

    On a wall clock processes may be late, so frames may be, too."""
    state = read_state(folder)
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        run, until_s = summary["run"], summary["simulated"]
    except (OSError, ValueError, KeyError, TypeError):
        run, until_s = {}, None
    clock = run.get("clock") or (state.clock if state else "")
    whole = not (run.get("failure") or run.get("stopped") or goes_on(folder))
    until_ns = round(until_s * 1e9) if until_s is not None and run.get("stopped") else None
    return Terms(plan.can.watchdog_ns // 2 if clock == "wall" else None, whole, until_ns)


def judge_run(plan: Plan, folder: Path) -> RefereeReport:
    """Returns what the referee finds in a run's can.log; of a run that goes on, in what it holds so far.

    Raises UsageError if the log cannot be read."""
    terms = terms_of(folder, plan)
    try:
        return judge_log(
            folder / LOG, plan, tolerance_ns=terms.tolerance_ns, whole=terms.whole, until_ns=terms.until_ns
        )
    except OSError as error:
        raise UsageError(f"{folder / LOG}: {error.strerror}") from None


def judge_live(
    plan: Plan, wanted: str | None, seconds: float | None, tolerance_s: float | None, quiet: bool
) -> RefereeReport:
    """Returns what the referee finds on the plan's buses, until Ctrl-C or for some seconds; `wanted` is what `--can` says.

    Unless `quiet`, the findings that the report keeps are printed as they are made.  Raises UsageError for a tolerance that is
    negative, and if a bus cannot be opened."""
    if tolerance_s is not None and not 0 <= tolerance_s < 1e9:
        raise UsageError(f"--tolerance {tolerance_s:g}: must be 0 s or more")
    judge = Referee(plan, tolerance_ns=None if tolerance_s is None else round(tolerance_s * 1e9), late=True)
    buses = open_buses(plan, wanted)
    time_ns = 0
    try:
        if not quiet:
            print(f"listening on {', '.join(bus.url for bus in buses)}; Ctrl-C ends it", file=sys.stderr, flush=True)
        for time_ns, number, frame in listen(buses, seconds):
            known = len(judge.kept)
            found = judge.observe(time_ns, number, frame) if frame is not None else []
            if not quiet and len(judge.kept) > known:
                for finding in found:
                    print(finding_text(finding), flush=True)
    except KeyboardInterrupt:
        pass
    finally:
        for bus in buses:
            bus.close()
    for finding in judge.finish(time_ns):
        if not quiet:
            print(finding_text(finding))
    return judge.report("bus")


def finding_lines(report: RefereeReport) -> Iterator[str]:
    """Yields the findings of a report, a line each."""
    for finding in report.findings:
        where = f"{finding.robot} " if finding.robot else ""
        yield f"{finding.time:.6f} s  {finding.bus} {finding.id}  {where}{finding.kind}: {finding.text}"


def verdict(report: RefereeReport) -> str:
    """Returns in one line how many frames were judged and what was found."""
    kinds = ", ".join(f"{kind} {count}" for kind, count in report.kinds.items())
    foreign = f", {report.unknown} frames of others" if report.unknown else ""
    seen = f"{report.frames} frames of {len(report.identifiers)} identifiers{foreign}{report.up_to}"
    return f"{seen}: {sum(report.kinds.values())} findings: {kinds}" if kinds else f"{seen}: no findings"
