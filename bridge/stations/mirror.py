"""The bridge on the mirrored torque path: robots' states in; frames out on the bus, into can.log, and to the recorder."""

import threading
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np

from echelon.bridge.can.bus_url import listen_command
from echelon.bridge.can.canlog import CanLog
from echelon.bridge.frame_message import BRIDGE_NODE, TimedFrame, add_words
from echelon.bridge.protocols.plan_dbc import dbc_names, plan_dbc
from echelon.bridge.protocols.registry import make_host
from echelon.bridge.reports import BridgeProgress, BusReport, CanReport, stopped_text
from echelon.bridge.roles.torque_mirror import TorqueMirror
from echelon.bridge.stations.bridge import Bridge
from echelon.bridge.stations.closed import send_all
from echelon.bridge.stations.guarding import intrusions, look, open_guarded
from echelon.bridge.stations.waiting import AT_ONCE, FLOOD, RunClock, last_to_send
from echelon.bridge.timing.bus_load import bus_load
from echelon.bridge.timing.buses import scheduled
from echelon.bridge.timing.fit import plan_fit
from echelon.files import write_new
from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.plan.plan import Plan

TAU_RIGHT: Final = STATE_FIELDS.index("tau_right")
TAU_LEFT: Final = STATE_FIELDS.index("tau_left")
SATURATED: Final = STATE_FIELDS.index("saturated")


class MirrorBridge(Bridge):
    """A torque mirror with its buses, can.log and its DBC files.

    In virtual time, frames and the lines of can.log have the times of the states.  On a wall clock (`clock`, which must be
    replaced when the run starts) a frame goes out as soon as its state comes, whoever else is silent.  Its time is when it was
    sent.  A state that is older than the watchdog makes no frame: such torques would come in a burst after a standstill.

    Raises ValueError for an invalid URL and OSError if a bus or a file cannot be opened."""

    def __init__(self, plan: Plan, urls: Sequence[str], folder: Path, clock: RunClock | None = None) -> None:
        self.clock = clock
        self._lost = [0] * len(plan.can.buses)
        """For each bus, the number of states that were too old, and of frames that it did not take (wall clock)"""
        self._old_ns = plan.can.watchdog_ns
        self._plan = plan
        self._mirror = TorqueMirror(
            [make_host(robot) for robot in plan.robots],
            [robot.period_ns for robot in plan.robots],
            [robot.envelope for robot in plan.robots],
        )
        self._buses = open_guarded(plan, urls)
        self._spoken: list[set[int]] = [set() for _ in plan.can.buses]
        """For each bus, the identifiers that the bridge sends"""
        for robot in plan.robots:
            frames = make_host(robot).mirror(0.0, 0.0, False)
            self._spoken[robot.drive.bus].update(frame.can_id for frame in frames)
        self.url = ", ".join(bus.url for bus in self._buses)
        for number, name in enumerate(dbc_names(plan)):
            write_new(folder / name, plan_dbc(plan, number))
        self._log = CanLog(folder / "can.log", plan.can.buses[0].name)
        self._bus_of = [robot.drive.bus for robot in plan.robots]
        self._names = [bus.name for bus in plan.can.buses]
        self._source = len(plan.formation)
        self._sequence = 0
        self._time_ns = 0
        self._sending = threading.RLock()
        self._stopped = False
        self._stop_ns: int | None = None
        """When the wheels were stopped"""

    def take(self, messages: Sequence[Message], copies: list[Message]) -> None:
        """Sends the torques in the robots' states; adds messages with the frames: one per instant, or one on a wall clock.

        The state at run time 0 holds no torque.  So a robot's first frame comes at the end of its first period.
        """
        if self._stopped:
            return
        words: list[int] = []
        try:
            self._send(messages, words, copies)
        finally:  # a user's protocol may fail; what was sent before is recorded
            self._copy(words, copies)

    def _send(self, messages: Sequence[Message], words: list[int], copies: list[Message]) -> None:
        """Sends the frames of some states, and adds them to `words`, those of past instants to `copies`."""
        buses, names, log, encode, clock = self._buses, self._names, self._log, self._mirror.encode, self.clock
        sending = self._sending
        wall_ns = time.monotonic_ns()
        for channel, source, _, time_ns, values in messages:
            if channel is not Channel.STATE or time_ns == 0:
                continue
            number = self._bus_of[source]
            if clock is not None:
                self._time_ns = clock.now()
                if self._time_ns - time_ns > self._old_ns:
                    self._lost[number] += 1
                    continue
            elif time_ns != self._time_ns:
                self._copy(words, copies)
                self._time_ns = time_ns
            frames = encode(
                time_ns, source, float(values[TAU_RIGHT]), float(values[TAU_LEFT]), bool(values[SATURATED] > 0)
            )
            sent_ns = self._time_ns
            with sending:
                if self._stopped:
                    return
                for identifier, data, _ in frames:
                    if not buses[number].send(identifier, data, sent_ns) and clock is not None:
                        self._lost[number] += 1
                        self._mirror.unsent(source)
                        continue
                    log.write(sent_ns, identifier, data, wall_ns, names[number])
                    add_words(words, sent_ns, number, BRIDGE_NODE, identifier, data)

    def stop(self) -> None:
        """Takes the torque away from the wheels and disables their drives: drives on the bus obey mirrored frames, too.

        After that nothing is sent any more.  If a host raised something, raises it after all others are stopped.  One that
        hangs is asked last, when the frames of the others are on the bus and in can.log."""
        self._stopped = True
        with last_to_send(self._sending):
            self._send_stop()

    def _send_stop(self) -> None:
        now_ns = None if self.clock is None else self.clock.now()
        groups = self._mirror.driven()
        # in virtual time each stop is due when the robot's next frame would be
        due_ns = [self._time_ns + robot.period_ns if now_ns is None else now_ns for robot in self._plan.robots]
        self._stop_ns = min((due_ns[robot] for group in groups for robot in group), default=self._time_ns + 1)
        failure: BaseException | None = None
        for group in groups:
            stops, failed = self._mirror.end(group)
            failure = failure or failed
            frames = [TimedFrame(due_ns[robot], self._bus_of[robot], BRIDGE_NODE, frame) for robot, frame in stops]
            frames.sort(key=lambda timed: timed.time_ns)
            wall_ns = time.monotonic_ns()
            for time_ns, bus, _, (can_id, data, remote) in send_all(self._buses, frames):
                self._log.write(time_ns, can_id, data, wall_ns, self._names[bus], remote)
            self._log.flush()
        if failure is not None:
            raise failure

    def flush(self) -> None:
        """Hands all lines of can.log to the operating system."""
        self._log.flush()

    def close(self) -> None:
        """Closes log and buses, after a last look at what others sent."""
        self._look()
        self._log.close()
        for bus in self._buses:
            bus.close()

    def progress(self) -> BridgeProgress:
        """Returns the present state, for a live table."""
        self._look()
        return BridgeProgress(
            url=self.url,
            load=max(self._loads()),
            frames=self._mirror.frames,
            stopped=stopped_text([counts.stopped for counts in self._mirror.counts]),
        )

    def _look(self) -> None:
        """Counts what others send with identifiers of this run.  The bridge uses none of it.

        In virtual time it reads on behind a flood, where the frames that matter may be."""
        look(self._buses, self._spoken, FLOOD if self.clock is None else AT_ONCE)

    def report(self) -> CanReport:
        """Returns the report of the run up to the last look at the buses (`progress`, `close`), with the load that the frames
        would make on real ones."""
        loads, fit = self._loads(), plan_fit(self._plan)
        return CanReport(
            path="mirror",
            timing=None,
            url=self.url,
            listen="; ".join(command for bus in self._buses if (command := listen_command(bus.url))),
            torque_scale=self._plan.can.torque_scale,
            log_start=0.0,
            frames=self._mirror.frames,
            load_mean=max(loads),
            fit=tuple(bus.lines[0] for bus in fit),
            advice=tuple(way for bus in fit for way in bus.advice),
            buses=tuple(
                BusReport(bus.name, bus.bitrate, load, lost)
                for bus, load, lost in zip(self._plan.can.buses, loads, self._lost, strict=True)
            ),
            scheduled=scheduled(self._plan),
            sent=sum(bus.counts.sent for bus in self._buses),
            failed=sum(bus.counts.failed for bus in self._buses),
            dropped=sum(bus.counts.dropped for bus in self._buses),
            log_lost=self._log.counts.lost,
            log_error=str(self._log.error) if self._log.error else None,
            robots={
                robot.name: self._mirror.report(robot.index, robot.drive.protocol.use) for robot in self._plan.robots
            },
            intrusions=intrusions(self._plan, self._buses),
            messages=self._sequence,
            wheels_stopped=None if self._stop_ns is None else self._stop_ns / 1e9,
        )

    def _loads(self) -> list[float]:
        """Returns the load so far that the frames would make on each bus if it were real, in run time."""
        frames, bits = [0] * len(self._names), [0] * len(self._names)
        for bus, counts in zip(self._bus_of, self._mirror.counts, strict=True):
            frames[bus] += counts.frames
            bits[bus] += counts.bits.bits
        if not self._time_ns:
            return [0.0] * len(frames)
        return [
            bus_load(count * 1e9 / self._time_ns, bus.bitrate, total / max(count, 1))
            for count, total, bus in zip(frames, bits, self._plan.can.buses, strict=True)
        ]

    def _copy(self, words: list[int], copies: list[Message]) -> None:
        if words:
            values = np.array(words, dtype="<u8").view(np.float64)
            copies.append(Message(Channel.FRAMES, self._source, self._sequence, self._time_ns, values))
            self._sequence += 1
            words.clear()
