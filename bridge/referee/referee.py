"""The referee: a passive listener to all buses of a plan, which compares the frames with the plan (docs/architecture.md, 5.7).

The observer of a protocol (bridge.protocols.<protocol>.observe) checks what its protocol demands.  The referee checks what all
protocols have in common:

kind of finding                     meaning
time                                a frame is older than the one before it on its bus
gap                                 a cyclic frame began more than half a period (or `tolerance_ns`) after it was due
silent                              a cyclic frame did not come for a watchdog and a period, or up to the end
missing                             no frame came with a cyclic identifier, or from a robot
burst                               a cyclic frame came more than half a period early, without a reason
torque above limit                  a reported torque exceeds the envelope by more than a bit; observers check commands
rise, fall or window above limit    a change of the commanded torque exceeds the envelope by more than a bit; a command may
                                    go to zero at any time
torque not commanded                a reported torque is outside all commands that may still have an effect
torque before the run               a torque was commanded or reported before run time 0

`bridge.referee.deadlines` says when frames are due.  A frame that waits for the bus is not late, and no frame is late before
run time 0.  Feedback may have waited for the bus, too: it may be as old as the busy stretch that it came in.

Frames with identifiers that no robot of the plan uses are counted but not judged.  On the mirrored path there are only torque
commands, one per acceleration period.
"""

from collections import Counter
from collections.abc import Iterator
from typing import Final

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.observe import Finding, Observer
from echelon.bridge.protocols.registry import protocol_of, shared_cyclic
from echelon.bridge.referee.deadlines import BusTraffic
from echelon.bridge.referee.wheel_check import WheelCheck
from echelon.bridge.referee_reports import FindingReport, RefereeReport
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Plan

KEPT: Final = 100
"""How many findings a report holds in full"""
WAIT_NS: Final = 1_000_000_000
"""The longest time that feedback is assumed to wait for the bus"""
SCAN_NS: Final = 50_000_000
"""The interval of the search for silent identifiers"""


class Referee:
    """Listens to the buses of a plan.  Times are run times [ns], negative while drives are brought up.

    `tolerance_ns` is how late a cyclic frame may be; None means half its period.  A frame may be early by the larger of both.
    A referee that listens live needs more tolerance, since processes wait for a processor.  `late` says that the drives may
    have been enabled before the referee began to listen.  Raises ValueError for a negative tolerance.
    """

    def __init__(self, plan: Plan, *, tolerance_ns: int | None = None, late: bool = False) -> None:
        if tolerance_ns is not None and tolerance_ns < 0:
            raise ValueError(f"tolerance must be 0 ns or more, not {tolerance_ns!r}")
        self.plan = plan
        self.frames = 0
        self.unknown = 0
        """Number of frames with identifiers that no robot of the plan uses"""
        self.kinds: Counter[str] = Counter()
        """Number of findings by kind"""
        self.kept: list[FindingReport] = []
        """The first findings"""
        self.robots = [WheelCheck(plan, robot, tolerance_ns or 0) for robot in plan.robots]
        self.late = late
        self.over = False
        """True after `rest`"""
        self._silence_ns = plan.can.watchdog_ns
        self._torn = self._was_torn = False
        self._blind_until_ns = -NEVER_NS
        self._blind_ns = max((robot.memory_ns for robot in self.robots), default=0)
        self._buses = [BusTraffic(plan, bus) for bus in range(len(plan.can.buses))]
        for robot in self.robots:
            traffic = self._buses[robot.plan.drive.bus]
            for can_id in sorted(robot.observer.identifiers):
                deadline = traffic.add(can_id, robot.cyclic.get(can_id, 0), tolerance_ns)
                deadline.robots += (robot,)
                deadline.asked_empty = plan.can.closed and protocol_of(robot.plan).empty_asks
        if plan.can.closed:
            for bus, can_id, period_ns in shared_cyclic(plan):
                self._buses[bus].add(can_id, period_ns, tolerance_ns)
            for robot in self.robots:
                self._buses[robot.plan.drive.bus].add_boot_ups(protocol_of(robot.plan).boot_ups(robot.plan.drive))

    @property
    def observers(self) -> list[Observer]:
        """The observers of all robots, by the robots' numbers."""
        return [robot.observer for robot in self.robots]

    def observe(self, time_ns: int, bus: int, frame: Frame) -> list[Finding]:
        """Takes a frame of bus number `bus`; returns the findings: faults of the frame, and identifiers that are silent by now.

        Raises ValueError for a bus that the plan does not have."""
        if not 0 <= bus < len(self._buses):
            raise ValueError(f"bus must be 0 .. {len(self._buses) - 1}, not {bus!r}")
        traffic = self._buses[bus]
        self.frames += 1
        if self._torn:
            self._begin_anew(time_ns)
        said: list[Finding] = []
        if time_ns < traffic.last_ns:
            text = f"{(traffic.last_ns - time_ns) / 1e6:g} ms before the frame before it"
            said.append(self._tell(bus, None, Finding(time_ns, frame.can_id, "time", text)))
            time_ns = traffic.last_ns
        begin_ns = time_ns - traffic.durations_ns[min(len(frame.data), 8)]
        if begin_ns > traffic.last_ns + traffic.pause_ns:
            traffic.busy_ns = begin_ns
        traffic.last_ns = time_ns
        if time_ns >= traffic.scan_ns:
            traffic.scan_ns = time_ns + SCAN_NS
            if time_ns >= 0:
                said += self._scan(time_ns, bus, frame.can_id)
        deadline = traffic.deadlines.get(frame.can_id)
        if deadline is None:
            self.unknown += 1
            return said
        untimely = deadline.take(time_ns, begin_ns, traffic.busy_ns, frame)
        if traffic.boot_ups and (anew := traffic.boot_ups.get((frame.can_id, frame.data))):
            untimely = None
            for other in anew:
                other.forget()
        sampled_ns = max(traffic.busy_ns, time_ns - WAIT_NS)
        for robot in deadline.robots:
            found = robot.observer.observe(time_ns, frame)
            for finding in found:
                unheard = self.late and deadline.frames == 1 and finding.kind == "enabled unasked"
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
            said.append(self._tell(bus, deadline.robot, Finding(time_ns, frame.can_id, *untimely)))
        return said

    def tear(self) -> None:
        """Says that frames were on the buses that the referee does not get, for example since a line of a log is damaged.

        What may come of that is no finding.  So it finds nothing until it knows again what went before."""
        self._torn = self._was_torn = True

    def _begin_anew(self, time_ns: int) -> None:
        """Forgets when frames are due, and finds nothing for a while."""
        self._torn = False
        self._blind_until_ns = time_ns + self._blind_ns
        for traffic in self._buses:
            for deadline in traffic.deadlines.values():
                deadline.forget()

    def rest(self) -> None:
        """Says that what comes from now on is the end of a run, such as its own stop of the wheels: it is no finding."""
        self.over, self._blind_until_ns = True, NEVER_NS

    def finish(self, time_ns: int, cut: bool = False) -> list[Finding]:
        """Ends the listening at `time_ns`; returns findings for the identifiers that are silent then or never came.

        `cut`: the frames may end within a run, some earlier than others.  What is late then is silent only after a watchdog and
        a period, as while a run goes on, and where no frame came at all nothing is missing."""
        said: list[Finding] = []
        time_ns = max(time_ns, *(traffic.last_ns for traffic in self._buses))
        if self._torn:
            self._begin_anew(time_ns)
        for traffic in self._buses:
            if time_ns > traffic.last_ns + traffic.pause_ns:
                traffic.busy_ns = time_ns
        begin_ns = min((traffic.first_ns for traffic in self._buses if traffic.first_ns is not None), default=-NEVER_NS)
        for bus, traffic in enumerate(self._buses):
            said += self._scan(time_ns, bus, ended=not cut)
            unheard = {robot.name for robot in self.robots if robot.plan.drive.bus == bus} - {
                robot.name
                for deadline in traffic.deadlines.values()
                if deadline.frames
                for robot in deadline.robots[:1]
            }
            for deadline in traffic.deadlines.values():
                if (
                    not deadline.period_ns
                    or deadline.frames
                    or self._was_torn
                    or (cut and begin_ns == -NEVER_NS)
                    or time_ns - begin_ns < 2 * deadline.period_ns + deadline.half_ns
                ):
                    continue
                robot, text = deadline.robot, "never came"
                if robot is not None and robot.name in unheard:
                    if deadline.can_id != min(robot.cyclic):
                        continue
                    text = "nothing came, of this identifier or any other of the robot's"
                said.append(self._tell(bus, robot, Finding(time_ns, deadline.can_id, "missing", text)))
        return said

    def report(self, source: str = "can.log") -> RefereeReport:
        """Returns the report; `source` says where the frames came from: `can.log`, or `bus`."""
        names = [bus.name for bus in self.plan.can.buses]
        return RefereeReport(
            frames=self.frames,
            unknown=self.unknown,
            kinds=dict(sorted(self.kinds.items())),
            findings=tuple(self.kept),
            identifiers={
                f"{name}:{deadline.can_id:03X}": deadline.report()
                for name, traffic in zip(names, self._buses, strict=True)
                for deadline in sorted(traffic.deadlines.values(), key=lambda deadline: deadline.can_id)
                if deadline.frames
            },
            source=source,
        )

    def _scan(self, time_ns: int, bus: int, can_id: int | None = None, ended: bool = False) -> Iterator[Finding]:
        """Yields a finding for each cyclic identifier that has fallen silent, except `can_id`, which has just come."""
        traffic = self._buses[bus]
        for deadline in traffic.cyclic():
            expected_ns = deadline.expected_ns
            if expected_ns is None or deadline.silent or deadline.can_id == can_id:
                continue
            tolerance_ns = deadline.tolerance_ns
            if not ended:
                tolerance_ns = max(tolerance_ns, self._silence_ns + deadline.period_ns)
            late_ns = traffic.busy_ns - expected_ns
            if late_ns > tolerance_ns:
                deadline.silent = True
                period_ns = deadline.period_ns
                text = f"nothing for {(late_ns + period_ns) / 1e6:.4g} ms, its period is {period_ns / 1e6:g} ms"
                yield self._tell(bus, deadline.robot, Finding(time_ns, deadline.can_id, "silent", text))

    def _tell(self, bus: int, robot: WheelCheck | None, finding: Finding) -> Finding:
        if finding.time_ns < self._blind_until_ns:
            return finding
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
