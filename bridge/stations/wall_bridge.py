"""The bridge on a wall clock (docs/architecture.md, 5.2).

It sleeps until a frame or a torque comes, or until it is due itself.  A torque becomes frames as soon as it comes.  If none
came from a robot in a period, its last torque is sent again; the envelope turns it into zero when it is too old.
"""

from array import array
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from heapq import heappop, heappush
from pathlib import Path
from typing import Any, Final

import numpy as np

from echelon.bridge.frame_message import BRIDGE_NODE, TimedFrame, pack
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.reports import BridgeProgress, CanReport, TorqueTimes
from echelon.bridge.roles.commander import Commander
from echelon.bridge.stations.bridge import Bridge
from echelon.bridge.stations.closed import ClosedBridge
from echelon.bridge.stations.guarding import check_sender, look
from echelon.bridge.stations.paced_bus import PacedBus
from echelon.bridge.stations.waiting import AT_ONCE, Mail, RunClock, drained, last_to_send
from echelon.bridge.timing.bus_load import BitCount
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan, on_wall_clock
from echelon.runtime.fates import Fates
from echelon.runtime.wire import encode, join

FEEDBACK_SHARE: Final = 8
"""Robots get the torques of their wheels when all drives have reported, or after 1/FEEDBACK_SHARE of the period."""
OTHER_NODE: Final = 1
"""The node number of all frames from the bus: a frame does not say which drive sent it."""


class WallBridge(Bridge):
    """The bridge on a wall clock.  Times are run time by `clock`, which must be replaced when the run starts.

    `tell_wheels` sends a message as bytes to the robots.  `watch` sends a batch of messages to recorders; None: there are none.
    Robots' torques arrive in `mail`.  Raises ValueError or OSError if a bus or a file cannot be opened."""

    def __init__(
        self,
        plan: Plan,
        urls: Sequence[str],
        folder: Path,
        tell_wheels: Callable[[bytes], None],
        watch: Callable[[bytes], None] | None,
    ) -> None:
        self.plan = plan = on_wall_clock(plan)
        self._closed = ClosedBridge(plan, urls, folder, paired=True, role=Commander(plan, alone=True))
        self.url = self._closed.url
        self._role = self._closed.role
        self._sending = self._closed.rail.sending
        self._buses = [
            PacedBus(bus, model, plan.can.watchdog_ns)
            for bus, model in zip(self._closed.buses, self._role.buses, strict=True)
        ]
        assert plan.bridge is not None
        self.mail = Mail(plan, plan.bridge.index)
        self._period_ns = plan.bridge.period_ns
        self._last: list[Message | None] = [None] * len(plan.robots)
        self._sent_in = [-1 << 62] * len(plan.robots)  # number of the period in which a robot's torque was last sent
        self._cycle = -plan.can.bring_up_ns // self._period_ns
        self._told = -1
        self._frames: list[TimedFrame] = []
        self._bits = [BitCount() for _ in plan.can.buses]
        self._logged_ns = -1 << 62
        all_roles = plan.all_roles
        self._fates = [
            Fates(link, plan.seed, all_roles[link.source].name, all_roles[link.receiver].name)
            for link in plan.links
            if link.channel is Channel.TORQUE and link.receiver == plan.bridge.index
        ]
        self._flying: list[tuple[int, int, int, Message]] = []
        self.link_lost = 0
        self._awaited: dict[tuple[int, int], deque[tuple[int, int]]] = {}
        """Torque frames on their way, by bus and identifier: when each was queued, and the instant of its state"""
        self.came = 0
        self.latencies = array("q")
        self.clock = RunClock()
        self.in_time = 0
        self._messages = 0
        self.behind = False
        """More frames may have come than were read at once"""
        self._stopped = False
        """The wheels have been stopped, and nothing is sent any more"""
        self._tell_wheels, self._watch = tell_wheels, watch

    @property
    def due_ns(self) -> int:
        """When `serve` must be called even if nothing comes."""
        at_ns = self._cycle * self._period_ns
        if self._told < self._cycle - 1 and self._cycle > 0:
            at_ns += self._period_ns // FEEDBACK_SHARE - self._period_ns
        if self._flying:
            at_ns = min(at_ns, self._flying[0][0])
        return min([at_ns, *(due_ns for bus in self._buses if (due_ns := bus.due_ns) is not None)])

    @property
    def sources(self) -> list[Any]:
        """The sources to wait for with `select`: torques, and buses if their frames are needed at once.

        Feedback is needed only when a period has ended; before, it can wait for the next torque.  The model of a paced bus
        needs every frame at once."""
        listens = self._told < self._cycle - 1 or self.plan.can.paced
        return [self.mail, *(self._closed.buses if listens else ())]

    def serve(self) -> None:
        """Does everything that is due now: takes frames and torques, sends, begins a new period."""
        self._frames_from_buses(self.clock.now())
        self._torques()
        self._carry(self.clock.now())
        self._pass_time(self.clock.now())

    def faults_of_start(self) -> str:
        """Returns in words which drives are in fault, if no event of the scenario has begun; empty if none is.

        Until run time 0 the hosts clear faults and enable the drives again, as often as needed.  After that they do not, unless
        `recover_after` is given, so a drive that missed its watchdog just then would give no torque in the whole run."""
        if any(event.at_ns <= self.clock.now() for event in self.plan.events):
            return ""
        found = [one for one in self._role.robots if one.host.fault and one.robot.drive.recover_ns is None]
        return ", ".join(f"{one.robot.name}: {one.host.fault}" for one in found)

    def take(self, messages: Sequence[Message], copies: list[Message]) -> None:
        """Does nothing, since torques come through `mail`."""

    def _torques(self) -> None:
        """Takes the robots' torques from `mail`, applies loss and delay of their links, and sends those that have arrived."""
        for message in self.mail.take():
            now_ns = self.clock.now()
            copies = self._fates[message.source].of(message.sequence, message.time_ns)
            if not copies:
                self.link_lost += 1
            elif (delay_ns := min(copies)) == 0:
                self._take(now_ns, message)
            else:
                heappush(self._flying, (message.time_ns + delay_ns, message.source, message.sequence, message))
        while self._flying and self._flying[0][0] <= self.clock.now():
            self._take(self.clock.now(), heappop(self._flying)[-1])

    def _take(self, now_ns: int, message: Message) -> None:
        before = self._last[message.source]
        if before is None or message.sequence > before.sequence:
            self._last[message.source] = message
            self.came += 1
            if message.sequence >= now_ns // self._period_ns - 1:  # otherwise newer torques are on their way
                self._send_robot(now_ns, message.source, message.sequence, message.time_ns)

    def _frames_from_buses(self, now_ns: int) -> None:
        """Takes the frames that have come from the buses."""
        self.behind = False
        for number, bus in enumerate(self._closed.buses):
            count = 0
            for count, received in enumerate(drained(bus), 1):  # noqa: B007  used after the loop
                frame = Frame(received.can_id, received.data, received.remote)
                check_sender(bus, self._buses[number].spoken, received)
                came_ns = min(self.clock.of(received.time_ns), now_ns)  # by the kernel's time stamp
                self._buses[number].hear(now_ns, frame, came_ns)
                if not self._role.buses[number].is_off(BRIDGE_NODE):
                    self._role.receive(now_ns, number, frame)
                self._note(TimedFrame(came_ns, number, OTHER_NODE, frame))
            self.behind |= count == AT_ONCE

    def _pass_time(self, now_ns: int) -> None:
        """Begins a new period if it is due; tells the robots the torques of their wheels in the period that ended."""
        if now_ns >= self._cycle * self._period_ns:
            # after a standstill, the periods that were missed get no frames: a burst of old torques would be useless
            self._cycle = now_ns // self._period_ns
            for bus, frames in self._role.apply_events(now_ns):
                for frame in frames:
                    self._buses[bus].send(now_ns, BRIDGE_NODE, frame)
            for robot in range(len(self._last)):
                self._send_robot(now_ns, robot, self._cycle - 1)  # repeats the last torque if none came in the period
            for bus, frames in self._role.bus_frames(now_ns):
                for frame in frames:
                    self._buses[bus].send(now_ns, BRIDGE_NODE, frame)
            self._carry(now_ns)
            self._flush()
            self._cycle += 1
        at = self._cycle - 1
        if 0 <= at != self._told:
            begun_ns = at * self._period_ns
            late = now_ns >= begun_ns + self._period_ns // FEEDBACK_SHARE
            if late or self._role.reported_since(begun_ns - self._period_ns // 2):
                self._told = at
                payload = encode(self._role.wheels(begun_ns))
                self._tell_wheels(payload)
                if self._watch is not None:
                    self._watch(join([payload]))

    def _carry(self, now_ns: int) -> None:
        """Sends the frames that the buses can have carried by now; measures the latency of torques."""
        with self._sending:
            carried = [] if self._stopped else [bus.run(now_ns) for bus in self._buses]
            for number, delivered in enumerate(carried):
                for queued_ns, _, _, frame in delivered:
                    self._note(TimedFrame(now_ns, number, BRIDGE_NODE, frame))
                    awaited = self._awaited.get((number, frame.can_id))
                    while awaited and awaited[0][0] < queued_ns:
                        awaited.popleft()  # this frame was lost
                    if awaited and awaited[0][0] == queued_ns:
                        latency_ns = now_ns - awaited.popleft()[1]
                        self.latencies.append(latency_ns)
                        self.in_time += latency_ns < self._period_ns

    def stop(self) -> None:
        """Takes the torque away from all wheels and disables their drives."""
        self._stopped = True
        with last_to_send(self._sending):
            now_ns = self.clock.now()

            def sent(frames: list[TimedFrame]) -> None:
                self._frames_from_buses(now_ns)
                self._flush()
                self._closed.log(frames)

            self._closed.send_stop(now_ns, sent)

    def close(self) -> None:
        """Closes log and buses, after a last look at what others sent."""
        look(self._closed.buses, [bus.spoken for bus in self._buses], AT_ONCE)
        self._closed.close()

    def progress(self) -> BridgeProgress:
        """Returns the present state, for a live table."""
        return replace(self._closed.progress(), load=max(self._loads()))

    def report(self) -> CanReport:
        """Returns the report of the run."""
        report = self._closed.report()
        buses = [replace(bus, load=load) for bus, load in zip(report.buses, self._loads(), strict=True)]
        if not self.plan.can.paced:  # the latencies on a real bus cannot be measured here
            buses = [replace(bus, identifiers={}) for bus in buses]
        return replace(
            report,
            buses=tuple(buses),
            load_mean=max(bus.load for bus in buses),
            torque=self._torque_times(),
            messages=self._messages,
        )

    def _torque_times(self) -> TorqueTimes:
        latencies = np.array(self.latencies) / 1e9
        cycles = max(0, min(self._cycle, self.plan.duration_ns // self._period_ns + 1))
        return TorqueTimes(
            periods=len(self._last) * cycles,
            came=self.came,
            in_time=self.in_time,
            latency_median=float(np.median(latencies)) if len(latencies) else None,
            latency_p99=float(np.percentile(latencies, 99)) if len(latencies) else None,
            latency_max=float(latencies.max()) if len(latencies) else None,
            lost_on_links=self.link_lost,
        )

    def _loads(self) -> list[float]:
        """Returns the load of each bus since the bring-up began."""
        since_s = max(1, self._cycle * self._period_ns + self.plan.can.bring_up_ns) / 1e9
        return [bits.bits / bus.bitrate / since_s for bits, bus in zip(self._bits, self.plan.can.buses, strict=True)]

    def _send_robot(self, now_ns: int, robot: int, cycle: int, state_ns: int | None = None) -> None:
        """Sends the newest torque of a robot, at most once in each period: a second one waits for the next period.

        `cycle` is the number of the period.  `state_ns` is the instant of the state that the torque was computed from; None if
        the torque was sent before."""
        if cycle <= self._sent_in[robot]:
            return
        torques = self._role.robots[robot]
        self._sent_in[robot] = cycle
        bus = torques.robot.drive.bus
        frames = torques.frames(now_ns, self._last[robot])
        queued = [self._buses[bus].send(now_ns, BRIDGE_NODE, frame) for frame in frames]
        if state_ns is not None and torques.torque_frames and queued[-1]:
            # the torque has reached the drives with the last of its frames
            key = bus, frames[-1].can_id
            self._awaited.setdefault(key, deque(maxlen=self.plan.can.queue)).append((now_ns, state_ns))
        self._carry(now_ns)

    def _note(self, timed: TimedFrame) -> None:
        with self._sending:
            self._frames.append(timed)
        self._bits[timed.bus].add(*timed.frame)

    def _flush(self) -> None:
        """Writes the frames of a period to can.log and sends them to recorders."""
        with self._sending:
            if not self._frames:
                return
            # the log must be in order of time, but a time stamp may be older than a frame that is already logged
            self._frames.sort(key=lambda timed: timed.time_ns)
            frames = [timed._replace(time_ns=max(timed.time_ns, self._logged_ns)) for timed in self._frames]
            self._frames = []
            self._logged_ns = frames[-1].time_ns
            self._closed.log(frames)
            if self._watch is not None:
                message = Message(Channel.FRAMES, self._closed.index, self._messages, self._logged_ns, pack(frames))
                self._messages += 1
                self._watch(join([encode(message)]))
