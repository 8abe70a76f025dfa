"""What must hold on the bus, as the independent listener heard it."""

from collections import Counter, deque
from collections.abc import Iterator
from typing import Final

from chaos.evidence import PERIOD_NS, TORQUE_SCALE, WATCHDOG_NS, Logged
from chaos.frames import FEEDBACK_ID, Command, Frame
from chaos.plans import FOREVER
from chaos.verdict import Case, Violation

RECENT: Final = 4
"""How many of the owner's last commands a drive's mean torque of a period may be made of, at least"""
RECENT_NS: Final = WATCHDOG_NS + 3 * PERIOD_NS
"""How old such a command may be where nothing is late: no torque acts for longer than the watchdog [ns]"""
LOST_NS: Final = 200_000_000
"""How much a log may lose of what was on the wire when its writer is killed [ns]"""
SHIFT_NS: Final = 100_000_000
"""By how much the times of can.log may differ from those of the wire [ns]"""


def no_late_torque(case: Case) -> Iterator[Violation]:
    """No torque later than watchdog + one frame after its source fell silent: not commanded, and not given by a drive."""
    if not case.wall and not case.closed:
        yield from _no_late_frames(case)
    for done, begun_ns, ended_ns in case.silences():
        if not case.wall and not case.closed and done.hit.target not in ("supervisor", "group"):
            continue  # the bus shows what has been, a batch at a time
        if done.hit.kind == "freeze" and done.hit.target == "supervisor":
            continue  # torque does not come from there
        at_most_ns = begun_ns + WATCHDOG_NS + PERIOD_NS + case.slack_ns(begun_ns)
        # On a wall clock whoever was frozen goes on; then it is not silent any more.
        for robot in case.driven_by(done.hit.target):
            commanded = [ns for ns, told in case.commands[robot] if told.moves and at_most_ns < ns < ended_ns]
            if commanded and done.hit.target != "bridge":
                yield Violation("late torque", _late(f"{done.hit}: {robot} was commanded torque", begun_ns, commanded))
            if case.closed and done.hit.target != "drives":
                # A report is of the time since the one before, so that one must be too late already.
                late = [one for one in case.reports[robot] if at_most_ns < one.since_ns and one.time_ns < ended_ns]
                given = [one.time_ns for one in late if any(one.torques)]
                if given:
                    yield Violation("late torque", _late(f"{done.hit}: drives of {robot} gave torque", begun_ns, given))


def _no_late_frames(case: Case) -> Iterator[Violation]:
    """In virtual time, where the bus only shows torques: none for more periods than the robot said states."""
    recording = case.evidence.recovered or case.evidence.recording
    killed = [done.hit.target for done in case.evidence.done if done.hit.kind == "kill"]
    if recording is None or any(target in ("recorder", "supervisor") for target in killed) or not killed:
        return
    for robot, commands in case.commands.items():
        shown, said = sum(told.moves for _, told in commands), len(recording.states.get(robot, []))
        if shown > said + (WATCHDOG_NS + LOST_NS) // PERIOD_NS + 1:
            yield Violation("late torque", f"{robot} was commanded torque in {shown} periods, and said {said} states")


def _late(what: str, begun_ns: int, times_ns: list[int]) -> str:
    """Returns a sentence on torques that came too late."""
    first, last = (round((ns - begun_ns) / 1e6) for ns in (times_ns[0], times_ns[-1]))
    return f"{what} {first} to {last} ms after, in {len(times_ns)} frames"


def nothing_made_up_for(case: Case) -> Iterator[Violation]:
    """After a pause torques that are older than the watchdog are not sent any more, so few can come at once."""
    if not case.wall:
        return
    most = WATCHDOG_NS // PERIOD_NS + 2
    for robot, commands in case.commands.items():
        times_ns = [ns for ns, told in commands if told.moves]
        for first in range(len(times_ns) - most):
            if times_ns[first + most] - times_ns[first] < PERIOD_NS:
                yield Violation("burst", f"{robot} was commanded {most + 1} torques within one period of 10 ms")
                break


def last_word(case: Case) -> Iterator[Violation]:
    """The last command that each drive hears is zero and disabled, whenever the bridge could still speak."""
    for done in case.evidence.done:
        if done.hit.target == "bridge" and (
            done.hit.kind == "kill"
            or (done.hit.kind == "freeze" and (done.ended_ns is None or done.hit.lasts_s == FOREVER))
        ):
            return
    for robot, commands in case.commands.items():
        if not any(told.enabled for _, told in commands):
            continue
        time_ns, told = commands[-1]
        if told.enabled or told.right or told.left:
            moves = f"torques {told.right} and {told.left} bits" if told.moves else "zero torque"
            since_s = (case.evidence.ended_ns - time_ns) / 1e9
            yield Violation(
                "last word", f"{robot} was left enabled with {moves}, {since_s:.2f} s before the command ended"
            )


def obeyed_nobody_else(case: Case) -> Iterator[Violation]:
    """Drives give torques that their owner commanded, and robots move with torques that their drives reported.

    Whoever may speak on a CAN bus can command its drives.  So it is not judged where another program of this host does; then
    no verdict may be a good one."""
    heard = any(done.hit.kind == "forge_bus" and done.hit.origin == "here" for done in case.evidence.done)
    if not case.closed or not case.complete or heard:
        return
    for robot in case.robots:
        commands, next_command = case.commands[robot], 0
        for report in case.reports[robot]:
            while next_command < len(commands) and commands[next_command][0] <= report.time_ns:
                next_command += 1
            given = commands[:next_command]
            asked = _asked(given, report.since_ns - RECENT_NS)
            if _within(report.torques, asked):
                continue
            # a drive that is late reports late
            since_ns = report.since_ns - RECENT_NS
            asked = _asked(given, since_ns - case.evidence.heard.lateness_ns(since_ns, report.time_ns))
            if not _within(report.torques, asked):
                texts = [f"{low} to {high} bits" for low, high in asked]
                yield Violation(
                    "obeyed",
                    f"drives of {robot} gave {report.torques[0]} and {report.torques[1]} bits; "
                    f"their owner commanded {texts[0]} and {texts[1]}",
                )
                break
    yield from _robots_obey_drives(case)


def _asked(commands: list[tuple[int, Command]], since_ns: int) -> tuple[tuple[int, int], tuple[int, int]]:
    """Returns for both wheels the least and the largest torque commanded since an instant, zero among them [bits]."""
    first = max(0, len(commands) - RECENT)
    while first > 0 and commands[first - 1][0] > since_ns:
        first -= 1
    right = [0, *(told.right for _, told in commands[first:])]
    left = [0, *(told.left for _, told in commands[first:])]
    return (min(right), max(right)), (min(left), max(left))


def _within(torques: tuple[int, int], asked: tuple[tuple[int, int], tuple[int, int]]) -> bool:
    """Returns whether the torques of both wheels lie in their bounds, but for a rounded bit."""
    return all(low - 1 <= torque <= high + 1 for torque, (low, high) in zip(torques, asked, strict=True))


def _robots_obey_drives(case: Case) -> Iterator[Violation]:
    """The recorded torques of robots are among those that their own drives reported."""
    recording = case.evidence.recovered or case.evidence.recording
    if recording is None:
        return
    for robot, states in recording.states.items():
        reported = [{0, *(one.torques[wheel] for one in case.reports.get(robot, []))} for wheel in (0, 1)]
        for state in states:
            for wheel in (0, 1):
                bits = state.values[9 + wheel] / TORQUE_SCALE
                if round(bits) not in reported[wheel] or abs(bits - round(bits)) > 0.001:
                    yield Violation(
                        "obeyed", f"{robot} moved with {bits:.1f} bits at {state.time_ns / 1e9:g} s, no report"
                    )
                    return


def log_is_the_wire(case: Case) -> Iterator[Violation]:
    """can.log has the frames that were on the wire, in their order and at their times."""
    if not case.complete or case.evidence.can_log is None:
        return
    log, heard = case.evidence.can_log, case.owned
    here = {done.port for done in case.evidence.done if done.hit.origin == "here"}
    others = Counter((frame.can_id, frame.data) for frame in case.evidence.heard.frames if frame.sender[1] in here)
    cut_ns = _last_certain(case)
    if others:  # what others on this host sent was on the wire, too
        log = _own(log, heard, others)
    for can_id in sorted({frame.can_id for frame in heard}):
        on_wire = [frame for frame in heard if frame.can_id == can_id]
        logged = [line for line in log if line.can_id == can_id]
        different = next(
            (at for at, (frame, line) in enumerate(zip(on_wire, logged, strict=False)) if frame.data != line.data), None
        )
        if different is not None:
            yield Violation("can.log", f"frame {different} of {can_id:03X} is another one than on the wire")
            return
        if len(logged) > len(on_wire):
            yield Violation("can.log", f"{len(logged)} frames of {can_id:03X}, {len(on_wire)} on the wire")
            return
        lost = sum(frame.time_ns < cut_ns for frame in on_wire[len(logged) :])
        # In virtual time a frame has a time when its instant is over, so one that broke off is in no log.
        unfinished = not case.wall and case.evidence.code == 3
        if lost > unfinished:
            yield Violation("can.log", f"lacks {lost} frames of {can_id:03X} that were on the wire")
            return
    if case.wall:
        yield from _times(case, log, heard)


def _own(log: list[Logged], heard: list[Frame], others: Counter[tuple[int, bytes]]) -> list[Logged]:
    """Returns the lines of a log without those frames of others that are not, in their place, the run's own."""
    expected: dict[int, deque[bytes]] = {}
    for frame in heard:
        expected.setdefault(frame.can_id, deque()).append(frame.data)
    own, left = [], others.copy()
    for line in log:
        awaited = expected.get(line.can_id)
        if awaited and awaited[0] == line.data:
            awaited.popleft()
            own.append(line)
        elif left[line.can_id, line.data] > 0:
            left[line.can_id, line.data] -= 1
        else:
            own.append(line)  # of nobody
    return own


def _last_certain(case: Case) -> int:
    """Returns until when frames must be in the log [ns since 1970]."""
    if any(done.hit.kind == "full_disk" for done in case.evidence.done):
        return 0
    # What drives say after the bridge's last period is in nobody's log: the bridge has ended.
    last_ns = max((ns for heard in case.commands.values() for ns, _ in heard), default=0)
    ends = [last_ns - PERIOD_NS - case.evidence.heard.lateness_ns(last_ns - WATCHDOG_NS, last_ns)]
    for done, begun_ns, _ in case.silences():
        if done.hit.target in ("bridge", "drives", "recorder", "supervisor", "group"):
            ends.append(begun_ns - LOST_NS)
    return min(ends)


def _times(case: Case, log: list[Logged], heard: list[Frame]) -> Iterator[Violation]:
    """The times in can.log are those of the wire, but for one shift of the clock, and for what the machine delayed.

    Of frames that the bridge sends each is judged; those of drives have the time at which the bridge gets to them, so a tenth
    of them may be off on a busy machine.  It is not asked of the bring-up, in which processes are busy with their start."""
    by_id: dict[int, list[Frame]] = {}
    for frame in heard:
        by_id.setdefault(frame.can_id, []).append(frame)
    places = dict.fromkeys(by_id, 0)
    shifts: list[tuple[int, int, Logged]] = []
    for line in log:
        at = places.get(line.can_id)
        if at is not None and at < len(by_id[line.can_id]):
            wire_ns = by_id[line.can_id][at].time_ns
            shifts.append((wire_ns - line.time_ns, wire_ns, line))
            places[line.can_id] = at + 1
    shifts = [shift for shift in shifts if case.run_ns is not None and shift[1] >= case.run_ns[0]]
    if not shifts:
        return
    usual = sorted(shift for shift, _, _ in shifts)[len(shifts) // 2]
    for sent in (True, False):
        those = [one for one in shifts if (one[2].can_id < FEEDBACK_ID) is sent]
        off = [one for one in those if abs(one[0] - usual) > SHIFT_NS + _delayed_ns(case, one[1])]
        if len(off) > (0 if sent else len(those) // 10):
            shift, _, line = max(off, key=lambda one: abs(one[0] - usual))
            off_ms = round((shift - usual) / 1e6)
            what = f"{line.can_id:03X} at {line.time_ns / 1e9:.3f} s was on the wire {abs(off_ms)} ms"
            yield Violation("can.log", f"{what} {'later' if off_ms > 0 else 'earlier'}, one of {len(off)}")


def _delayed_ns(case: Case, at_ns: int) -> int:
    """Returns by how much a process was late at most around an instant [ns]."""
    return case.evidence.heard.lateness_ns(at_ns - 2 * SHIFT_NS, at_ns + 2 * SHIFT_NS)
