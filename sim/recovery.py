"""Rebuilds the folder of a run that was killed: the recording, the summary and the report, from what was written until then.

The summary has no values for what was not written: wall time, counts of links, and frames that are not in can.log.
"""

import os
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from echelon.bridge.protocols.plan_dbc import dbc_names, plan_dbc
from echelon.errors import UserError
from echelon.files import is_locked, lock, write_text
from echelon.shipped import EFFECTIVE
from echelon.sim.judged_log import Terms, judged
from echelon.sim.log_report import report_of_log
from echelon.sim.out_folder import CUT, RECORDING, REPORT, SUMMARY, note_again
from echelon.sim.parts.loading import load
from echelon.sim.recording.mcap_reader import (
    RecoverResult,
    is_finished,
    read_links,
    read_metadata,
    read_scenario,
    read_trace,
    recover,
)
from echelon.sim.results.records import RunFacts
from echelon.sim.results.rendering import read_summary, write_summary
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import Trace
from echelon.sim.run_folder import report_on


@dataclass(frozen=True, slots=True)
class Recovered:
    """The result of `recover_run`."""

    recording: RecoverResult
    files: tuple[str, ...]
    """Names of the files that were written; empty if nothing was missing"""
    report_failure: str = ""
    """Why there is no report; "" if there is one, or if nothing was written"""


def recover_run(folder: Path) -> Recovered:
    """Mends `run.mcap`, keeps the old one as `run.mcap.cut`, and writes the summary and the report.

    The verdict of that summary is FAILS, since the run broke off.  If nothing is missing in the folder, nothing is changed.
    Raises UserError if there is no recording or the run still goes on, and OSError."""
    try:
        held = lock(folder)
    except BlockingIOError:
        raise UserError(f"{folder}: a run is going on there") from None
    try:
        recovered = _recover(folder)
        if recovered.files:
            note_again(folder, recovered.files)
        return recovered
    finally:
        os.close(held)


def _recover(folder: Path) -> Recovered:
    recording, cut = folder / RECORDING, folder / CUT
    if cut.exists() and not recording.exists():  # an earlier recovery was killed here
        os.replace(cut, recording)
    try:
        if is_locked(recording):  # the supervisor was killed, and the recorder has not ended yet
            raise UserError(f"{folder}: a run is going on there")
        mended = folder / f"{RECORDING}.mended"
        result = recover(recording, mended)
        files: list[str] = []
        if result.complete and is_finished(recording):
            mended.unlink()
        else:
            os.replace(recording, cut)
            os.replace(mended, recording)
            files += [RECORDING, CUT]
        if result.complete and _has_summary(folder):
            return Recovered(result, tuple(files))
        files += _rebuild(folder, recording, result)
    except FileNotFoundError as error:
        raise UserError(f"{error.filename}: not found; a run cannot be rebuilt without it") from None
    except ValueError as error:  # its text begins with the name of the file
        raise UserError(str(error)) from None
    failure = ""
    try:
        report_on([folder], folder / REPORT)
        files.append(REPORT)
    except (UserError, OSError) as error:  # a run that was killed early may have no states
        failure = f"no report: {error}"
    return Recovered(result, tuple(files), failure)


def _has_summary(folder: Path) -> bool:
    """Returns whether a folder has a summary that can be read."""
    with suppress(OSError, ValueError):
        read_summary(folder / SUMMARY)
        return True
    return False


def _rebuild(folder: Path, recording: Path, result: RecoverResult) -> list[str]:
    """Writes the files that a run's folder lacks, and its summary, but not the report; returns the names of the files."""
    files: list[str] = []
    scenario = folder / EFFECTIVE
    if not scenario.exists() or not scenario.stat().st_size:
        write_text(scenario, read_scenario(recording))
        files.append(EFFECTIVE)
    _, plan = load(scenario)
    metadata = read_metadata(recording)
    trace = read_trace(recording, plan)
    links = [counts for _, counts in read_links(recording)]
    facts = RunFacts(
        engine=metadata.get("engine", ""),
        clock=metadata.get("clock", ""),
        wall_time=None,
        startup_time=None,
        real_time_factor=None,
        ticks_per_second=None,
        messages=None,
        failure=_failure(trace, result, bool(links)),
        version=metadata.get("echelon", ""),
        python=metadata.get("python", ""),
        recorded_every=float(metadata["recorded every"]) if "recorded every" in metadata else None,
    )
    log, can = folder / "can.log", None
    if log.exists():
        can = report_of_log(plan, log, facts.clock)
        if can.frames:
            can = replace(can, referee=judged(log, plan, Terms.of(plan, facts.clock, whole=False)))
        for bus, name in enumerate(dbc_names(plan)):
            if not (folder / name).exists():
                write_text(folder / name, plan_dbc(plan, bus))
                files.append(name)
    write_summary(summarise(trace, links, can, facts), folder / SUMMARY)
    return [*files, SUMMARY]


def _failure(trace: Trace, result: RecoverResult, counted: bool) -> str:
    """Returns the summary's text about the run that broke off; `counted` says whether counts of links were recorded."""
    until_ns = max((int(times_ns[-1]) for times_ns in trace.times_ns if len(times_ns)), default=None)
    if until_ns is None:
        return "broken off: no state of a robot was recorded"
    links = "" if counted else "; counts of links were not recorded"
    if result.complete:
        return f"broken off before its summary was written; this one is rebuilt from the recording{links}"
    until = f"the recording ends at {until_ns / 1e9:g} s of {trace.plan.duration_ns / 1e9:g} s"
    return f"broken off: {until}; this summary is rebuilt from it{links}"
