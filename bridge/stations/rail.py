"""A station's frames on a real bus in virtual time.

The message that says which frames a bus carries, and when, is the time rail: frames themselves carry no virtual time.
Who sends puts the frames on the bus first, and the message after them; who receives takes the message, waits for just
these frames to come from the bus, bit for bit, before it goes on.  So nothing is used that the bus did not carry, and the run
is the same at every speed.  Frames of others on the same bus are counted and not used.

While a bus takes no frames (its interface is down) the run stands still, and goes on with it.
"""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Final

from echelon.bridge.can.bus import Bus
from echelon.bridge.frame_message import BRIDGE_NODE, TimedFrame, frames_of
from echelon.bridge.protocols.frame import Frame
from echelon.messages import Channel, Heard, Message
from echelon.role import Stage

LOST_AFTER_S: Final = 5.0
"""A frame that was put on the bus and has not come by then will not come."""
RETRY_S: Final = 0.02


class BusError(Exception):
    """A bus did not carry what was put on it; the text says what."""


class Rail:
    """A station's access to all buses of a run."""

    def __init__(self, buses: Sequence[Bus]) -> None:
        self.buses = buses
        self.foreign = 0
        """Frames that nobody of this run had announced"""
        self.waiting = ""
        """Why the run stands still, if it does"""
        self.stopping = threading.Event()

    def put(self, frames: Sequence[TimedFrame]) -> None:
        """Puts frames on their buses; waits while one takes none.  Raises SystemExit when the run is to stop."""
        for time_ns, bus, _, (can_id, data, remote) in frames:
            while not self.buses[bus].send(can_id, data, time_ns, remote):
                self.waiting = f"{self.buses[bus].url} takes no frames: {self.buses[bus].error}"
                if self.stopping.wait(RETRY_S):
                    raise SystemExit(0)
            self.waiting = ""

    def expect(self, frames: Sequence[TimedFrame]) -> None:
        """Waits until the buses have carried these frames, in this order on each.  Raises BusError if one does not come."""
        for timed in frames:
            self._await(timed)

    def _await(self, timed: TimedFrame) -> None:
        bus, wanted = self.buses[timed.bus], timed.frame
        deadline_s = time.monotonic() + LOST_AFTER_S
        while True:
            received = bus.recv(max(0.0, deadline_s - time.monotonic()))
            if received is None:
                if time.monotonic() < deadline_s:  # an error, e.g. an interface that went down: wait for its return
                    self.stopping.wait(RETRY_S)
                    continue
                raise BusError(f"{bus.url} lost a frame: {wanted.can_id:03X}#{wanted.data.hex().upper()} did not come")
            if Frame(received.can_id, received.data, received.remote) == wanted:
                return
            self.foreign += 1


def on_bus(
    stages: Sequence[Stage], rail: Rail, is_bridge: bool, said: Callable[[list[TimedFrame]], None] = lambda frames: None
) -> tuple[Stage, ...]:
    """Returns a station's stages with their frames going over the buses; `said` gets all frames of what it says.

    The bridge's messages hold all frames of a bus; those with its own node number are its own.
    """

    def own(timed: TimedFrame) -> bool:
        return (timed.node == BRIDGE_NODE) is is_bridge

    def wrapped(stage: Stage) -> Stage:
        def run(time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
            for message in heard:
                if message is not None and message.channel is Channel.FRAMES:
                    rail.expect([timed for timed in frames_of(message) if not own(timed)])
            messages = stage.run(time_ns, heard)
            for message in messages:
                if message.channel is Channel.FRAMES:
                    frames = frames_of(message)
                    rail.put([timed for timed in frames if own(timed)])
                    said(frames)
            return messages

        return replace(stage, run=run)

    return tuple(wrapped(stage) for stage in stages)
