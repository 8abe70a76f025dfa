"""The bridge on the closed torque path, as a role (docs/architecture.md, 5.2).

It has two stages in each torque period:

stage    what it does
hear     takes the drives' feedback of this instant; tells the robots the torques of their wheels in the period that ends
send     puts the robots' new torques through the envelope, has the hosts make frames of them, and lets the models of the
         buses carry them until the next period; tells the drives each frame with its instant

Feedback is a sample of its instant.  The plant uses it without the time that the frame spends on the bus, since the shaft of
a motor needs no bus.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np

from echelon.bridge.frame_message import BACK, BRIDGE_NODE, EMPTIED, NO_BUS, OFF, TimedFrame, pack, unpack
from echelon.bridge.protocols.checked import those_at_rest_first
from echelon.bridge.protocols.frame import Frame, Host
from echelon.bridge.protocols.registry import drive_places, make_host, make_masters
from echelon.bridge.reports import WheelsReport
from echelon.bridge.roles.envelope import Envelope
from echelon.bridge.timing.arbitration import ArbitratedBus
from echelon.bridge.timing.bus_load import worst_case_bits
from echelon.bridge.timing.bus_model import BusEventKind
from echelon.bridge.timing.buses import make_buses
from echelon.bridge.timing.disturbances import Disturbances
from echelon.bridge.timing.ideal_bus import IdealBus
from echelon.bridge.timing.schedule import Schedule
from echelon.errors import PartRunError
from echelon.messages import TORQUE_FIELDS, Channel, Heard, Message
from echelon.plan.plan import Plan, RobotPlan
from echelon.role import Input, Stage
from echelon.runtime.turns import Turn

_COMMANDED: Final = TORQUE_FIELDS.index("commanded")
_SATURATED: Final = TORQUE_FIELDS.index("saturated")
NOT_COMMANDED: Final = "no command"
"""The reason for a zero torque if the robot had no command, or if no fresh torque came from it.  All other reasons are the
envelope's."""


def _fresh(message: Heard, time_ns: int) -> list[TimedFrame]:
    """Returns the frames of a message of this instant, none of an older message (which is held if nothing newer comes)."""
    return [] if message is None or message.time_ns != time_ns else unpack(message.values)


class RobotChannel:
    """The path of one robot's torques to its drives: envelope, then host.  Counts stopped torques by reason."""

    def __init__(self, robot: RobotPlan) -> None:
        self.robot = robot
        self.host: Host = make_host(robot)
        self.envelope = Envelope(robot.envelope)
        self.stopped: Counter[str] = Counter()
        self.commands = 0
        self.largest = 0.0
        self._was_enabled = False
        self._came_up_ns: int | None = None
        self.spoken = False
        """True once a message of the robot has come"""
        self.torque_frames = 0
        """How many of the last cycle's frames carry torques; they are the last ones of the cycle"""

    def frames(self, time_ns: int, heard: Heard) -> list[Frame]:
        """Returns the frames of one cycle: those of the host's `poll`, then torques, which are zero if none may pass."""
        host = self.host
        frames = host.poll(time_ns)
        # The first torque that a host sends to enabled drives is zero; the limits of the envelope count from there.
        enabled = host.enabled
        takes_torque, self._was_enabled = enabled and self._was_enabled, enabled
        if enabled and self._came_up_ns is None:
            self._came_up_ns = time_ns
        tau_right = tau_left = 0.0
        limited = False
        if heard is None or heard.is_null or (values := heard.values.tolist())[_COMMANDED] != 1.0:
            self.envelope.stop(time_ns)
            if self.spoken or time_ns >= self.robot.drive.watchdog_ns:  # no robot has spoken yet when a run begins
                self.stopped[NOT_COMMANDED] += 1
        elif not takes_torque:
            self.envelope.stop(time_ns)
        else:
            tau_right, tau_left, reason = self.envelope.check(time_ns, heard.time_ns, values[0], values[1])
            limited = values[_SATURATED] > 0
            if reason is not None:
                self.stopped[reason] += 1
            elif (most := max(abs(tau_right), abs(tau_left))) > self.largest:
                self.largest = most
        self.spoken |= heard is not None
        self.commands += time_ns >= 0
        commands = host.command(time_ns, tau_right, tau_left, limited)
        self.torque_frames = len(commands)
        return frames + commands if frames else commands

    def wheel_torques(self, time_ns: int) -> tuple[float, float]:
        """Returns the last reported torques [N m]; zeros if the report is older than the watchdog."""
        reported_ns = self.host.torque_ns
        if reported_ns is None or time_ns - reported_ns > self.robot.drive.watchdog_ns:
            return 0.0, 0.0
        return self.host.torque

    def stop(self, time_ns: int) -> tuple[list[Frame], BaseException | None]:
        """Returns frames that take the torque away and disable the drives, and what failed.

        If a host fails at `stop`, the frames only command zero torque; if `mirror` fails, too, there are none.  Nothing is
        raised: the other robots must be stopped, too."""
        try:
            return self.host.stop(time_ns), None
        except Exception as error:
            failure = error if isinstance(error, PartRunError) else PartRunError(f"{type(error).__name__}: {error}")
        except BaseException as error:  # of a time limit, for a host that hangs: it is asked nothing more
            return [], error
        try:
            return self.host.mirror(0.0, 0.0, False), failure
        except Exception:
            return [], failure  # now only the drives' own watchdogs take the torque away

    def report(self) -> WheelsReport:
        """Returns the report of this robot."""
        return WheelsReport(
            protocol=self.robot.drive.protocol.use,
            commands=self.commands,
            stopped=dict(sorted(self.stopped.items())),
            largest=self.largest,
            refused=dict(sorted(self.host.refused.items())),
            came_up=None if self._came_up_ns is None else self._came_up_ns / 1e9,
            enabled=self.host.enabled,
            fault=self.host.fault,
        )


class Commander:
    """The bridge's role in a plan with a closed torque path.

    `alone`: its models of the buses do not contain the drives' CAN controllers, which another process models."""

    def __init__(self, plan: Plan, *, alone: bool = False) -> None:
        bridge = plan.bridge
        assert bridge is not None
        self.index = bridge.index
        self._first_ns = bridge.first_ns
        self._period_ns = bridge.period_ns
        self.next_ns = bridge.first_ns
        """End of the last period for which frames were made"""
        self.robots = [RobotChannel(robot) for robot in plan.robots]
        self.buses: list[ArbitratedBus | IdealBus] = make_buses(plan)
        self._listeners: list[dict[int, Host]] = [{} for _ in self.buses]
        for robot in self.robots:
            listeners = self._listeners[robot.robot.drive.bus]
            listeners.update(dict.fromkeys(robot.host.identifiers, robot.host))
        self._longest_ns = [-(-worst_case_bits(8) * 1_000_000_000 // bus.bitrate) for bus in plan.can.buses]
        self._masters = make_masters(plan)
        self._places = drive_places(plan)
        self._nodes = {(place.bus, place.node) for place in self._places}
        self._estops = Schedule(event for event in plan.events if event.kind == "estop")
        self._stopped: set[int] = set()
        """Numbers of the robots under an e-stop"""
        self._disturbances = Disturbances(plan, self.buses, drives=not alone)
        self._marked_events = [0] * len(self.buses)
        """For each bus, the number of its events that `_marks` has already returned"""
        self.refused: Counter[str] = Counter()
        """Impossible frames in messages, counted by reason"""
        reports = () if plan.drives is None else (Input(plan.drives.index, Channel.FRAMES),)
        torques = tuple(Input(robot.index, Channel.TORQUE) for robot in plan.robots)
        self.stages = (
            Stage(Turn.HEAR, self._period_ns, reports, self._hear, self._first_ns),
            Stage(Turn.SEND, self._period_ns, torques, self._send, self._first_ns),
        )

    def _hear(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """The stage hear: takes the drives' frames of this instant; returns the torques of all wheels."""
        for message in heard:
            for at_ns, bus, node, frame in _fresh(message, time_ns):
                if at_ns != time_ns or (bus, node) not in self._nodes:
                    self.refused["frame of no drive"] += 1
                    continue
                model = self.buses[bus]
                if model.send(at_ns, node, frame) and not (model.is_off(node) or model.is_off(BRIDGE_NODE)):
                    self.receive(at_ns, bus, frame)
        return () if time_ns < 0 else (self.wheels(time_ns),)

    def receive(self, time_ns: int, bus: int, frame: Frame) -> None:
        """Takes a frame from a bus."""
        host = self._listeners[bus].get(frame.can_id)
        if host is not None:
            host.receive(time_ns, frame)

    def wheels(self, time_ns: int) -> Message:
        """Returns the message with the last reported torques of all wheels [N m]."""
        torques = [torque for robot in self.robots for torque in robot.wheel_torques(time_ns)]
        return Message(Channel.WHEELS, self.index, time_ns // self._period_ns, time_ns, np.array(torques))

    def _send(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        """The stage send: puts the frames of this cycle on the buses; returns all frames that they carry until the next."""
        self.next_ns = time_ns + self._period_ns
        for bus, frames in self.apply_events(time_ns):
            self._queue(time_ns, bus, frames)
        emptied = self._empty_queues(time_ns)
        for robot, message in zip(self.robots, heard, strict=True):
            self._queue(time_ns, robot.robot.drive.bus, robot.frames(time_ns, message))
        end_ns = time_ns + self._period_ns
        for bus, master in self._masters:
            self._queue(time_ns, bus, master.poll(time_ns))
        for bus, master in self._masters:
            if (sync := master.sync()) is None:
                continue
            # SYNC must end by the end of the period, when all drives sample, even if another frame has just begun.
            model = self.buses[bus]
            lead_ns = model.duration_ns(sync) + (0 if isinstance(model, IdealBus) else self._longest_ns[bus])
            self._queue(max(time_ns, end_ns - lead_ns), bus, [sync])
        carried = [
            TimedFrame(sent.end_ns, number, sent.node, sent.frame)
            for number, bus in enumerate(self.buses)
            for sent in bus.run(end_ns)
        ]
        carried += self._marks()
        carried.sort(key=lambda timed: timed.time_ns)
        sequence = (time_ns - self._first_ns) // self._period_ns
        return (Message(Channel.FRAMES, self.index, sequence, time_ns, pack(emptied + carried)),)

    def _empty_queues(self, time_ns: int) -> list[TimedFrame]:
        """Empties the queues of nodes that are bus-off, so that no old frame is sent later; returns the marks of the drives."""
        emptied = []
        for number, bus in enumerate(self.buses):
            if bus.is_off(BRIDGE_NODE):
                bus.clear(BRIDGE_NODE)
            for place in self._places:
                if place.bus == number and bus.is_off(place.node):
                    bus.clear(place.node)
                    emptied.append(TimedFrame(time_ns, NO_BUS, place.node, EMPTIED))
        return emptied

    def _marks(self) -> list[TimedFrame]:
        """Returns marks for the drives that went bus-off or came back since the last call."""
        marks = []
        for number, bus in enumerate(self.buses):
            for time_ns, node, kind, _ in bus.events[self._marked_events[number] :]:
                mark = {BusEventKind.OFF: OFF, BusEventKind.RECOVERED: BACK}.get(kind)
                if mark is not None and node != BRIDGE_NODE:
                    marks.append(TimedFrame(time_ns, NO_BUS, node, mark))
            self._marked_events[number] = len(bus.events)
        return marks

    def bus_frames(self, time_ns: int) -> list[tuple[int, list[Frame]]]:
        """Returns for a wall clock the frames that a bus carries once per period, with its number: SYNC and heartbeats."""
        frames = []
        for bus, master in self._masters:
            sync = master.sync()
            frames.append((bus, [*([] if sync is None else [sync]), *master.poll(time_ns)]))
        return frames

    def reported_since(self, time_ns: int) -> bool:
        """Returns whether the drives of every robot have reported their torques since an instant."""
        return all(robot.host.torque_ns is not None and robot.host.torque_ns >= time_ns for robot in self.robots)

    def _queue(self, time_ns: int, bus: int, frames: list[Frame]) -> None:
        for frame in frames:
            self.buses[bus].send(time_ns, BRIDGE_NODE, frame)  # the model counts a frame that finds its queue full

    def in_order_of_stopping(self) -> list[list[int]]:
        """Returns the numbers of the robots, in the groups in which they are to be stopped (`those_at_rest_first`)."""
        return those_at_rest_first((number, robot.host) for number, robot in enumerate(self.robots))

    def stop(self, time_ns: int, robots: Sequence[int]) -> tuple[list[TimedFrame], BaseException | None]:
        """Returns frames that take the torque away from the wheels of some robots and disable their drives, and what failed
        first."""
        frames, failure = list[TimedFrame](), None
        for robot in (self.robots[number] for number in robots):
            made, failed = robot.stop(time_ns)
            frames += [TimedFrame(time_ns, robot.robot.drive.bus, BRIDGE_NODE, frame) for frame in made]
            failure = failure or failed
        return frames, failure

    def apply_events(self, time_ns: int) -> list[tuple[int, list[Frame]]]:
        """Applies the scenario's e-stops and disturbances of this instant; returns the frames of e-stops, each with its bus."""
        frames = []
        stopped = {robot for event in self._estops.at(time_ns)[0] for robot in event.robots}
        for robot in sorted(stopped - self._stopped):
            channel = self.robots[robot]
            frames.append((channel.robot.drive.bus, channel.host.estop(time_ns)))
        for robot in self._stopped - stopped:
            self.robots[robot].host.start()
        self._stopped = stopped
        self._disturbances.apply(time_ns)
        return frames

    def reports(self) -> dict[str, WheelsReport]:
        """Returns the reports of all robots, by name."""
        return {robot.robot.name: robot.report() for robot in self.robots}
