"""The bridge at work: robots' states in; frames out, on the bus, in can.log, and as copies for the recorder."""

import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from echelon.bridge.bridge import Bridge
from echelon.bridge.bus import open_bus
from echelon.bridge.bus_load import bus_load
from echelon.bridge.bus_url import listen_command
from echelon.bridge.canlog import CanLog
from echelon.bridge.fit import plan_fit
from echelon.bridge.frame_message import BRIDGE_NODE, add_words
from echelon.bridge.plan_dbc import dbc_names, plan_dbc
from echelon.bridge.protocols import make_host
from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.plan import Plan

TAU_RIGHT: Final = STATE_FIELDS.index("tau_right")
TAU_LEFT: Final = STATE_FIELDS.index("tau_left")
SATURATED: Final = STATE_FIELDS.index("saturated")


class Station:
    """A bridge with its bus, its log and its DBC.  `url` says in full where the frames can be heard.

    Raises ValueError or OSError if the bus or the files cannot be had.
    """

    def __init__(self, plan: Plan, urls: Sequence[str], folder: Path) -> None:
        self._plan = plan
        self._bridge = Bridge(
            [robot.path for robot in plan.robots],
            [make_host(robot) for robot in plan.robots],
            [robot.period_ns for robot in plan.robots],
            [robot.envelope for robot in plan.robots],
        )
        self._buses = [open_bus(url) for url in urls]
        self.url = ", ".join(bus.url for bus in self._buses)
        for number, name in enumerate(dbc_names(plan)):
            (folder / name).write_text(plan_dbc(plan, number), encoding="utf-8")
        self._log = CanLog(folder / "can.log", plan.can.buses[0].name, 0)
        self._bus_of = [robot.drive.bus for robot in plan.robots]
        self._names = [bus.name for bus in plan.can.buses]
        self._source = len(plan.members)
        self._sequence = 0
        self._time_ns = 0

    def put(self, messages: list[Message]) -> list[Message]:
        """Sends the torques of robots' states, in order of time; returns the frames as messages, one per instant.

        The state at the start says nothing of torque: the first frame of a robot ends its first period.
        """
        copies: list[Message] = []
        words: list[int] = []
        buses, names, log, encode = self._buses, self._names, self._log, self._bridge.encode
        wall_ns = time.monotonic_ns()
        for channel, source, _, time_ns, values in messages:
            if channel is not Channel.STATE or time_ns == 0:
                continue
            if time_ns != self._time_ns:
                self._copy(words, copies)
                self._time_ns = time_ns
            frames = encode(
                time_ns, source, float(values[TAU_RIGHT]), float(values[TAU_LEFT]), bool(values[SATURATED] > 0)
            )
            number = self._bus_of[source]
            for identifier, data, _ in frames:
                buses[number].send(identifier, data, time_ns)
                log.write(time_ns, identifier, data, wall_ns, names[number])
                add_words(words, time_ns, number, BRIDGE_NODE, identifier, data)
        self._copy(words, copies)
        return copies

    def flush(self) -> None:
        """Hands what is logged to the operating system."""
        self._log.flush()

    def close(self) -> None:
        """Closes log and buses."""
        self._log.close()
        for bus in self._buses:
            bus.close()

    def progress(self) -> dict[str, Any]:
        """Returns what a live table shows."""
        stopped = self._bridge.stopped()
        return {
            "url": self.url,
            "load": self._load(),
            "frames": self._bridge.frames,
            "stopped": ", ".join(f"{number} {reason}" for reason, number in stopped.most_common()),
        }

    def result(self) -> dict[str, Any]:
        """Returns the counts of bridge, bus and log, and the load this would be on a real bus, for the summary."""
        bits = self._bridge.bits / self._bridge.frames if self._bridge.frames else 0.0
        robots = self._bridge.summary()
        fit = plan_fit(self._plan)
        return {
            "url": self.url,
            "path": "mirror",
            "listen": "; ".join(command for bus in self._buses if (command := listen_command(bus.url))),
            "bitrate": self._plan.can.buses[0].bitrate,
            "torque_scale": self._plan.can.torque_scale,
            "frames": self._bridge.frames,
            "clipped": sum(robot["clipped"] for robot in robots["robots"].values()),
            "load_mean": self._load(),
            "bits_per_frame": bits,
            "fit": fit[0].lines[0] if len(fit) == 1 else [bus.lines[0] for bus in fit],
            "advice": [way for bus in fit for way in bus.advice],
            "sent": sum(bus.counts.sent for bus in self._buses),
            "failed": sum(bus.counts.failed for bus in self._buses),
            "dropped": sum(bus.counts.dropped for bus in self._buses),
            "log_lost": self._log.counts.lost,
            "log_error": str(self._log.error) if self._log.error else None,
            "robots": robots["robots"],
            "messages": self._sequence,
        }

    def _load(self) -> float:
        """Returns the share of a real bus that the frames so far take, in run time."""
        if not self._time_ns:
            return 0.0
        return bus_load(
            self._bridge.frames * 1e9 / self._time_ns,
            sum(bus.bitrate for bus in self._plan.can.buses),
            self._bridge.bits / max(self._bridge.frames, 1),
        )

    def _copy(self, words: list[int], copies: list[Message]) -> None:
        if words:
            values = np.array(words, dtype="<u8").view(np.float64)
            copies.append(Message(Channel.FRAMES, self._source, self._sequence, self._time_ns, values))
            self._sequence += 1
            words.clear()
