"""The chaos checker: a faultless run has no violation, and each planted one is caught by its rule."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from chaos.attacks import FORGED_PLACE, FORGED_TORQUE
from chaos.checker import check
from chaos.evidence import Done, Evidence, Logged, Recording, RobotState
from chaos.frames import COMMAND_ID, ENABLE, FEEDBACK_ID, Frame, torque_frame
from chaos.listener import Heard
from chaos.plans import FOREVER, ChaosPlan, Clock, Hit, Origin, Path, robot_names

MS = 1_000_000
START = 1_790_000_000_000_000_000
"""When the command begins [ns since 1970]"""
FIRST = START + 1_000 * MS
"""When the first torque is on the bus"""
BRIDGE, DRIVES, FORGER = ("192.0.2.2", 40001), ("192.0.2.2", 40002), ("192.0.2.2", 40003)
PERIODS = 250
ROBOTS = 3
OVER = FIRST + PERIODS * 10 * MS


def torque(robot: int, period: int) -> int:
    """Returns the torque of both wheels in a period, in bits; never zero, and another one in each period."""
    return 1 + (7 * period + robot) % 200


def command(time_ns: int, robot: int, period: int, value: int, flags: int = ENABLE) -> Frame:
    """Returns the bridge's command to a robot."""
    can_id = COMMAND_ID + robot
    return Frame(time_ns, BRIDGE, can_id, torque_frame(can_id, value, value, flags, period))


def report(time_ns: int, robot: int, period: int, value: int) -> Frame:
    """Returns a report of a robot's drives."""
    can_id = FEEDBACK_ID + robot
    return Frame(time_ns, DRIVES, can_id, torque_frame(can_id, value, value, 0x11, period))


def faultless(clock: Clock = "wall", path: Path = "closed", *hits: Done) -> Evidence:
    """Returns the evidence of a run in which nothing went wrong."""
    frames: list[Frame] = []
    states: dict[str, list[RobotState]] = {robot: [] for robot in robot_names(ROBOTS)}
    for period in range(PERIODS + 1):
        for robot, name in enumerate(states):
            at = FIRST + period * 10 * MS + robot * 10_000
            given = torque(robot, period - 1) if period else 0
            if path == "closed":
                frames.append(report(at - MS, robot, period, given))
            if period < PERIODS:
                frames.append(command(at, robot, period, torque(robot, period)))
            else:
                frames.append(command(at, robot, period, 0, 0))
            values = (0.01 * period, *[0.0] * 8, given / 1000, given / 1000, *[0.0] * 5)
            states[name].append(RobotState(period, period * 10 * MS, values))
    frames.sort()
    summary = {
        "verdict": {
            "word": "HEALTHY",
            "checks": [{"name": "whole", "outcome": "passed", "text": "the run reached 2.5 s"}],
        },
        "run": {"failure": None, "stopped": None},
    }
    return Evidence(
        ChaosPlan(0, clock, path, ROBOTS, PERIODS / 100, tuple(done.hit for done in hits)),
        list(hits),
        START,
        OVER + 500 * MS,
        0,
        "",
        "",
        Heard(frames),
        [Logged(frame.time_ns - FIRST + 1000 * MS, frame.can_id, frame.data) for frame in frames],
        Recording(True, states, [], ""),
        None,
        summary,
        {robot: list(all_of) for robot, all_of in states.items()} if clock == "virtual" else None,
        [],
    )


def broken_off(evidence: Evidence, at_ns: int, why: str) -> Evidence:
    """Returns the evidence of a run that broke off in order: zero torque at once, and what was sent until then is kept."""
    before = [frame for frame in evidence.heard.frames if frame.time_ns <= at_ns]
    zero = [command(at_ns + MS, robot, 0, 0, 0) for robot in range(ROBOTS)]
    heard = before + zero
    until_ns = at_ns - FIRST
    assert evidence.recording is not None
    states = {
        robot: [one for one in all_of if one.time_ns <= until_ns] for robot, all_of in evidence.recording.states.items()
    }
    whole = {"name": "whole", "outcome": "failed", "text": "the run broke off"}
    summary = {"verdict": {"word": "FAILS", "checks": [whole]}, "run": {"failure": why, "stopped": None}}
    return replace(
        evidence,
        heard=Heard(heard),
        can_log=[Logged(frame.time_ns - FIRST + 1000 * MS, frame.can_id, frame.data) for frame in heard],
        recording=Recording(True, states),
        summary=summary,
        code=3,
        stderr=f"echelon: {why}\n",
        ended_ns=at_ns + 500 * MS,
    )


def rules(evidence: Evidence) -> set[str]:
    """Returns the rules that a run did not keep."""
    return {violation.rule for violation in check(evidence)}


HIT = FIRST + 1005 * MS
"""When a run is hit: five milliseconds after its hundredth period"""


def killed(target: str = "north/n1") -> Done:
    """Returns a kill in the middle of a run."""
    return Done(Hit("kill", 1.0, target), HIT, None)


def frozen(target: str, lasts_s: float) -> Done:
    """Returns a process that is frozen in the middle of a run."""
    ended_ns = None if lasts_s == FOREVER else HIT + round(lasts_s * 1e9)
    return Done(Hit("freeze", 1.0, target, lasts_s), HIT, ended_ns)


def forged(kind: str = "forge_bus", origin: Origin = "here") -> Done:
    """Returns frames of somebody else in the middle of a run."""
    return Done(Hit(kind, 1.0, lasts_s=0.1, origin=origin), HIT, HIT + 100 * MS, port=FORGER[1])


@pytest.mark.parametrize("path", ["mirror", "closed"])
@pytest.mark.parametrize("clock", ["virtual", "wall"])
def test_a_faultless_run_keeps_all_promises(clock: Clock, path: Path) -> None:
    assert check(faultless(clock, path)) == []


def test_so_does_one_that_broke_off_in_order() -> None:
    evidence = broken_off(faultless("wall", "closed", killed()), HIT, "lost robot north/n1 (killed by SIGKILL)")
    assert check(evidence) == []


def test_and_one_with_traffic_that_it_did_not_heed() -> None:
    evidence = faultless("virtual", "closed", forged("flood_bus"))
    evidence.heard.frames += [Frame(HIT + step, FORGER, 0x600, b"") for step in range(100)]
    evidence.heard.frames.sort()
    assert check(evidence) == []


def _torque_goes_on(evidence: Evidence) -> Evidence:
    later = [command(HIT + ms * MS, 0, ms, 50) for ms in (100, 150, 160)]
    evidence.heard.frames[-ROBOTS:-ROBOTS] = later
    return replace(evidence, can_log=None)


def _left_enabled(evidence: Evidence) -> Evidence:
    return replace(evidence, heard=Heard(evidence.heard.frames[:-1]), can_log=None)


def _not_named(evidence: Evidence) -> Evidence:
    assert evidence.summary is not None
    run = {"failure": "lost robot north/n12, leader north", "stopped": None}
    return replace(evidence, stderr="echelon: lost robot north/n12\n", summary=evidence.summary | {"run": run})


def _exit_0(evidence: Evidence) -> Evidence:
    return replace(evidence, code=0)


def _traceback(evidence: Evidence) -> Evidence:
    return replace(evidence, stderr=evidence.stderr + "Traceback (most recent call last):\n  File x\nKeyError: 'x'\n")


def _recording_lost(evidence: Evidence) -> Evidence:
    assert evidence.recording is not None
    states = {robot: all_of[:60] for robot, all_of in evidence.recording.states.items()}
    return replace(evidence, recording=Recording(True, states))


def _recording_broken(evidence: Evidence) -> Evidence:
    return replace(evidence, recording=Recording(False, error="ValueError: no magic"))


def _log_lacks(evidence: Evidence) -> Evidence:
    assert evidence.can_log is not None
    return replace(evidence, can_log=[line for line in evidence.can_log if line.time_ns < 1500 * MS])


@pytest.mark.parametrize(
    ("plant", "rule"),
    [
        (_torque_goes_on, "late torque"),
        (_left_enabled, "last word"),
        (_not_named, "name"),
        (_exit_0, "false pass"),
        (_exit_0, "exit code"),
        (_traceback, "traceback"),
        (_recording_lost, "recording"),
        (_recording_broken, "recording"),
        (_log_lacks, "can.log"),
        (lambda evidence: replace(evidence, left=["process bridge"]), "left"),
        (lambda evidence: replace(evidence, left=["temporary pymp-1/listener-2"]), "left"),
        (lambda evidence: replace(evidence, code=-11), "exit code"),
        (lambda evidence: replace(evidence, code=120), "exit code"),
        (lambda evidence: replace(evidence, code=None), "end"),
        (lambda evidence: replace(evidence, summary=None, code=1), "exit code"),
    ],
)
def test_what_a_killed_run_did_wrong_is_caught(plant: Callable[[Evidence], Evidence], rule: str) -> None:
    evidence = broken_off(faultless("wall", "closed", killed()), HIT, "lost robot north/n1 (killed by SIGKILL)")
    assert rule in rules(plant(evidence))


@pytest.mark.parametrize(("at_ns", "documented"), [(START + 300 * MS, True), (HIT, False)])
def test_a_signal_ends_the_command_at_once_only_before_the_run(at_ns: int, documented: bool) -> None:
    done = Done(Hit("signal", -0.3, "supervisor", signal="TERM"), at_ns, None)
    evidence = replace(broken_off(faultless("wall", "closed", done), HIT, "SIGTERM"), code=-15)
    assert ("exit code" in rules(evidence)) is not documented


def test_torque_that_drives_give_too_late_is_caught() -> None:
    evidence = broken_off(faultless("wall", "closed", killed("bridge")), HIT, "lost bridge")
    late = [report(HIT + ms * MS, 0, ms, torque(0, 100)) for ms in range(5, 400, 10)]
    assert "late torque" in rules(replace(evidence, heard=Heard([*evidence.heard.frames, *late])))


@pytest.mark.parametrize(("target", "hit"), [("north", True), ("coordinator", True), ("recorder", False)])
def test_whose_torque_ends_depends_on_who_is_silent(target: str, hit: bool) -> None:
    evidence = faultless("wall", "closed", frozen(target, 2.0))  # the torque of all robots goes on
    assert ("late torque" in rules(evidence)) is hit


def test_a_bridge_that_was_killed_has_no_last_word() -> None:
    evidence = broken_off(faultless("wall", "closed", killed("bridge")), HIT, "lost bridge (killed by SIGKILL)")
    assert rules(_left_enabled(evidence)) == set()


def test_a_busy_machine_shifts_the_deadline_by_what_was_measured() -> None:
    evidence = _torque_goes_on(broken_off(faultless("wall", "closed", killed()), HIT, "lost robot north/n1"))
    evidence.heard.late.append((HIT + 100 * MS, 60 * MS))
    assert "late torque" not in rules(evidence)
    evidence.heard.late[:] = [(HIT - 500 * MS, 60 * MS)]  # before it was hit
    assert "late torque" in rules(evidence)


@pytest.mark.parametrize("target", ["north/n1", "north", "coordinator", "bridge", "drives"])
def test_no_pass_with_somebody_frozen_beyond_the_watchdog(target: str) -> None:
    assert "false pass" in rules(faultless("wall", "closed", frozen(target, 0.2)))
    assert "false pass" not in rules(faultless("virtual", "closed", frozen(target, 0.2)))


@pytest.mark.parametrize("target", ["recorder", "supervisor"])
def test_those_without_torque_may_stand_still_for_a_moment(target: str) -> None:
    assert rules(faultless("wall", "closed", frozen(target, 0.2))) == set()


@pytest.mark.parametrize("sender", [BRIDGE, DRIVES])
def test_no_pass_with_a_gap_on_the_bus(sender: tuple[str, int]) -> None:
    evidence = faultless()
    evidence.heard.frames[:] = [
        frame
        for frame in evidence.heard.frames
        if not (frame.sender == sender and HIT < frame.time_ns < HIT + 105 * MS and frame.can_id & 0x7F == 1)
    ]
    assert "false pass" in rules(evidence)


def test_no_pass_with_a_hole_in_the_recording() -> None:
    evidence = faultless()
    assert evidence.recording is not None
    del evidence.recording.states["north/n2"][40]
    assert "false pass" in rules(evidence)


def with_forged_frames(evidence: Evidence, at_ns: int) -> Evidence:
    """Returns evidence with frames of somebody else under the run's own identifiers, some of which are in the log."""
    frames = [command(at_ns + at * MS, 0, at, FORGED_TORQUE)._replace(sender=FORGER) for at in range(20)]
    evidence.heard.frames[:] = sorted([*evidence.heard.frames, *frames])
    assert evidence.can_log is not None
    evidence.can_log += [Logged(frame.time_ns - FIRST + 1000 * MS, frame.can_id, frame.data) for frame in frames[:7]]
    evidence.can_log.sort(key=lambda line: line.time_ns)
    return evidence


def test_no_pass_with_frames_of_others_under_the_own_identifiers() -> None:
    assert rules(with_forged_frames(faultless("virtual", "mirror", forged()), HIT)) == {"false pass"}


def test_frames_of_others_that_came_too_late_hurt_nobody() -> None:
    evidence = with_forged_frames(faultless("virtual", "mirror", forged()), OVER + 20 * MS)
    assert rules(evidence) == set()


def test_frames_in_the_log_that_nobody_sent_are_caught_beside_those_of_others() -> None:
    evidence = replace(with_forged_frames(faultless("wall", "mirror", forged()), HIT), code=1)
    assert evidence.summary is not None
    evidence.summary["verdict"]["word"] = "FAILS"
    assert rules(evidence) == set()
    assert evidence.can_log is not None
    evidence.can_log.insert(300, Logged(evidence.can_log[300].time_ns, COMMAND_ID, bytes(8)))
    assert rules(evidence) == {"can.log"}


def test_a_drive_that_obeys_somebody_else_is_caught() -> None:
    evidence = faultless("wall", "closed", forged(origin="elsewhere"))
    at = next(at for at, frame in enumerate(evidence.heard.frames) if frame.sender == DRIVES and frame.time_ns > HIT)
    value = FORGED_TORQUE
    can_id, time_ns = evidence.heard.frames[at].can_id, evidence.heard.frames[at].time_ns
    wrong = command(time_ns - 2 * MS, can_id - FEEDBACK_ID, 0, value)._replace(sender=FORGER)
    evidence.heard.frames[at] = report(time_ns, can_id - FEEDBACK_ID, 0, value)
    evidence.heard.frames.insert(at, wrong)
    assert "obeyed" in rules(replace(evidence, can_log=None))


def test_a_drive_that_gives_old_torques_is_caught_unless_the_machine_was_late() -> None:
    age_ns, value = 250 * MS, 900
    evidence = faultless()
    frames = evidence.heard.frames
    asked = next(at for at, frame in enumerate(frames) if frame.sender == BRIDGE and frame.time_ns > HIT)
    robot, asked_ns = frames[asked].can_id - COMMAND_ID, frames[asked].time_ns
    frames[asked] = command(asked_ns, robot, 0, value)
    given = next(
        at for at, one in enumerate(frames) if one.can_id == FEEDBACK_ID + robot and one.time_ns > asked_ns + age_ns
    )
    frames.insert(given + 1, report(frames[given].time_ns, robot, 0, value))
    assert rules(replace(evidence, can_log=None)) == {"obeyed"}
    evidence.heard.late.append((frames[given].time_ns, age_ns))
    assert rules(replace(evidence, can_log=None)) == set()


def test_a_robot_that_moves_with_a_forged_report_is_caught() -> None:
    evidence = faultless("wall", "closed", forged(origin="elsewhere"))
    assert evidence.recording is not None
    states = evidence.recording.states["north/n1"]
    values = list(states[120].values)
    values[9] = FORGED_TORQUE / 1000
    states[120] = replace(states[120], values=tuple(values))
    assert "obeyed" in rules(evidence)


def test_states_that_differ_from_the_undisturbed_ones_are_caught() -> None:
    evidence = faultless("virtual", "mirror", forged("forge_zenoh"))
    assert evidence.recording is not None
    states = evidence.recording.states["north/n3"]
    states[7] = replace(states[7], values=(states[7].values[0] + 1e-15, *states[7].values[1:]))
    assert rules(evidence) == {"forged"}


def test_a_forged_state_in_the_recording_is_caught() -> None:
    evidence = faultless("wall", "mirror", forged("forge_zenoh"))
    assert evidence.recording is not None
    states = evidence.recording.states["north/n3"]
    states[7] = replace(states[7], values=(FORGED_PLACE, *states[7].values[1:]))
    assert rules(evidence) == {"forged"}


@pytest.mark.parametrize("code", [1, 2, 3])
def test_a_run_that_others_end_is_caught(code: int) -> None:
    evidence = faultless("virtual", "mirror", forged("malformed_bus"))
    ended = broken_off(evidence, HIT, "the bridge cannot read the bus")
    assert "outside" in rules(replace(ended, code=code))


def test_torques_that_are_made_up_for_are_caught() -> None:
    evidence = faultless("wall", "mirror", frozen("bridge", 0.2))
    burst = [
        frame._replace(time_ns=HIT + 200 * MS + at * 100_000) if HIT < frame.time_ns < HIT + 200 * MS else frame
        for at, frame in enumerate(evidence.heard.frames)
    ]
    found = rules(replace(evidence, heard=Heard(sorted(burst))))
    assert {"burst", "can.log", "false pass"} <= found


def shifted(evidence: Evidence, base: int, how_many: int) -> Evidence:
    """Returns evidence in whose log some frames of the robots have a time that is not that of the wire."""
    assert evidence.can_log is not None
    log = list(evidence.can_log)
    those = [at for at, line in enumerate(log) if base <= line.can_id < base + ROBOTS and line.time_ns > 1500 * MS]
    for at in those[:how_many]:
        log[at] = replace(log[at], time_ns=log[at].time_ns - 120 * MS)
    return replace(evidence, can_log=log)


def test_times_in_the_log_that_are_not_those_of_the_wire_are_caught() -> None:
    assert rules(shifted(faultless(), COMMAND_ID, 1)) == {"can.log"}
    assert rules(shifted(faultless(), FEEDBACK_ID, PERIODS * ROBOTS // 8)) == {"can.log"}
    assert rules(shifted(faultless(), FEEDBACK_ID, PERIODS * ROBOTS // 20)) == set()


def test_a_frame_in_the_log_that_was_not_on_the_wire_is_caught() -> None:
    evidence = faultless()
    assert evidence.can_log is not None
    evidence.can_log[300] = replace(evidence.can_log[300], data=bytes(8))
    assert rules(evidence) == {"can.log"}


@pytest.mark.parametrize(
    ("clock", "lacking", "found"), [("virtual", 1, False), ("virtual", 2, True), ("wall", 1, True)]
)
def test_only_an_instant_that_broke_off_may_be_missing_in_the_log(clock: Clock, lacking: int, found: bool) -> None:
    evidence = broken_off(faultless(clock, "closed", killed("north")), HIT, "lost leader north (killed by SIGKILL)")
    assert evidence.can_log is not None
    mine = [line for line in evidence.can_log if line.can_id == FEEDBACK_ID]
    log = [line for line in evidence.can_log if line not in mine[-lacking:]]
    late = [command(HIT + 200 * MS, robot, 1, 0, 0) for robot in range(ROBOTS)]  # the bridge goes on for a while
    log += [Logged(frame.time_ns - FIRST + 1000 * MS, frame.can_id, frame.data) for frame in late]
    heard = Heard([*evidence.heard.frames, *late])
    assert ("can.log" in rules(replace(evidence, can_log=log, heard=heard))) is found


def test_what_the_listener_missed_is_held_against_nobody() -> None:
    evidence = faultless()
    evidence.heard.frames[:] = [frame for frame in evidence.heard.frames if not HIT < frame.time_ns < HIT + 200 * MS]
    evidence.heard.missed = 120
    assert check(evidence) == []
