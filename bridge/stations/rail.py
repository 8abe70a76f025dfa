"""Frames over a real bus in virtual time: the time rail (docs/architecture.md, 5.2).

A *station* is a process on the bus: the bridge or the drives.  Frames carry no virtual time.  So a `FRAMES` message, the time
rail, says which frames a bus carries and when.  The sender puts the frames on the bus first and sends the message after them.
The receiver takes the message and then waits until exactly these frames have come from the bus.  So a station uses no
frame that the bus did not carry, and a run gives the same result at every speed.  Foreign frames are counted and not used.

While a bus accepts no frames (its interface is down), the run waits.  It goes on when the bus does.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from echelon.bridge.can.bus import Bus
from echelon.bridge.frame_message import BRIDGE_NODE, TimedFrame, frames_of
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.stations.guarding import check_sender
from echelon.messages import Channel, Heard, Message
from echelon.role import Stage

LOST_AFTER_S: Final = 5.0
"""A frame that has not come after this time counts as lost."""
RETRY_S: Final = 0.02


class BusError(Exception):
    """A bus lost a frame that was put on it."""


class Rail:
    """A station's access to all buses of a run."""

    def __init__(self, buses: Sequence[Bus]) -> None:
        self.buses = buses
        self.spoken: list[set[int]] = [set() for _ in buses]
        """For each bus, the identifiers of the frames that this station has put on it"""
        self.foreign = 0
        """Number of frames that no process of this run had announced"""
        self.waiting = ""
        """Why the run waits for a bus; empty if it does not"""
        self.stopping = threading.Event()
        """Set when the station must stop: it waits for nothing, and its stages put no frames"""
        self.sending = threading.RLock()
        """Held while frames are put and written into can.log"""

    def put(self, frames: Sequence[TimedFrame]) -> int:
        """Puts frames on their buses; waits while a bus accepts none.  Returns how many it has put: all, unless `stopping` is
        set meanwhile."""
        for number, (time_ns, bus, _, (can_id, data, remote)) in enumerate(frames):
            self.spoken[bus].add(can_id)
            while not self.buses[bus].send(can_id, data, time_ns, remote):
                self.waiting = f"{self.buses[bus].url} takes no frames: {self.buses[bus].error}"
                if self.stopping.wait(RETRY_S):
                    return number
            self.waiting = ""
        return len(frames)

    def expect(self, frames: Sequence[TimedFrame]) -> None:
        """Waits until the buses have carried these frames, in this order on each.  Raises BusError if one does not come, and
        SystemExit if `stopping` is set meanwhile."""
        for timed in frames:
            self._await(timed)

    def _await(self, timed: TimedFrame) -> None:
        bus, wanted = self.buses[timed.bus], timed.frame
        deadline_s = time.monotonic() + LOST_AFTER_S
        while True:
            begun_s = time.monotonic()
            received = bus.recv(max(0.0, min(RETRY_S, deadline_s - begun_s)))
            if received is None:
                now_s = time.monotonic()
                # receiving may have failed, for example since the interface is down: then it is not tried again at once
                if self.stopping.wait(RETRY_S if now_s - begun_s < RETRY_S / 2 else 0.0):
                    raise SystemExit(0)
                if now_s < deadline_s:
                    continue
                raise BusError(f"{bus.url} lost a frame: {wanted.can_id:03X}#{wanted.data.hex().upper()} did not come")
            if Frame(received.can_id, received.data, received.remote) == wanted:
                return
            self.foreign += 1
            check_sender(bus, bus.guard.own, received)


def on_bus(
    stages: Sequence[Stage], rail: Rail, is_bridge: bool, said: Callable[[list[TimedFrame]], None] = lambda frames: None
) -> tuple[Stage, ...]:
    """Returns the stages of a station, changed so that their frames go over the buses.

    `is_bridge` says whether the station is the bridge or the drives.  `said` is called with all frames of each message that the
    station sends.  The bridge's messages hold all frames of a bus, also those of the drives; a station puts only the
    frames of its own nodes on the bus, and waits only for those of the others.
    """

    def own(timed: TimedFrame) -> bool:
        return (timed.node == BRIDGE_NODE) is is_bridge

    def put(frames: list[TimedFrame]) -> None:
        with rail.sending:
            mine = [timed for timed in frames if own(timed)]
            count = 0 if rail.stopping.is_set() else rail.put(mine)
            if count == len(mine):
                said(frames)
                return
            places = [at for at, timed in enumerate(frames) if own(timed)]
            unsent = {*places[count:]}
            said([timed for at, timed in enumerate(frames) if at not in unsent])
        raise SystemExit(0)

    def wrapped(stage: Stage) -> Stage:
        def run(time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
            for message in heard:
                if message is not None and message.channel is Channel.FRAMES:
                    rail.expect([timed for timed in frames_of(message) if not own(timed)])
            messages = stage.run(time_ns, heard)
            for message in messages:
                if message.channel is Channel.FRAMES:
                    put(frames_of(message))
            return messages

        return replace(stage, run=run)

    return tuple(wrapped(stage) for stage in stages)
