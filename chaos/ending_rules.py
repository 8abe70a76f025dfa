"""What must hold when a run is over: its verdict, its exit code, its recording, and what it leaves behind."""

import signal
from collections.abc import Iterator
from typing import Final

from chaos.attacks import FORGED_PLACE
from chaos.bus_rules import LOST_NS
from chaos.evidence import PERIOD_NS, WATCHDOG_NS, Recording
from chaos.plans import FOREVER, TRAFFIC
from chaos.verdict import MARGIN_NS, Case, Violation, names

CODES: Final = (0, 1, 2, 3)
"""Exit codes of `echelon run` that are documented"""
TRACEBACK: Final = "Traceback (most recent call last)"
NAMED_S: Final = 1.0
"""A silence of this length has a name [s]"""


def ends(case: Case) -> Iterator[Violation]:
    """The command ends by itself, in time, with a documented code and without a traceback."""
    evidence = case.evidence
    by_signal = {
        -signal.SIGKILL for done in evidence.done if (done.hit.kind, done.hit.target) == ("kill", "supervisor")
    }
    for done in evidence.done:  # before a run has begun, a signal ends the command as any other
        if done.hit.kind == "signal" and not any(frame.time_ns < done.begun_ns for frame in case.owned):
            by_signal.add(-signal.Signals[f"SIG{done.hit.signal}"])
    if evidence.code is None:
        seconds = (evidence.ended_ns - evidence.begun_ns) / 1e9
        yield Violation("end", f"the command did not end within {seconds:.0f} s")
    elif evidence.code not in CODES and evidence.code not in by_signal:
        yield Violation("exit code", f"{evidence.code} is not documented")
    for name, text in (("standard error", evidence.stderr), ("standard output", evidence.stdout)):
        if TRACEBACK in text:
            last = text[text.rindex(TRACEBACK) :].strip().splitlines()
            yield Violation("traceback", f"on {name}: {next((line for line in last[1:] if line[:1] != ' '), last[-1])}")


def code_is_the_verdict(case: Case) -> Iterator[Violation]:
    """0 and 1 are verdicts: the exit code says what the summary says, and nothing else."""
    code, word = case.evidence.code, case.word
    expected = {0: ("HOLDS", "HEALTHY"), 1: ("FAILS",)}
    if code in expected and word not in expected[code]:
        yield Violation("exit code", f"{code}, but {f'the verdict is {word}' if word else 'there is no summary'}")


def no_false_pass(case: Case) -> Iterator[Violation]:
    """No run is a good one in which something that mattered was hit, or a drive heard nothing for longer than the watchdog."""
    if not case.passed:
        return
    said = f"{case.word or 'no summary'}, exit code {case.evidence.code}"
    for done in case.evidence.done:
        if why := case.mattered(done):
            yield Violation("false pass", f"{said}: {why}")
        if done.hit.kind == "forge_bus" and case.owned:
            # what comes before the run's first words, or after its last ones, is not for it
            first_ns, over_ns = case.owned[0].time_ns, case.owned[-1].time_ns - MARGIN_NS
            sent = sum(frame.sender[1] == done.port and first_ns < frame.time_ns < over_ns for frame in case.forged)
            if sent:
                what = f"others sent {sent} frames of the run's own identifiers from {done.hit.origin}"
                yield Violation("false pass", f"{said}: {what}")
    if case.wall and case.run_ns is not None and case.complete:
        sides = {"commands": {robot: [ns for ns, _ in heard] for robot, heard in case.commands.items()}}
        if case.closed:
            sides["reports"] = {robot: [one.time_ns for one in heard] for robot, heard in case.reports.items()}
        for what, heard in sides.items():
            for robot, times_ns in heard.items():
                within = [ns for ns in times_ns if case.run_ns[0] <= ns <= case.run_ns[1]]
                gap_ns = max((after - before for before, after in zip(within, within[1:], strict=False)), default=0)
                if gap_ns > WATCHDOG_NS:
                    gap_ms = gap_ns / 1e6
                    yield Violation("false pass", f"{said}: no {what} of {robot} on the bus for {gap_ms:.0f} ms")
    if case.evidence.recording is None or not case.evidence.recording.whole:
        yield Violation("false pass", f"{said}: the recording is not whole")
    else:
        yield from _gaps(case, case.evidence.recording, said)


def _gaps(case: Case, recording: Recording, said: str) -> Iterator[Violation]:
    """A good run has all states of all robots in its recording."""
    periods = round(case.evidence.plan.duration_s * 1e9) // PERIOD_NS
    for robot in case.robots:
        numbers = [state.sequence for state in recording.states.get(robot, [])]
        if len(numbers) < periods or numbers != list(range(len(numbers))):
            yield Violation(
                "false pass", f"{said}: {len(numbers)} states of {robot} are recorded, {periods + 1} were sent"
            )


def outside_ends_nothing(case: Case) -> Iterator[Violation]:
    """What others send ends no run, and in virtual time changes none."""
    evidence = case.evidence
    if not evidence.done or any(done.hit.kind not in TRAFFIC for done in evidence.done):
        return
    summary = evidence.summary
    if evidence.code not in (0, 1) or summary is None:
        yield Violation("outside", f"the run ended with {evidence.code}: {_first_line(evidence.stderr)}")
        return
    whole = next((check for check in summary["verdict"]["checks"] if check["name"] == "whole"), None)
    if whole is None or whole["outcome"] != "passed":
        yield Violation("outside", f"the run ended early: {whole and whole['text']}")
    forged = any(done.hit.kind in ("forge_bus", "malformed_bus") for done in evidence.done)
    if not case.wall and not forged and evidence.code:
        failed = [check["text"] for check in summary["verdict"]["checks"] if check["outcome"] == "failed"]
        yield Violation("outside", f"a run in virtual time fails: {'; '.join(failed)}")


def _first_line(text: str) -> str:
    """Returns the first line of a text."""
    return text.strip().partition("\n")[0]


def states_are_the_undisturbed_ones(case: Case) -> Iterator[Violation]:
    """In virtual time the recorded states are, bit for bit, those of the same run with nothing done to it.

    On a wall clock no recorded value is a forged one."""
    recording = case.evidence.recovered or case.evidence.recording
    if recording is None:
        return
    for robot, states in recording.states.items():
        if any(FORGED_PLACE in state.values for state in states):
            yield Violation("forged", f"a state of {robot} that it did not send is in the recording")
        if case.evidence.reference is None:
            continue
        true = {state.sequence: state for state in case.evidence.reference.get(robot, [])}
        if other := next((state for state in states if true.get(state.sequence) != state), None):
            yield Violation("forged", f"{robot} is elsewhere than undisturbed from {other.time_ns / 1e9:g} s on")


def recording_is_kept(case: Case) -> Iterator[Violation]:
    """The recording is readable, and lacks at most the last 0.2 s before whoever wrote it was killed."""
    evidence = case.evidence
    recording = evidence.recovered or evidence.recording
    if recording is None:
        if evidence.summary is not None or evidence.can_log:
            yield Violation("recording", "there is none")
        return
    if recording.error:
        yield Violation("recording", f"cannot be read: {recording.error}")
        return
    if any(done.hit.kind == "full_disk" for done in evidence.done):
        return
    if not recording.whole:
        yield Violation("recording", "cannot be made whole by echelon recover")
    if case.complete:
        yield from _lost(case, recording)


def _lost(case: Case, recording: Recording) -> Iterator[Violation]:
    """The states that robots sent 0.2 s before the first hit are in the recording: as many as torques were on the bus."""
    until_ns = (
        min((begun_ns for _, begun_ns, _ in case.silences()), default=case.evidence.ended_ns) - LOST_NS - MARGIN_NS
    )
    if case.run_ns is None:
        return
    periods = round(case.evidence.plan.duration_s * 1e9) // PERIOD_NS
    if case.wall:
        periods = min(periods, (until_ns - case.run_ns[0]) // PERIOD_NS)
    for robot, commands in case.commands.items():
        heard = sum(case.run_ns[0] <= ns <= until_ns for ns, _ in commands)
        wanted = min(periods, heard) - 2  # the first torque belongs to the first or the second state
        found = len(recording.states.get(robot, []))
        if found < wanted:
            yield Violation("recording", f"lacks {wanted - found} of the first {wanted} states of {robot}")


def culprit_is_named(case: Case) -> Iterator[Violation]:
    """Standard error, or a reason of the verdict, names the process that was hit."""
    evidence = case.evidence
    told = evidence.stderr
    if evidence.summary is not None:
        run = evidence.summary["run"]
        told += f"\n{run.get('failure')}\n{run.get('stopped')}\n"
        told += "\n".join(c["text"] for c in evidence.summary["verdict"]["checks"] if c["outcome"] == "failed")
    single = [done for done in evidence.done if done.hit.target not in ("", "supervisor", "group")]
    others = [done for done in evidence.done if done.hit.target in ("supervisor", "group")]
    if others or len(single) != 1 or not (why := case.mattered(single[0])):
        return
    hit = single[0].hit
    lasts_s = FOREVER if hit.kind != "freeze" else hit.lasts_s
    if lasts_s >= NAMED_S and not names(hit.target, told):
        yield Violation("name", f"{why}, and neither standard error nor a reason names it: {_first_line(told)!r}")


def nothing_left(case: Case) -> Iterator[Violation]:
    """No process, socket, shared memory or temporary folder is left."""
    if case.evidence.left:
        yield Violation("left", ", ".join(case.evidence.left[:6]))
