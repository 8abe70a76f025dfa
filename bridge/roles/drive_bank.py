"""The virtual drives of a plan as a role (docs/architecture.md, 5.2).

It has two stages in each torque period:

stage     what it does
report    sends the frames of all drives at this instant: cyclic reports, and answers to earlier frames
serve     takes the frames that the buses carry until the next report, each at its instant

The wheels turn at the speeds that the robots say.  A robot takes the torque that its drives report.

On a wall clock there are no stages; `receive` and `pass_time` take frames one by one.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Final

from echelon.bridge.frame_message import BACK, BRIDGE_NODE, EMPTIED, NO_BUS, TimedFrame, pack, unpack
from echelon.bridge.protocols.faults import Fault
from echelon.bridge.protocols.frame import Drive, Frame
from echelon.bridge.protocols.registry import DrivePlace, drive_places, make_drive
from echelon.bridge.reports import DriveReport, DrivesReport
from echelon.bridge.timing.buses import lost_report
from echelon.bridge.timing.schedule import Schedule
from echelon.messages import TORQUE_FIELDS, Channel, Heard, Message
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Plan
from echelon.role import Input, Stage
from echelon.runtime.turns import Turn

_SPEED = TORQUE_FIELDS.index("speed_right")
FASTEST: Final = 1e6
"""Wheel speeds beyond this are refused [rad/s]: no wheel turns as fast"""


class PlacedDrive:
    """A drive, its place on a bus, and the frames that it has yet to send."""

    def __init__(self, plan: Plan, place: DrivePlace) -> None:
        self.place = place
        self.drive: Drive = make_drive(plan, place)
        self.outbox: list[Frame] = []
        self.waiting = 0
        """Number of sent frames that the bus has not carried yet"""
        self.lost: Counter[int] = Counter()
        """Frames that found the queue full, by identifier"""
        self.is_off = False
        """True: its CAN controller is bus-off and hears nothing"""

    def take(self, time_ns: int, frame: Frame) -> None:
        """Takes a frame from the bus; answers are sent with the next report."""
        self.outbox += self.drive.advance(time_ns)
        self.outbox += self.drive.receive(time_ns, frame)

    def take_mark(self, mark: Frame) -> None:
        """Takes a mark of the bridge about the drive's CAN controller (bridge.frame_message)."""
        self.is_off = mark != BACK
        if mark == EMPTIED:
            self.waiting = 0


class DriveBank:
    """All virtual drives of a plan, on all its buses."""

    def __init__(self, plan: Plan) -> None:
        bridge, drives = plan.bridge, plan.drives
        assert bridge is not None
        assert drives is not None
        self.index = drives.index
        self._first_ns = drives.first_ns
        self._plan = plan
        self._period_ns = drives.period_ns
        self._capacity = plan.can.queue if plan.can.timing == "bits" else 1 << 62
        self.drives = [PlacedDrive(plan, place) for place in drive_places(plan)]
        self._listeners: list[dict[int, list[PlacedDrive]]] = [{} for _ in plan.can.buses]
        for placed in self.drives:
            for can_id in placed.drive.identifiers:
                self._listeners[placed.place.bus].setdefault(can_id, []).append(placed)
        self._schedule = Schedule(event for event in plan.events if event.kind == "drive_fault")
        self._faults: set[tuple[int, int, str]] = set()
        """The scenario's faults that are active: robot, wheel, fault"""
        self.refused: Counter[str] = Counter()
        """Impossible values in messages, counted by reason"""
        self._events_ns = drives.first_ns - 1
        self.next_ns = drives.first_ns
        """End of the last period that was served"""
        self._of_robot: list[list[PlacedDrive]] = [[] for _ in plan.robots]
        for placed in self.drives:
            self._of_robot[placed.place.robot].append(placed)
        carried = Input(bridge.index, Channel.FRAMES)
        torques = [Input(robot.index, Channel.TORQUE) for robot in plan.robots]
        self.stages = (
            Stage(Turn.REPORT, self._period_ns, (), self._report, self._first_ns),
            Stage(Turn.SERVE, self._period_ns, (carried, *torques), self._serve, self._first_ns),
        )

    def _report(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """The stage report: returns the frames that all drives send at this instant."""
        self.apply_events(time_ns)
        said = []
        for placed in self.drives:
            frames = placed.outbox + placed.drive.advance(time_ns)
            placed.outbox = []
            room = max(0, self._capacity - placed.waiting)
            placed.lost.update(frame.can_id for frame in frames[room:])
            for frame in frames[:room]:
                placed.waiting += 1
                said.append(TimedFrame(time_ns, placed.place.bus, placed.place.node, frame))
        sequence = (time_ns - self._first_ns) // self._period_ns
        return (Message(Channel.FRAMES, self.index, sequence, time_ns, pack(said)),)

    def _serve(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """The stage serve: gives the drives the frames that the buses carry until the next report."""
        self.next_ns = time_ns + self._period_ns
        frames, *robots = heard
        for message in robots:
            if message is not None:
                self.turn(time_ns, message)
        # A message of an earlier instant is held if nothing newer comes; its frames were served then.
        for timed in unpack(frames.values) if frames is not None and frames.time_ns == time_ns else ():
            if not (time_ns <= timed.time_ns <= time_ns + self._period_ns and timed.node <= len(self.drives)):
                self.refused["frame of no bus"] += 1
            elif timed.node == BRIDGE_NODE:
                if timed.bus < len(self._listeners):
                    self._deliver(timed.time_ns, timed.bus, timed.frame)
            elif timed.bus == NO_BUS:
                self.drives[timed.node - 1].take_mark(timed.frame)
            else:
                self.drives[timed.node - 1].waiting -= 1
        return ()

    def _deliver(self, time_ns: int, bus: int, frame: Frame) -> None:
        """Gives a frame to all drives that listen to it and are not bus-off."""
        for placed in self._listeners[bus].get(frame.can_id, ()):
            if not placed.is_off:
                placed.take(time_ns, frame)

    # on a wall clock, frame by frame:

    @property
    def due_ns(self) -> int:
        """When `pass_time` must be called next: a drive or an event is due then."""
        return min([placed.drive.due_ns for placed in self.drives] + [self._next_event_ns])

    @property
    def turning(self) -> bool:
        """Whether any wheel has torque."""
        return any(motor.torque != 0.0 for placed in self.drives for motor in placed.drive.motors)

    def turn(self, time_ns: int, message: Message) -> None:
        """Sets the wheel speeds of a robot from its message; a null message changes nothing."""
        if message.is_null:
            return
        for placed in self._of_robot[message.source]:
            placed.outbox += placed.drive.advance(time_ns)  # everything before happens at the old speed
            for motor, wheel in zip(placed.drive.motors, placed.place.wheels, strict=True):
                speed = float(message.values[_SPEED + wheel])
                if abs(speed) <= FASTEST:
                    motor.set_speed(time_ns, speed)
                else:  # the robot's state has diverged
                    self.refused["speed"] += 1

    def receive(self, time_ns: int, bus: int, frame: Frame) -> list[TimedFrame]:
        """Takes a frame from a bus; returns the drives' answers."""
        self._deliver(time_ns, bus, frame)
        return self._emptied(time_ns)

    def pass_time(self, time_ns: int) -> list[TimedFrame]:
        """Lets time pass; returns the frames that the drives send by themselves."""
        if time_ns >= self._next_event_ns:
            self.apply_events(time_ns)
        for placed in self.drives:
            if placed.drive.due_ns <= time_ns:
                placed.outbox += placed.drive.advance(time_ns)
        return self._emptied(time_ns)

    def _emptied(self, time_ns: int) -> list[TimedFrame]:
        said = []
        for placed in self.drives:
            if placed.outbox:
                said += [TimedFrame(time_ns, placed.place.bus, placed.place.node, frame) for frame in placed.outbox]
                placed.outbox = []
        return said

    @property
    def _next_event_ns(self) -> int:
        next_ns = self._schedule.next_ns(self._events_ns)
        return NEVER_NS if next_ns is None else next_ns

    def apply_events(self, time_ns: int) -> None:
        """Begins and ends the scenario's drive faults that are due."""
        self._events_ns = time_ns
        active, _ = self._schedule.at(time_ns)
        faults = {(robot, wheel, event.fault) for event in active for robot in event.robots for wheel in event.wheels}
        for robot, wheel, fault in sorted(faults - self._faults):
            placed = self._drive_of(robot, wheel)
            placed.outbox += placed.drive.inject(time_ns, wheel, Fault(fault))
        for robot, wheel, fault in sorted(self._faults - faults):
            self._drive_of(robot, wheel).drive.mend(time_ns, wheel, Fault(fault))
        self._faults = faults

    def _drive_of(self, robot: int, wheel: int) -> PlacedDrive:
        return next(placed for placed in self._of_robot[robot] if wheel in placed.place.wheels)

    def report(self) -> DrivesReport:
        """Returns the report of all drives; its `buses` hold the frames that were lost before they reached a bus."""
        lost: list[Counter[int]] = [Counter() for _ in self._plan.can.buses]
        for placed in self.drives:
            lost[placed.place.bus] += placed.lost
        return DrivesReport(
            robots={robot.name: self._robot_report(robot.index) for robot in self._plan.robots},
            refused=dict(self.refused),
            buses=tuple(lost_report(self._plan, number, of_bus) for number, of_bus in enumerate(lost)),
        )

    def _robot_report(self, robot: int) -> DriveReport:
        placed = self._of_robot[robot]
        return DriveReport(
            refused=sum((one.drive.refused for one in placed), Counter[str]()),
            lost=sum(one.lost.total() for one in placed),
            temperature=max(0.0, *(motor.temperature for one in placed for motor in one.drive.motors)),
        )
