"""The bridge at work: robots' states in, frames on the bus and in can.log out, and copies of them for the recorder."""

import time
from pathlib import Path
from typing import Any

import numpy as np

from bridge.bridge import Bridge
from bridge.bus import open_bus
from bridge.canlog import CanLog
from bridge.dbc import torque_dbc
from bridge.load import bus_load, worst_case_bits
from echelon.messages import STATE_FIELDS, Channel, Message, field_index
from echelon.plan import Plan

_TAU = field_index(STATE_FIELDS, "tau_right", "tau_left", "saturated")


class Station:
    """A bridge with its bus and its log.  `url` says where the frames can be heard."""

    def __init__(self, plan: Plan, url: str, folder: Path, epoch_ns: int = 0) -> None:
        self._plan = plan
        self._bridge = Bridge(
            [robot.path for robot in plan.robots], plan.can.torque_scale, plan.robots[0].period_ns
        )
        self._bus = open_bus(url)
        self.url = self._bus.url
        self._log = CanLog(folder / "can.log", self._bus.channel, epoch_ns)
        self._index = len(plan.members)
        self._messages = 0
        self._last_ns = 0
        (folder / "torque.dbc").write_text(torque_dbc(plan))

    def put(self, messages: list[Message]) -> list[Message]:
        """Sends the torques of robots' states as frames; returns the frames as messages, one per instant.

        The state at the start says nothing of torque: the first frame of a robot ends its first period.
        """
        copies: list[Message] = []
        words: list[int] = []
        bus, log, encode = self._bus, self._log, self._bridge.encode
        wall_ns = time.monotonic_ns()
        for message in messages:
            if message.channel is not Channel.STATE or message.time_ns == 0:
                continue
            if message.time_ns != self._last_ns:
                self._copy(words, copies)
                self._last_ns = message.time_ns
            tau_right, tau_left, saturated = message.values[_TAU].tolist()
            for identifier, data in encode(message.time_ns, message.source, tau_right, tau_left, saturated > 0):
                bus.send(identifier, data, message.time_ns)
                log.write(message.time_ns, identifier, data, wall_ns)
                words += (identifier, int.from_bytes(data, "little"))
        self._copy(words, copies)
        return copies

    def _copy(self, words: list[int], copies: list[Message]) -> None:
        if words:
            values = np.array(words, dtype="<u8").view(np.float64)
            copies.append(Message(Channel.FRAMES, self._index, self._messages, self._last_ns, values))
            self._messages += 1
            words.clear()
