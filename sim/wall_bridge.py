"""The bridge on a wall clock.

It sleeps until a frame, a robot's torque or an instant of its own comes.  A torque becomes frames as soon as it has come;
a robot that says nothing in a period has its last torque sent again, until the envelope finds that too old.
"""

from array import array
from collections import deque
from heapq import heappop, heappush
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final

import numpy as np

from echelon.bridge.bus_load import BitCount
from echelon.bridge.closed import ClosedStation
from echelon.bridge.commander import Commander
from echelon.bridge.frame import Frame
from echelon.bridge.frame_message import BRIDGE_NODE, TimedFrame, pack
from echelon.bridge.paced_bus import PacedBus
from echelon.link import Link
from echelon.messages import Channel, Message
from echelon.plan import on_wall_clock
from echelon.session import Session
from echelon.sim.joining import ProcessSpec, Result, StartError, meet, resources
from echelon.sim.wall import PROGRESS_NS, Mail, RunClock, drained, wait_for
from echelon.wire import count_refusal, data_key, encode, join, watch_key

FEEDBACK_SHARE: Final = 8
"""Robots are told the torques of their wheels when all drives have reported them, or after this part of a period."""
OLDEST_NS: Final = 10_000_000_000
"""Messages older than this are not of this run."""
OTHER_NODE: Final = 1
"""What frames are noted as that others sent: which of them cannot be told from a frame."""


class WallBridge:
    """The bridge on a wall clock.  Times are run time, by `clock`, which is set when the run starts."""

    def __init__(self, spec: ProcessSpec, session: Session) -> None:
        plan = on_wall_clock(spec.plan)
        self.plan = plan
        self.station = ClosedStation(
            plan, spec.can_urls, Path(spec.folder), paired=True, role=Commander(plan, alone=True)
        )
        self.mail = Mail(plan)
        self._role = self.station.role
        self._buses = [
            PacedBus(bus, model, plan.can.watchdog_ns)
            for bus, model in zip(self.station.buses, self._role.buses, strict=True)
        ]
        self._period_ns = plan.stations[0].period_ns
        self._last: list[Message | None] = [None] * len(plan.robots)
        self._sent_in = [-1 << 62] * len(plan.robots)  # number of the period that a robot's torque was last sent in
        self._cycle = -plan.can.bring_up_ns // self._period_ns
        self._told = -1
        self._frames: list[TimedFrame] = []
        self._bits = [BitCount() for _ in plan.can.buses]
        self._logged_ns = -1 << 62
        everyone = plan.everyone
        self._links = [
            Link(link, plan.seed, everyone[link.source].name, everyone[link.receiver].name)
            for link in plan.links
            if link.channel is Channel.TORQUE and link.receiver == plan.stations[0].index
        ]
        self._flying: list[tuple[int, int, int, Message]] = []
        self.link_lost = 0
        self._awaited: dict[tuple[int, int], deque[tuple[int, int]]] = {}
        """By bus and identifier: when torque frames were queued, and of which instant they are"""
        self.came = 0
        self.latencies = array("q")
        self.clock = RunClock()
        self.in_time = 0
        session.subscribe([data_key(spec.run, robot.path, Channel.TORQUE) for robot in plan.robots], self.mail.receive)
        self._wheels = session.publisher(data_key(spec.run, plan.stations[0].path, Channel.WHEELS))
        self._watch = session.publisher(watch_key(spec.run, "bridge", "bridge")) if spec.watched else None

    @property
    def due_ns(self) -> int:
        """When there is something to do without anything having come."""
        at_ns = self._cycle * self._period_ns
        if self._told < self._cycle - 1 and self._cycle > 0:
            at_ns += self._period_ns // FEEDBACK_SHARE - self._period_ns
        if self._flying:
            at_ns = min(at_ns, self._flying[0][0])
        return min([at_ns, *(due_ns for bus in self._buses if (due_ns := bus.due_ns) is not None)])

    @property
    def listens(self) -> bool:
        """True while robots are to be told what drives report, and where every frame is time that the bus is taken."""
        return self._told < self._cycle - 1 or self.plan.can.paced

    def torques(self) -> None:
        """Takes robots' torques as their links let them arrive, and sends them."""
        for message in self.mail.take():
            now_ns = self.clock.now()
            if not self._plausible(now_ns, message):
                count_refusal(self.mail.refused, "of another time")
                continue
            delay_ns = self._links[message.source].fate(message.sequence)
            if delay_ns is None:
                self.link_lost += 1
            elif delay_ns == 0:
                self._take(now_ns, message)
            else:
                heappush(self._flying, (message.time_ns + delay_ns, message.source, message.sequence, message))
        while self._flying and self._flying[0][0] <= self.clock.now():
            self._take(self.clock.now(), heappop(self._flying)[-1])

    def _plausible(self, now_ns: int, message: Message) -> bool:
        """Holds a message against the clock: it is of a period of this run that has begun, and not long over."""
        age_ns = now_ns - message.time_ns
        return message.time_ns == message.sequence * self._period_ns and -self._period_ns <= age_ns <= OLDEST_NS

    def _take(self, now_ns: int, message: Message) -> None:
        before = self._last[message.source]
        if before is None or message.sequence > before.sequence:
            self._last[message.source] = message
            self.came += 1
            if message.sequence >= now_ns // self._period_ns - 1:  # or else newer ones are on their way
                self._send_robot(now_ns, message.source, message.sequence, message.time_ns)

    def frames(self, now_ns: int) -> None:
        """Takes what has come from the buses."""
        for number, bus in enumerate(self.station.buses):
            for received in drained(bus):
                frame = Frame(received.can_id, received.data, received.remote)
                came_ns = min(self.clock.of(received.time_ns), now_ns)  # as the kernel saw it
                self._buses[number].hear(now_ns, frame, came_ns)
                if not self._role.buses[number].is_off(BRIDGE_NODE):
                    self._role.receive(now_ns, number, frame)
                self._note(TimedFrame(came_ns, number, OTHER_NODE, frame))

    def pass_time(self, now_ns: int) -> None:
        """Does what is due: a new period, and telling robots of the one that ended."""
        if now_ns >= self._cycle * self._period_ns:
            # After a standstill the periods that are over stay without frames; a burst of them would help nobody.
            self._cycle = now_ns // self._period_ns
            for bus, frames in self._role.apply_events(now_ns):
                for frame in frames:
                    self._buses[bus].send(now_ns, BRIDGE_NODE, frame)
            for robot in range(len(self._last)):
                self._send_robot(now_ns, robot, self._cycle - 1)  # again, if nothing newer came
            for bus, frames in self._role.bus_frames(now_ns):
                for frame in frames:
                    self._buses[bus].send(now_ns, BRIDGE_NODE, frame)
            self.carry(now_ns)
            self._flush()
            self._cycle += 1
        at = self._cycle - 1
        if 0 <= at != self._told:
            begun_ns = at * self._period_ns
            late = now_ns >= begun_ns + self._period_ns // FEEDBACK_SHARE
            if late or self._role.reported_since(begun_ns - self._period_ns // 2):
                self._told = at
                payload = encode(self._role.wheels(begun_ns))
                self._wheels.put(payload)
                if self._watch is not None:
                    self._watch.put(join([payload]))

    def carry(self, now_ns: int) -> None:
        """Lets buses take what they can have taken by now."""
        for number, bus in enumerate(self._buses):
            for queued_ns, _, _, frame in bus.run(now_ns):
                self._note(TimedFrame(now_ns, number, BRIDGE_NODE, frame))
                awaited = self._awaited.get((number, frame.can_id))
                while awaited and awaited[0][0] < queued_ns:
                    awaited.popleft()  # lost on the way
                if awaited and awaited[0][0] == queued_ns:
                    latency_ns = now_ns - awaited.popleft()[1]
                    self.latencies.append(latency_ns)
                    self.in_time += latency_ns < self._period_ns

    def stop(self, now_ns: int) -> None:
        """Takes the torque away from all wheels and disables their drives."""
        self._flush()
        self.station.stop_wheels(now_ns)

    def result(self) -> dict[str, Any]:
        """Returns what there is to say of the bridge; latencies [s] are from a robot's state to its torque frames."""
        result = self.station.result()
        for row, load in zip(result["buses"], self._loads(), strict=True):
            row["load"] = load
            if not self.plan.can.paced:
                row["identifiers"] = {}  # how long its frames take the bus alone knows
        result["load_mean"] = max(row["load"] for row in result["buses"])
        latencies = np.array(self.latencies) / 1e9
        result["torque"] = {
            "periods": len(self._last) * max(0, min(self._cycle, self.plan.duration_ns // self._period_ns + 1)),
            "came": self.came,
            "in_time": self.in_time,
            "latency_median": float(np.median(latencies)) if len(latencies) else None,
            "latency_p99": float(np.percentile(latencies, 99)) if len(latencies) else None,
            "latency_max": float(latencies.max()) if len(latencies) else None,
        }
        result["refused_messages"] = self.mail.refused
        result["torque"]["lost_on_links"] = self.link_lost
        return result

    def progress(self) -> dict[str, Any]:
        """Returns what a live table shows."""
        return self.station.progress() | {"load": max(self._loads())}

    def _loads(self) -> list[float]:
        """Returns the share of each bus that its frames took since drives are brought up."""
        since_s = max(1, self._cycle * self._period_ns + self.plan.can.bring_up_ns) / 1e9
        return [bits.bits / bus.bitrate / since_s for bits, bus in zip(self._bits, self.plan.can.buses, strict=True)]

    def _send_robot(self, now_ns: int, robot: int, cycle: int, state_ns: int | None = None) -> None:
        """Sends the newest torque of a robot for a period, once: one that is late goes with the next period's.

        `state_ns` is the instant of the state that it was computed from, if it is new."""
        if cycle <= self._sent_in[robot]:
            return
        torques = self._role.robots[robot]
        self._sent_in[robot] = cycle
        bus = torques.robot.drive.bus
        frames = torques.frames(now_ns, self._last[robot])
        queued = [self._buses[bus].send(now_ns, BRIDGE_NODE, frame) for frame in frames]
        if state_ns is not None and torques.torque_frames and queued[-1]:
            # What was wanted is on the bus with the last of its frames.
            key = bus, frames[-1].can_id
            self._awaited.setdefault(key, deque(maxlen=self.plan.can.queue)).append((now_ns, state_ns))
        self.carry(now_ns)

    def _note(self, timed: TimedFrame) -> None:
        self._frames.append(timed)
        self._bits[timed.bus].add(*timed.frame)

    def _flush(self) -> None:
        """Logs the frames of a period, and shows them to those who watch."""
        if not self._frames:
            return
        # In order of time, also after what is logged already: a stamp may be older than what was written meanwhile.
        self._frames.sort(key=lambda timed: timed.time_ns)
        self._frames = [timed._replace(time_ns=max(timed.time_ns, self._logged_ns)) for timed in self._frames]
        self._logged_ns = self._frames[-1].time_ns
        self.station.log(self._frames)
        if self._watch is not None:
            at_ns = self._frames[-1].time_ns
            message = Message(Channel.FRAMES, self.station.index, self.station.messages, at_ns, pack(self._frames))
            self.station.messages += 1
            self._watch.put(join([encode(message)]))
        self._frames = []


def run_wall_bridge(spec: ProcessSpec, session: Session, control: Connection) -> None:
    """The bridge process of a run on a wall clock."""
    try:
        bridge = WallBridge(spec, session)
    except (ValueError, OSError) as error:
        raise StartError(str(error)) from None
    control.send(("bus", bridge.station.url))
    bridge.clock = RunClock(meet(spec, session, control))
    try:
        _serve(bridge, control)
    finally:  # however it ends
        try:
            bridge.stop(bridge.clock.now())
        finally:
            bridge.station.close()
    cpu_s, resident = resources()
    control.send(("done", Result(spec.name, cpu_s, resident, extra=bridge.result())))
    control.recv()


def _serve(bridge: WallBridge, control: Connection) -> None:
    """Does the bridge's work until it is told to finish."""
    clock, said_ns = bridge.clock, -1 << 62
    while True:
        # What drives say is of use when a period has ended; until then it can wait for the next torque.
        buses = bridge.station.buses if bridge.listens else ()
        wait_for([control, bridge.mail, *buses], bridge.due_ns - clock.now())
        bridge.frames(clock.now())
        bridge.torques()
        bridge.carry(clock.now())
        bridge.pass_time(clock.now())
        now_ns = clock.now()
        if now_ns - said_ns >= PROGRESS_NS:
            said_ns = now_ns
            control.send(("progress", bridge.progress()))
        if control.poll():
            control.recv()
            break
    bridge.frames(clock.now())
