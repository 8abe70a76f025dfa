"""How the supervisor ends the processes of a run, in four steps: `stop_wheels`, `stop_members`, `finish_watchers`,
`take_down`.  The first two are for runs that break off; in others the members are done, and the bridge finishes first."""

import signal
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

from echelon.bridge.reports import CanReport
from echelon.sim.processes.children import Child
from echelon.sim.processes.contract import FINISHING
from echelon.sim.processes.failures import DivergedError, LostError, RunError, few
from echelon.sim.processes.stalls import STALL_REPORT_S
from echelon.sim.processes.to_process import BreakOff, End, Finish
from echelon.sim.processes.to_supervisor import RecorderReport

ZERO_S: Final = 0.5
"""How long a bridge may take to stop the wheels before the other processes end [s]; after that the drives' watchdogs have"""
GRACE_S: Final = 3.0
"""How long processes may take to end, and watchers to close their files, when a run breaks off [s]"""
FINISH_TIMEOUT_S: Final = 60.0
"""How long watchers may take to finish after a complete run [s]"""

Serve = Callable[[float], None]
"""Reads what children say, for up to some seconds.  Raises RunError or DivergedError for what ends a run."""


def stop_wheels(children: Sequence[Child], serve: Serve) -> None:
    """Has the bridge take the torque away from all wheels and disable their drives, before anything else ends.

    Then the referee hears of it, so that it does not judge the frames of this stop."""
    bridges = [child for child in children if child.spec.kind == "bridge" and child.ready]
    for child in bridges:
        _order(child)
    for child in children:
        if child.spec.kind == "referee" and child.ready and child.alive:
            with suppress(OSError):
                child.control.send(BreakOff())
    deadline_s = time.monotonic() + ZERO_S
    while time.monotonic() < deadline_s and any(
        child.alive and child.done is None and not child.pulse.has_stopped for child in bridges
    ):
        try:
            serve(0.005)
        except (RunError, DivergedError):
            pass  # why the run breaks off is known already


def stop_members(children: Sequence[Child], serve: Serve) -> None:
    """Ends the members of a run that breaks off.

    They are ordered to end, so that they can send their last batches; those that do not end within `GRACE_S` are killed.  One
    that somebody has stopped goes on once more, to do so."""
    members = [child for child in children if child.is_member]
    for child in members:
        if child.done is None:
            _order(child)
    deadline_s = time.monotonic() + GRACE_S
    # Bridge and drives report their counts before they end, so their pipes must be read meanwhile.
    while time.monotonic() < deadline_s and any(child.alive and child.done is None for child in members):
        try:
            serve(0.05)
        except (RunError, DivergedError):
            pass  # why the run breaks off is known already
    for child in members:
        if child.done is None:
            child.signal(signal.SIGKILL)


def _order(child: Child) -> None:
    """Orders a process to end; one that somebody has stopped can do so, since it goes on."""
    child.stop()
    if child.state() == "stopped":
        child.signal(signal.SIGCONT)


def finish_watchers(
    children: Sequence[Child],
    serve: Serve,
    say: Callable[[str], None],
    failure: str | None,
    whole: bool,
    asked: Callable[[], bool] = lambda: False,
    stalled: Callable[[Child], str | None] = lambda child: None,
) -> str | None:
    """Lets bridge, drives, referee and recorder finish, in this order; returns the failure of the run, old or new.

    If a run is `whole`, every message that was sent arrives, and watchers wait for all of them.  In other runs messages may be
    lost, and watchers wait until it is silent.  `say` shows a note to the user.  Once the user has `asked` for the end, each
    watcher has `GRACE_S`.  `stalled` returns in words that a process has stood still for too long, or None."""
    links = tuple(counts for child in children if child.done for counts in child.done.links)
    stopped_ns: int | None = None
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
                wheels_stopped_ns=stopped_ns,
            )
            failure = _finish(child, order, serve, say, failure, asked, stalled)
            if child.done is not None and isinstance(child.done.report, CanReport):
                sent["bridge"] = child.done.report.messages
                stop_s = child.done.report.wheels_stopped
                stopped_ns = None if stop_s is None else round(stop_s * 1e9)
    for child in children:
        report = child.done and child.done.report
        if isinstance(report, RecorderReport) and report.failure:
            failure = failure or f"the recording failed: {report.failure}"
    return failure


def _awaits_finish(child: Child) -> bool:
    """Returns whether a process waits for the order to finish."""
    return not child.is_member and child.ready and not child.control.closed and child.alive


def _finish(
    child: Child,
    order: Finish,
    serve: Serve,
    say: Callable[[str], None],
    failure: str | None,
    asked: Callable[[], bool],
    stalled: Callable[[Child], str | None],
) -> str | None:
    """Sends the order to finish to a process and waits until it is done; returns the failure of the run, old or new.

    One that somebody has stopped goes on once more, so that it keeps what has come to it: at once if the run has failed, else
    after `GRACE_S`, and then the run has failed.  What has not finished `GRACE_S` later is given up, and so is one that runs a
    user's part and has `stalled`; a bridge then stops the wheels first."""
    try:
        child.control.send(order)
    except OSError:
        return failure or str(LostError(child))
    begun_s, continued = time.monotonic(), False
    while child.done is None and child.alive:
        try:
            serve(0.05)
        except (RunError, DivergedError) as error:  # its report may follow
            failure = failure or str(error)
        waited_s, stopped = time.monotonic() - begun_s, child.state() == "stopped"
        if not failure and waited_s > STALL_REPORT_S:
            say(f"waits for {child.name} to finish ({child.state()}{child.runs()})")
        if stopped and not continued and (failure or waited_s > GRACE_S):
            failure = failure or str(LostError(child))
            child.signal(signal.SIGCONT)
            begun_s, continued = time.monotonic(), True
        elif child.runs() and (why := stalled(child)):
            failure = failure or why
            stop_wheels([child], serve)
            break
        elif waited_s > (GRACE_S if failure or asked() or stopped else FINISH_TIMEOUT_S):
            break
    return failure or (str(LostError(child)) if child.done is None else None)


def take_down(children: Sequence[Child]) -> None:
    """Ends all processes: sends `End` to those that are done, orders the others to end, and kills what is left after
    `GRACE_S`."""
    for child in children:
        if child.done is not None and not child.control.closed:
            try:
                child.control.send(End())
                continue
            except OSError:
                pass
        child.stop()
    deadline_s = time.monotonic() + GRACE_S
    for child in children:
        if not child.ends_within(max(0.0, deadline_s - time.monotonic())):
            child.signal(signal.SIGKILL)
            child.ends_within(GRACE_S)
        child.process.join(0.2)  # if the fork server is there, it lets the process go
        child.close()


def also_killed(children: Sequence[Child], failure: str) -> str:
    """Returns the failure of a run, and after it the processes that others killed, if the failure does not name them."""
    killed = [
        f"{child.kind_and_name} ({child.ending()})"
        for child in children
        if child.done is None and child.was_killed and f"{child.kind_and_name} (" not in failure
    ]
    first, line, rest = failure.partition("\n")
    return f"{first}; lost as well: {few(killed)}{line}{rest}" if killed else failure
