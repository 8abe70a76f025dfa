"""The referee: a passive listener to all buses of a plan, which sees nothing but frames and holds them against the plan.

What protocols ask for, their observers check (bridge.<protocol>.observe).  The referee adds what they share.  Kinds:

    time          a frame is older than the one before it on its bus
    gap           a cyclic frame came more than half a period after it was due (or more than `tolerance_ns`)
    silent        it did not come at all for a watchdog and a period, or at the end
    missing       nothing at all came of an identifier, or of a robot
    burst         a cyclic frame came more than half a period before it was due, and nothing was owed
    torque above limit, rise above limit, fall above limit, window above limit
                  commanded or reported, beyond the envelope by more than a bit; a command may be zero at any time
    torque not commanded
                  reported, but beyond all commands of the time in which they can have had an effect
    torque before the run
                  commanded or reported while drives are brought up, at negative times

`bridge.referee.deadlines` says when frames are due.  A frame that waits for the bus is not late, and no frame is late while
drives are brought up.  For the same reason feedback may be as old as the stretch of frames that it came in.

Identifiers that no robot of the plan uses are foreign traffic, which is legal: counted, not judged.  Where the torque path
is not closed there are torques alone, one per acceleration period, and nobody answers.
"""

from collections import Counter
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Final

from echelon.bridge.can.canlog import Logged, read_log
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.observe import Finding, Observer
from echelon.bridge.protocols.registry import protocol_of, shared_cyclic
from echelon.bridge.referee.deadlines import Lane
from echelon.bridge.referee.wheel_check import WheelCheck
from echelon.bridge.reports import FindingReport, RefereeReport
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Plan

KEPT: Final = 100
"""Findings that a report holds in full"""
WAIT_NS: Final = 1_000_000_000
"""Feedback is taken to have waited for the bus no longer than this"""
SCAN_NS: Final = 50_000_000
"""How often it is looked for identifiers that are silent"""


class Referee:
    """Listens to the buses of a plan.  Times are run times [ns]; times below zero are the bringing up of drives.

    `tolerance_ns` is how late a cyclic frame may be, half its period unless given, and how early if that is more; live,
    where processes wait for their turn, give more.  Raises ValueError for a negative one.  `late`: drives may have been
    enabled before anybody listened.
    """

    def __init__(self, plan: Plan, *, tolerance_ns: int | None = None, late: bool = False) -> None:
        if tolerance_ns is not None and tolerance_ns < 0:
            raise ValueError(f"tolerance must be 0 ns or more, not {tolerance_ns!r}")
        self.plan = plan
        self.frames = 0
        self.unknown = 0
        """Frames with identifiers that no robot of the plan uses"""
        self.kinds: Counter[str] = Counter()
        self.kept: list[FindingReport] = []
        """The first findings"""
        self.robots = [WheelCheck(plan, robot, tolerance_ns or 0) for robot in plan.robots]
        self._late = late
        self._silence_ns = plan.can.watchdog_ns
        self._lanes = [Lane(plan, bus) for bus in range(len(plan.can.buses))]
        for robot in self.robots:
            lane = self._lanes[robot.plan.drive.bus]
            for can_id in sorted(robot.observer.identifiers):
                watch = lane.add(can_id, robot.cyclic.get(can_id, 0), tolerance_ns)
                watch.robots += (robot,)
                watch.asked_empty = plan.can.closed and protocol_of(robot.plan).empty_asks
        if plan.can.closed:
            for bus, can_id, period_ns in shared_cyclic(plan):
                self._lanes[bus].add(can_id, period_ns, tolerance_ns)
            for robot in self.robots:
                self._lanes[robot.plan.drive.bus].add_boot_ups(protocol_of(robot.plan).boot_ups(robot.plan.drive))

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
        untimely = watch.take(time_ns, begin_ns, lane.busy_ns, frame)
        if lane.boot_ups and (anew := lane.boot_ups.get((frame.can_id, frame.data))):
            untimely = None
            for other in anew:
                other.forget()
        sampled_ns = max(lane.busy_ns, time_ns - WAIT_NS)
        for robot in watch.robots:
            found = robot.observer.observe(time_ns, frame)
            for finding in found:
                unheard = self._late and watch.frames == 1 and finding.kind == "enabled unasked"
                waited = finding.kind == "torque after silence" and not robot.silent(sampled_ns)
                if not unheard and not waited:
                    said.append(self._tell(bus, robot, finding))
            more, stops = robot.check(time_ns, sampled_ns)
            if stops and untimely is not None and untimely[0] == "burst":
                untimely = None
            for kind, text in more:
                if not any(finding.kind == kind for finding in found):
                    said.append(self._tell(bus, robot, Finding(time_ns, frame.can_id, kind, text)))
        if untimely is not None and time_ns >= 0:
            said.append(self._tell(bus, watch.robot, Finding(time_ns, frame.can_id, *untimely)))
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

    def report(self, source: str = "can.log") -> RefereeReport:
        """Returns what was seen and found; `source` is what it listened to."""
        names = [bus.name for bus in self.plan.can.buses]
        return RefereeReport(
            frames=self.frames,
            unknown=self.unknown,
            kinds=dict(sorted(self.kinds.items())),
            findings=tuple(self.kept),
            identifiers={
                f"{name}:{watch.can_id:03X}": watch.report()
                for name, lane in zip(names, self._lanes, strict=True)
                for watch in sorted(lane.watches.values(), key=lambda watch: watch.can_id)
                if watch.frames
            },
            source=source,
        )

    def _scan(self, time_ns: int, bus: int, can_id: int | None = None, ended: bool = False) -> Iterator[Finding]:
        """Tells which cyclic identifiers are silent, but for the one that has just come."""
        lane = self._lanes[bus]
        for watch in lane.cyclic():
            expected_ns = watch.expected_ns
            if expected_ns is None or watch.silent or watch.can_id == can_id:
                continue
            tolerance_ns = watch.tolerance_ns
            if not ended:
                tolerance_ns = max(tolerance_ns, self._silence_ns + watch.period_ns)
            late_ns = lane.busy_ns - expected_ns
            if late_ns > tolerance_ns:
                watch.silent = True
                text = f"nothing for {(late_ns + watch.period_ns) / 1e6:.4g} ms, its period is {watch.period_ns / 1e6:g} ms"
                yield self._tell(bus, watch.robot, Finding(time_ns, watch.can_id, "silent", text))

    def _tell(self, bus: int, robot: WheelCheck | None, finding: Finding) -> Finding:
        self.kinds[finding.kind] += 1
        if len(self.kept) < KEPT:
            self.kept.append(
                FindingReport(
                    time=finding.time_ns / 1e9,
                    bus=self.plan.can.buses[bus].name,
                    id=f"{finding.can_id:03X}",
                    kind=finding.kind,
                    text=finding.text,
                    robot=robot.name if robot is not None else "",
                )
            )
        return finding


def judge_log(path: Path, plan: Plan, *, tolerance_ns: int | None = None, whole: bool = True) -> RefereeReport:
    """Returns the referee's report on a run's can.log.  One that ends before the run should is silence, if it is `whole`.

    Raises OSError if it cannot be read."""
    referee = Referee(plan, tolerance_ns=tolerance_ns)
    last_ns = 0
    for time_ns, bus, frame in read_run_log(path, plan):
        last_ns = time_ns
        referee.observe(time_ns, bus, frame)
    referee.finish(max(last_ns, plan.duration_ns) if whole else last_ns)
    return referee.report()


def read_run_log(path: Path, plan: Plan) -> Iterator[tuple[int, int, Frame]]:
    """Yields run time [ns], number of the bus and frame from a run's can.log; buses that the plan lacks are passed over."""
    return of_run(read_log(path), plan)


def of_run(logged: Iterable[Logged], plan: Plan) -> Iterator[tuple[int, int, Frame]]:
    """Yields run time [ns], number of the bus and frame of what is in a run's can.log."""
    numbers = {bus.name: number for number, bus in enumerate(plan.can.buses)}
    start_ns = plan.can.bring_up_ns if plan.can.closed else 0
    for time_ns, channel, frame in logged:
        if (number := numbers.get(channel)) is not None:
            yield time_ns - start_ns, number, frame
