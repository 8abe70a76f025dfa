"""How the supervisor ends the processes of a run, in three steps: `stop_members`, `finish_watchers`, `take_down`."""

import time
from collections.abc import Callable, Sequence
from typing import Final

from echelon.bridge.reports import CanReport
from echelon.sim.processes.children import Child, last_words_of
from echelon.sim.processes.contract import FINISHING
from echelon.sim.processes.failures import DivergedError, RunError
from echelon.sim.processes.stalls import STALL_REPORT_S
from echelon.sim.processes.to_process import End, Finish
from echelon.sim.processes.to_supervisor import RecorderReport

GRACE_S: Final = 3.0
"""How long processes may take to end, and watchers to close their files, when a run breaks off [s]"""
FINISH_TIMEOUT_S: Final = 60.0
"""How long watchers may take to finish after a complete run [s]"""

Serve = Callable[[float], None]
"""Reads what children say, for up to some seconds.  Raises RunError or DivergedError for what ends a run."""


def stop_members(children: Sequence[Child], serve: Serve) -> None:
    """Ends the members of a run that breaks off.

    They are terminated, so that they can send their last batches; those that do not end within `GRACE_S` are killed."""
    members = [child for child in children if child.is_member]
    for child in members:
        if child.process.is_alive():
            child.process.terminate()
    deadline_s = time.monotonic() + GRACE_S
    # Bridge and drives report their counts before they end, so their pipes must be read meanwhile.
    while time.monotonic() < deadline_s and any(child.process.is_alive() and child.done is None for child in members):
        try:
            serve(0.05)
        except (RunError, DivergedError):
            pass  # why the run breaks off is known already
    for child in members:
        if child.process.is_alive() and child.done is None:
            child.process.kill()


def finish_watchers(
    children: Sequence[Child], serve: Serve, say: Callable[[str], None], failure: str | None, whole: bool
) -> str | None:
    """Lets bridge, drives, referee and recorder finish, in this order; returns the failure of the run, old or new.

    If a run is `whole`, every message that was sent arrives, and watchers wait for all of them.  In other runs messages may be
    lost, and watchers wait until it is silent.  `say` shows a note to the user."""
    links = tuple(counts for child in children if child.done for counts in child.done.links)
    sent = {"robot": 0, "leader": 0, "coordinator": 0, "bridge": 0, "drives": 0}
    for child in children:
        if child.done and child.done.runner:
            sent[child.spec.kind] += child.done.runner.messages
    for kind in FINISHING:
        for child in children:
            if child.spec.kind != kind or not _awaits_finish(child):
                continue
            told = whole and failure is None
            order = Finish(
                links=links,
                robot_messages=sent["robot"] if told else None,
                messages=sum(sent.values()) if told else None,
            )
            failure = _finish(child, order, serve, say, failure)
            if child.done is not None and isinstance(child.done.report, CanReport):
                sent["bridge"] = child.done.report.messages
    for child in children:
        report = child.done and child.done.report
        if isinstance(report, RecorderReport) and report.failure:
            failure = failure or f"the recording failed: {report.failure}"
    return failure


def _awaits_finish(child: Child) -> bool:
    """Returns whether a process waits for the order to finish."""
    return not child.is_member and child.ready and not child.control.closed and child.process.is_alive()


def _finish(child: Child, order: Finish, serve: Serve, say: Callable[[str], None], failure: str | None) -> str | None:
    """Sends the order to finish to a process and waits until it is done; returns the failure of the run, old or new."""
    try:
        child.control.send(order)
        begun_s = time.monotonic()
        patience_s = GRACE_S if failure else FINISH_TIMEOUT_S
        while child.done is None and child.process.is_alive() and time.monotonic() - begun_s < patience_s:
            serve(0.05)
            if not failure and time.monotonic() - begun_s > STALL_REPORT_S:
                say(f"waits for {child.name} to finish ({child.state()})")
    except (RunError, DivergedError, OSError) as error:
        failure = failure or str(error)
    if child.done is None:
        failure = failure or f"lost {child.spec.kind} ({child.ending()}){last_words_of([child])}"
    return failure


def take_down(children: Sequence[Child]) -> None:
    """Ends all processes: sends `End` to those that are done, terminates the others, and kills what is left after `GRACE_S`."""
    for child in children:
        if child.done is not None and not child.control.closed:
            try:
                child.control.send(End())
            except OSError:
                pass
        elif child.process.is_alive():
            child.process.terminate()
    deadline_s = time.monotonic() + GRACE_S
    for child in children:
        child.process.join(max(0.0, deadline_s - time.monotonic()))
        if child.process.is_alive():
            child.process.kill()
            child.process.join()
        child.control.close()
        child.words.close()
