"""The referee: a passive listener to all buses of a plan, which sees nothing but frames and holds them against the plan.

What protocols ask for, their observers check (bridge.<protocol>.observe).  The referee adds what they share.  Kinds:

    time          a frame is older than the one before it on its bus
    gap           a cyclic frame came more than half a period after it was due (or more than `tolerance_ns`)
    silent        it did not come at all for a watchdog and a period, or at the end
    missing       nothing at all came of an identifier, or of a robot
    burst         a cyclic frame came more than half a period before it was due
    torque above limit, rise above limit, fall above limit
                  commanded or reported, beyond the envelope by more than a bit; a command may be zero at any time
    torque not commanded
                  reported, but beyond all commands of the time in which they can have had an effect
    torque before the run
                  commanded or reported while drives are brought up, at negative times

When a frame is due.  A frame waits while others have the bus, and a full bus breaks no contract.  So a frame is only late
by the time that the bus was free while it was due: from then to the beginning of the stretch of frames, one right after
the other, that it is part of.  The next is due a period after this one was, or after that beginning if this one was late.
A frame that is missing shifts all later ones by a period.  On a busy bus only a part of that can be told from waiting, so
five frames in a row that are late by 2 ms and an eighth of the period are a gap, too; nothing can be told of a bus that is
never free for so long.  Pauses shorter than a frame and an error frame count as busy, for destroyed frames are not seen.  Where a sender was held up it
may send what it owes right away: one frame for each period of the delay, before one comes at its time, is no burst.  A
remote frame asks for one more as well.  While drives are brought up periods do not count.

Identifiers that no robot of the plan uses are foreign traffic, which is legal: counted, not judged.  Where the torque path
is not closed robots send native torque frames, one per acceleration period, whatever drives they have, and nobody answers.
"""

from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import replace
from math import ceil, inf
from pathlib import Path
from typing import Any, Final

from bridge.bus_load import worst_case_bits
from bridge.canlog import read_log
from bridge.cia402.codec import HEARTBEAT_ID, HOST_NODE, SYNC_ID, TPDO_IDS
from bridge.cia402.host import heartbeat_ns
from bridge.frame import Frame
from bridge.native.observe import NativeObserver
from bridge.observe import Finding, Observer
from bridge.protocols import make_observer
from echelon.plan import NEVER_NS, Plan, RobotPlan

KEPT: Final = 100
"""Findings that the summary tells in full"""
SCAN_NS: Final = 50_000_000
"""How often it is looked for identifiers that are silent"""
SHIFT_NS: Final = 2_000_000
SHIFTED: Final = 5
"""So many frames in a row that are later than this, and than an eighth of their period, are a gap, too"""
BOOT_UP: Final = b"\0"
_ERROR_BITS: Final = 23
"""Of the longest error frame and the pause after it"""
_WHEELS: Final = ("right", "left")


class Referee:
    """Listens to the buses of a plan.  Times are run times [ns]; times below zero are the bringing up of drives.

    `tolerance_ns` is how late a cyclic frame may be, half its period unless given; live, where processes wait for their
    turn, give more.  Raises ValueError for a negative one.
    """

    def __init__(self, plan: Plan, *, tolerance_ns: int | None = None) -> None:
        if tolerance_ns is not None and tolerance_ns < 0:
            raise ValueError(f"tolerance must be 0 ns or more, not {tolerance_ns!r}")
        self.plan = plan
        self.frames = 0
        self.unknown = 0
        """Frames with identifiers that no robot of the plan uses"""
        self.kinds: Counter[str] = Counter()
        self.kept: list[dict[str, Any]] = []
        """The first findings, ready for JSON"""
        self.robots = [_Robot(plan, robot) for robot in plan.robots]
        self._tolerance_ns = tolerance_ns
        self._silence_ns = plan.can.watchdog_ns
        self._lanes = [_Lane(plan, bus) for bus in range(len(plan.can.buses))]
        for robot in self.robots:
            watches = self._lanes[robot.plan.drive.bus].watches
            for can_id in sorted(robot.observer.identifiers):
                watch = watches.setdefault(can_id, _Watch(can_id, robot.cyclic.get(can_id, 0)))
                watch.robots += (robot,)
                watch.asked_empty = plan.can.closed and robot.plan.drive.protocol == "odrive"
        if plan.can.closed:
            for bus, can_id, period_ns in _shared(plan):
                self._lanes[bus].watches[can_id] = _Watch(can_id, period_ns)
            for robot in self.robots:
                if robot.plan.drive.protocol == "cia402":
                    self._lanes[robot.plan.drive.bus].add_boot_ups(robot.plan.drive.node_ids)

    @property
    def observers(self) -> list[Observer]:
        """The robots' observers, by number."""
        return [robot.observer for robot in self.robots]

    def observe(self, time_ns: int, bus: int, frame: Frame) -> list[Finding]:
        """Takes a frame of bus number `bus`; returns what is wrong with it, or shows by its time to be missing.

        Raises ValueError for a bus that the plan does not have."""
        if not 0 <= bus < len(self._lanes):
            raise ValueError(f"bus must be 0 .. {len(self._lanes) - 1}, not {bus!r}")
        lane = self._lanes[bus]
        self.frames += 1
        said: list[Finding] = []
        if time_ns < lane.last_ns:
            text = f"{(lane.last_ns - time_ns) / 1e6:g} ms before the frame before it"
            said.append(self._tell(bus, None, Finding(time_ns, frame.can_id, "time", text)))
            time_ns = lane.last_ns
        begin_ns = time_ns - lane.durations_ns[min(len(frame.data), 8)]
        if begin_ns > lane.last_ns + lane.pause_ns:
            lane.busy_ns = begin_ns
        lane.last_ns = time_ns
        if time_ns >= lane.scan_ns:
            lane.scan_ns = time_ns + SCAN_NS
            if time_ns >= 0:
                said += self._scan(time_ns, bus, frame.can_id)
        watch = lane.watches.get(frame.can_id)
        if watch is None:
            self.unknown += 1
            return said
        if frame.data == BOOT_UP and watch.can_id in lane.boot_ups:
            for other in lane.boot_ups[watch.can_id]:
                other.forget()
        late = watch.take(time_ns, begin_ns, lane.busy_ns, frame, self._tolerance_ns)
        if late is not None and time_ns >= 0:
            said.append(self._tell(bus, watch.robot, Finding(time_ns, frame.can_id, *late)))
        for robot in watch.robots:
            found = robot.observer.observe(time_ns, frame)
            for finding in found:
                said.append(self._tell(bus, robot, finding))
            for kind, text in robot.check(time_ns):
                if not any(finding.kind == kind for finding in found):
                    said.append(self._tell(bus, robot, Finding(time_ns, frame.can_id, kind, text)))
        return said

    def finish(self, time_ns: int) -> list[Finding]:
        """Ends it; returns which identifiers were silent at `time_ns`, or missing all the time."""
        said: list[Finding] = []
        time_ns = max(time_ns, *(lane.last_ns for lane in self._lanes))
        for lane in self._lanes:
            if time_ns > lane.last_ns + lane.pause_ns:
                lane.busy_ns = time_ns
        begin_ns = min((lane.first_ns for lane in self._lanes if lane.first_ns is not None), default=-NEVER_NS)
        for bus, lane in enumerate(self._lanes):
            said += self._scan(time_ns, bus, ended=True)
            unheard = {robot.name for robot in self.robots if robot.plan.drive.bus == bus} - {
                robot.name for watch in lane.watches.values() if watch.frames for robot in watch.robots[:1]
            }
            for watch in lane.watches.values():
                if not watch.period_ns or watch.frames or time_ns - begin_ns < 2 * watch.period_ns + watch.half_ns:
                    continue
                robot, text = watch.robot, "never came"
                if robot is not None and robot.name in unheard:
                    if watch.can_id != min(robot.cyclic):
                        continue
                    text = "nothing came, of this identifier or any other of the robot's"
                said.append(self._tell(bus, robot, Finding(time_ns, watch.can_id, "missing", text)))
        return said

    def summary(self) -> dict[str, Any]:
        """Returns what was seen and found, ready for JSON; times in seconds."""
        names = [bus.name for bus in self.plan.can.buses]
        return {
            "frames": self.frames,
            "unknown": self.unknown,
            "kinds": dict(sorted(self.kinds.items())),
            "findings": list(self.kept),
            "identifiers": {
                f"{name}:{watch.can_id:03X}": watch.row()
                for name, lane in zip(names, self._lanes, strict=True)
                for watch in sorted(lane.watches.values(), key=lambda watch: watch.can_id)
                if watch.frames
            },
        }

    def _scan(self, time_ns: int, bus: int, can_id: int | None = None, ended: bool = False) -> Iterator[Finding]:
        """Tells which cyclic identifiers are silent, but for the one that has just come."""
        lane = self._lanes[bus]
        for watch in lane.cyclic():
            if watch.due_ns is None or watch.silent or watch.can_id == can_id:
                continue
            tolerance_ns = watch.half_ns if self._tolerance_ns is None else self._tolerance_ns
            if not ended:
                tolerance_ns = max(tolerance_ns, self._silence_ns + watch.period_ns)
            late_ns = lane.busy_ns - watch.due_ns
            if late_ns > tolerance_ns:
                watch.silent = True
                text = f"nothing for {(late_ns + watch.period_ns) / 1e6:.4g} ms, its period is {watch.period_ns / 1e6:g} ms"
                yield self._tell(bus, watch.robot, Finding(time_ns, watch.can_id, "silent", text))

    def _tell(self, bus: int, robot: "_Robot | None", finding: Finding) -> Finding:
        self.kinds[finding.kind] += 1
        if len(self.kept) < KEPT:
            self.kept.append(
                {
                    "time": finding.time_ns / 1e9,
                    "bus": self.plan.can.buses[bus].name,
                    "id": f"{finding.can_id:03X}",
                    "kind": finding.kind,
                    "text": finding.text,
                    "robot": robot.name if robot is not None else "",
                }
            )
        return finding


class _Lane:
    """One bus: how long its frames take at most, when the present stretch of frames began, what to look for."""

    def __init__(self, plan: Plan, bus: int) -> None:
        bit_ns = 0.0 if plan.can.closed and plan.can.timing == "ideal" else 1e9 / plan.can.buses[bus].bitrate
        self.durations_ns = [ceil(worst_case_bits(length) * bit_ns) for length in range(9)]
        self.pause_ns = self.durations_ns[8] + ceil(_ERROR_BITS * bit_ns)
        self.last_ns = -NEVER_NS
        self.busy_ns = -NEVER_NS
        self.scan_ns = -NEVER_NS
        self.watches: dict[int, _Watch] = {}
        self.boot_ups: dict[int, list[_Watch]] = {}
        """What begins anew with a CANopen boot-up message, by its identifier"""

    def add_boot_ups(self, nodes: tuple[int, int]) -> None:
        """Takes note of CANopen drives."""
        for node in nodes:
            own = [base + node for base in (*TPDO_IDS, HEARTBEAT_ID)]
            self.boot_ups[HEARTBEAT_ID + node] = [self.watches[can_id] for can_id in own if can_id in self.watches]

    @property
    def first_ns(self) -> int | None:
        """When the first known frame came."""
        return min((watch.first_ns for watch in self.watches.values() if watch.frames), default=None)

    def cyclic(self) -> list["_Watch"]:
        """Identifiers that must come regularly."""
        return [watch for watch in self.watches.values() if watch.period_ns]


class _Watch:
    """One identifier: whose it is, its period (0: it comes as it likes), when it is due."""

    __slots__ = (
        "_first_gap_ns",
        "_gaps",
        "_last_ns",
        "_longest_ns",
        "_owed",
        "_shift_ns",
        "_shifted",
        "_shortest_ns",
        "_squares",
        "_sum",
        "asked_empty",
        "can_id",
        "due_ns",
        "first_ns",
        "frames",
        "half_ns",
        "period_ns",
        "robots",
        "silent",
    )

    def __init__(self, can_id: int, period_ns: int) -> None:
        self.can_id = can_id
        self.period_ns = period_ns
        self.half_ns = period_ns // 2
        self.robots: tuple[_Robot, ...] = ()
        self.asked_empty = False
        """A frame without data asks for one, as a remote frame does"""
        self.frames = 0
        self.first_ns = 0
        self.due_ns: int | None = None
        self.silent = False  # which was told
        self._owed = 0
        self._shifted = self._shift_ns = 0  # how many frames in a row were late, by how much at least
        self._last_ns: int | None = None  # in the run
        self._gaps = self._sum = self._squares = 0  # of distances, less the first one's
        self._first_gap_ns = self._shortest_ns = self._longest_ns = 0

    @property
    def robot(self) -> "_Robot | None":
        """Whose it is, if only one's."""
        return self.robots[0] if len(self.robots) == 1 else None

    def take(
        self, time_ns: int, begin_ns: int, busy_ns: int, frame: Frame, tolerance_ns: int | None
    ) -> tuple[str, str] | None:
        """Takes a frame that began at `begin_ns`, in a stretch of frames that did at `busy_ns`; says if it is untimely."""
        if not self.frames:
            self.first_ns = time_ns
        self.frames += 1
        if frame.remote or (self.asked_empty and not frame.data):
            self._owed += 1
            return None
        if time_ns >= 0:
            self._measure(time_ns)
        if not self.period_ns:
            return None
        if self.due_ns is None or self.silent:
            self.silent = False
            self.due_ns = begin_ns + self.period_ns
            return None
        late_ns = busy_ns - self.due_ns
        if self.due_ns - begin_ns > self.half_ns:
            if self._owed:
                self._owed -= 1
                return None
            return "burst", f"{(self.due_ns - begin_ns) / 1e6:.4g} ms before it was due"
        if late_ns > (self.half_ns if tolerance_ns is None else tolerance_ns):
            told = self._late(late_ns)
            self.due_ns = busy_ns
        else:
            told = self._follow(begin_ns - self.due_ns, late_ns, tolerance_ns)
        self._owed = max(1, round(late_ns / self.period_ns)) if late_ns > self.half_ns else 0
        self.due_ns = min(self.due_ns, begin_ns) + self.period_ns
        return told

    def _follow(self, after_ns: int, late_ns: int, tolerance_ns: int | None) -> tuple[str, str] | None:
        """Keeps `due_ns` with a sender whose clock is a little slower; says if the last frames were all late."""
        assert self.due_ns is not None
        shift_ns = max(self.period_ns // 8, SHIFT_NS, tolerance_ns or 0)
        if after_ns <= shift_ns:
            self._shifted = 0
            self.due_ns += max(0, late_ns) // 8
        elif late_ns > shift_ns:  # and not within a stretch, where nobody can tell
            self._shifted += 1
            self._shift_ns = late_ns if self._shifted == 1 else min(late_ns, self._shift_ns)
            if self._shifted == SHIFTED:
                self._shifted = 0
                self.due_ns += self._shift_ns
                return self._late(self._shift_ns, f", like those before it: {SHIFTED} in a row")
        return None

    def _late(self, late_ns: int, more: str = "") -> tuple[str, str]:
        return "gap", f"{late_ns / 1e6:.4g} ms late, its period is {self.period_ns / 1e6:g} ms{more}"

    def forget(self) -> None:
        """Its sender begins anew."""
        self.due_ns, self._last_ns = None, None

    def _measure(self, time_ns: int) -> None:
        last_ns, self._last_ns = self._last_ns, time_ns
        if last_ns is None:
            return
        gap_ns = time_ns - last_ns
        if not self._gaps:
            self._first_gap_ns = self._shortest_ns = self._longest_ns = gap_ns
        self._gaps += 1
        more_ns = gap_ns - self._first_gap_ns
        self._sum += more_ns
        self._squares += more_ns * more_ns
        if gap_ns < self._shortest_ns:
            self._shortest_ns = gap_ns
        elif gap_ns > self._longest_ns:
            self._longest_ns = gap_ns

    def row(self) -> dict[str, float | None]:
        """Frames in all; of the run, the distances between them [s], `jitter` is their standard deviation."""
        count = self._gaps
        if not count:
            return {"frames": self.frames} | dict.fromkeys(("period_mean", "period_min", "period_max", "jitter"))
        variance = (count * self._squares - self._sum * self._sum) / (count * count)
        return {
            "frames": self.frames,
            "period_mean": (self._first_gap_ns + self._sum / count) / 1e9,
            "period_min": self._shortest_ns / 1e9,
            "period_max": self._longest_ns / 1e9,
            "jitter": float(variance**0.5) / 1e9,
        }


class _Robot:
    """One robot: its observer, and what its wheels were last asked for."""

    def __init__(self, plan: Plan, robot: RobotPlan) -> None:
        self.plan = robot
        self.name = robot.name
        self.envelope = robot.envelope
        if plan.can.closed:
            self.observer: Observer = make_observer(robot)
            self.cyclic = self.observer.cyclic
        else:  # no envelope is in the way, but the robot's own limit
            self.envelope = replace(self.envelope, torque_limit=robot.torque_limit, rise_limit=inf, fall_limit=inf)
            native = NativeObserver(robot.drive, self.envelope, robot.index)
            self.observer, self.cyclic = native, {min(native.identifiers): robot.period_ns}
        drive, motor = robot.drive, robot.drive.motor
        bits = {"native": drive.torque_scale, "cia402": max(1, round(1000 * motor.rated_torque)) * 1e-6, "odrive": 0.0}
        self._bit = bits[drive.protocol if plan.can.closed else "native"] * 1.000001
        slew_ns = 2e9 * motor.torque_limit / motor.torque_slew
        self._effect_ns = drive.watchdog_ns + 2 * drive.period_ns + round(1e10 * motor.lag + slew_ns)
        self._wheels = [_Commands(self._effect_ns) for _ in _WHEELS]
        self._begin_ns: int | None = None

    def check(self, time_ns: int) -> list[tuple[str, str]]:
        """Looks at what the frame that the observer has just taken said of the wheels; returns what is wrong."""
        said: list[tuple[str, str]] = []
        if self._begin_ns is None:
            self._begin_ns = time_ns
        for name, commands, reading in zip(_WHEELS, self._wheels, self.observer.wheels, strict=True):
            if reading.commanded_ns != commands.commanded_ns and reading.commanded is not None:
                commands.commanded_ns = time_ns
                if time_ns < 0 and reading.commanded:
                    said.append(("torque before the run", f"{name}: commanded {reading.commanded:g} N m"))
                self._check_change(name, commands.torque, reading.commanded, said)
                commands.add(time_ns, reading.commanded)
            if reading.reported_ns != commands.reported_ns and reading.reported is not None:
                commands.reported_ns = time_ns
                if reading.reported:
                    self._check_report(time_ns, name, commands, reading.reported, said)
        return said

    def _check_change(self, name: str, before: float | None, torque: float, said: list[tuple[str, str]]) -> None:
        rise, fall = self.envelope.rise_limit, self.envelope.fall_limit
        if before is None or not torque or rise == fall == inf:
            return
        # what both have in common: the torque falls to it, then rises from it
        common = max(0.0, min(torque, before), min(-torque, -before))
        if abs(torque) - common > rise * 1.000001 + self._bit:
            said.append(("rise above limit", f"{name}: from {before:g} to {torque:g} N m, by at most {rise:g}"))
        if abs(before) - common > fall * 1.000001 + self._bit:
            said.append(("fall above limit", f"{name}: from {before:g} to {torque:g} N m, by at most {fall:g}"))

    def _check_report(
        self, time_ns: int, name: str, commands: "_Commands", torque: float, said: list[tuple[str, str]]
    ) -> None:
        assert self._begin_ns is not None
        if abs(torque) > self.envelope.torque_limit * 1.000001 + self._bit:
            said.append(("torque above limit", f"{name}: reported {torque:g} N m"))
        if time_ns < 0 and abs(torque) > self._bit + 1e-6:
            said.append(("torque before the run", f"{name}: reported {torque:g} N m"))
        if time_ns - self._begin_ns > self._effect_ns:  # who begins to listen does not know what was before
            least, most = commands.range(time_ns)
            room = self._bit + 1e-6 + 1e-5 * max(-least, most)
            if not least - room <= torque <= most + room:
                text = f"{name}: reported {torque:g} N m, commanded were {least:g} to {most:g} N m"
                said.append(("torque not commanded", text))


class _Commands:
    """What one wheel was asked for in the time that may still have an effect."""

    def __init__(self, effect_ns: int) -> None:
        self.commanded_ns: int | None = None
        self.reported_ns: int | None = None
        self.torque: float | None = None
        self._effect_ns = effect_ns
        self._highs: deque[tuple[int, float]] = deque()  # each less than those before it
        self._lows: deque[tuple[int, float]] = deque()  # likewise, negated

    def add(self, time_ns: int, torque: float) -> None:
        """Takes a command [N m]."""
        self.torque = torque
        for window, value in ((self._highs, torque), (self._lows, -torque)):
            while window and window[-1][1] <= value:
                window.pop()
            window.append((time_ns, value))

    def range(self, time_ns: int) -> tuple[float, float]:
        """Returns the smallest and the largest torque that may still have an effect; zero always may."""
        for window in (self._highs, self._lows):
            while window and window[0][0] < time_ns - self._effect_ns:
                window.popleft()
        least = -self._lows[0][1] if self._lows else 0.0
        return min(0.0, least), max(0.0, self._highs[0][1] if self._highs else 0.0)


def _shared(plan: Plan) -> Iterator[tuple[int, int, int]]:
    """Yields what is cyclic on CANopen buses without being a robot's: bus, identifier, period [ns]."""
    for bus in sorted({robot.drive.bus for robot in plan.robots if robot.drive.protocol == "cia402"}):
        period_ns = min(robot.drive.period_ns for robot in plan.robots if robot.drive.bus == bus)
        yield bus, SYNC_ID, period_ns
        yield bus, HEARTBEAT_ID + HOST_NODE, heartbeat_ns(period_ns, plan.can.watchdog_ns)


def judge_log(path: Path, plan: Plan) -> dict[str, Any]:
    """Returns the referee's summary of a run's can.log.  A log that ends before the run should is silence.

    Raises OSError if it cannot be read."""
    referee = Referee(plan)
    last_ns = 0
    for time_ns, bus, frame in read_run_log(path, plan):
        last_ns = time_ns
        referee.observe(time_ns, bus, frame)
    referee.finish(max(last_ns, plan.duration_ns))
    return referee.summary()


def read_run_log(path: Path, plan: Plan) -> Iterator[tuple[int, int, Frame]]:
    """Yields run time [ns], number of the bus and frame from a run's can.log; buses that the plan lacks are passed over."""
    numbers = {bus.name: number for number, bus in enumerate(plan.can.buses)}
    start_ns = plan.can.bring_up_ns if plan.can.closed else 0
    for time_ns, channel, frame in read_log(path):
        if (number := numbers.get(channel)) is not None:
            yield time_ns - start_ns, number, frame
