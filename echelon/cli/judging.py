"""What `echelon referee` does: it judges the frames on buses, in a run's can.log, or in the log of another program."""

import sys
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

from echelon.bridge.can.candump import BACKWARDS
from echelon.bridge.referee.log import judge_log, names_in
from echelon.bridge.referee.referee import Referee
from echelon.bridge.referee_reports import RefereeReport
from echelon.bridge.stations.closed import LOG
from echelon.cli.frame_sources import listen, open_buses
from echelon.errors import UsageError
from echelon.files import read_json
from echelon.plan.plan import Plan
from echelon.sim.judged_log import Terms, judged
from echelon.sim.run_state import goes_on, read_state
from echelon.sim.view.wheel_table import finding_text


def terms_of(folder: Path, plan: Plan) -> Terms:
    """Returns the terms for a run's can.log, by what its folder says: they are those of the run itself."""
    state = read_state(folder)
    try:
        summary = read_json((folder / "summary.json").read_bytes())
        run, can = dict(summary["run"]), summary["can"]
    except (OSError, ValueError, KeyError, TypeError):
        run, can = {}, None
    referee = can.get("referee") if isinstance(can, dict) else None
    until_s = referee.get("until") if isinstance(referee, dict) else None
    clock = run.get("clock") or (state.clock if state else "")
    whole = not (run.get("failure") or run.get("stopped") or goes_on(folder))
    until_ns = round(until_s * 1e9) if isinstance(until_s, int | float) and abs(until_s) < 1e9 else None
    return Terms.of(plan, clock, whole, until_ns)


def judge_run(plan: Plan, folder: Path) -> RefereeReport:
    """Returns what the referee finds in a run's can.log; of a run that goes on, in what it holds so far.

    Raises UsageError if the log cannot be read, or holds things but no frame of the plan."""
    try:
        report = judged(folder / LOG, plan, terms_of(folder, plan))
    except OSError as error:
        raise UsageError(f"{folder / LOG}: {error.strerror}") from None
    if report.left_out and not report.frames:
        raise UsageError(f"{folder / LOG}: {_nothing(plan, report)}; it is not as the run wrote it")
    return report


def judge_foreign(plan: Plan, path: Path, pairs: Sequence[str], tolerance_s: float | None) -> RefereeReport:
    """Returns what the referee finds in a log that another program wrote; `pairs` are those of `--map`.

    Raises UsageError if the log cannot be read, if it holds no frame of the plan, and for a wrong value of an option."""
    _check_tolerance(tolerance_s)
    buses = {bus.name: number for number, bus in enumerate(plan.can.buses)}
    names = {} if pairs else names_in(plan)
    for pair in pairs:
        interface, _, bus = pair.rpartition("=")
        if not interface or bus not in buses:
            raise UsageError(f"--map {pair}: must be INTERFACE=BUS, with BUS one of {', '.join(buses)}")
        names[interface] = buses[bus]
    try:
        report = judge_log(path, plan, names=names, tolerance_ns=_nanoseconds(tolerance_s), whole=False)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror or error}") from None
    if not report.frames:
        hint = "" if pairs else "; --map INTERFACE=BUS says which bus an interface is"
        raise UsageError(f"{path}: {_nothing(plan, report)}{hint if report.left_out else ''}")
    if BACKWARDS in report.left_out:
        raise UsageError(f"{path}: cannot be judged: {_left_out(report, '')}")
    return replace(report, source=str(path))


def _nothing(plan: Plan, report: RefereeReport) -> str:
    """Returns a text about a log without frames of the plan."""
    names = ", ".join(bus.name for bus in plan.can.buses)
    return f"holds no frame of a bus of the scenario ({names}){_left_out(report, ', but ')}"


def _left_out(report: RefereeReport, before: str) -> str:
    counts = (f"{count} {reason}" for reason, count in report.left_out.items())
    return before + ", ".join(counts) if report.left_out else ""


def _check_tolerance(tolerance_s: float | None) -> None:
    if tolerance_s is not None and not 0 <= tolerance_s < 1e9:
        raise UsageError(f"--tolerance {tolerance_s:g}: must be 0 s or more")


def _nanoseconds(seconds: float | None) -> int | None:
    return None if seconds is None else round(seconds * 1e9)


def judge_live(
    plan: Plan, wanted: str | None, seconds: float | None, tolerance_s: float | None, quiet: bool
) -> RefereeReport:
    """Returns what the referee finds on the plan's buses, until Ctrl-C or for some seconds; `wanted` is what `--can` says.

    Unless `quiet`, the findings that the report keeps are printed as they are made.  Raises UsageError for a tolerance that is
    negative, and if a bus cannot be opened."""
    _check_tolerance(tolerance_s)
    judge = Referee(plan, tolerance_ns=_nanoseconds(tolerance_s), late=True)
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
    found = f"{sum(report.kinds.values())} findings: {kinds}" if kinds else "no findings"
    return f"{seen}: {found}{_left_out(report, '; left out: ')}"
