"""A bus on a wall clock that is only as fast as a real one (docs/architecture.md, 5.6).

A virtual interface carries any number of frames at once.  So each process has a model of the bus (bridge.timing.arbitration)
with its own frames and with those that it heard from other processes.  It puts a frame on the interface when the frame ends in
the model.

Together the processes then send no more than the bit rate allows.  Priorities hold as far as a process knows the frames of the
others.  Frames that find a queue full are lost.  Error frames and bus-off happen in the model.

With an ideal bus as the model, frames go out at once: a real bus takes its own time.
"""

from echelon.bridge.can.bus import Bus
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.timing.bus_model import BusEventKind, BusModel, Delivered


class PacedBus:
    """A bus and its model.  Times are run time [ns] and never run backwards.

    A frame that ended in the model more than `old_ns` ago is not sent but counts as lost; this happens after a standstill."""

    def __init__(self, bus: Bus, model: BusModel, old_ns: int) -> None:
        self.bus, self.model = bus, model
        self._old_ns = old_ns
        self.spoken: set[int] = set()
        """Identifiers of the frames that this process has put on the bus"""
        self._seen = 0

    def send(self, time_ns: int, node: int, frame: Frame) -> bool:
        """Puts a frame into the queue of a node of this process.  Returns False if it is lost; the model counts it."""
        queued = self.model.send(time_ns, node, frame)
        if self.model.is_off(node):
            self.model.clear(node)  # all waiting frames would be old when the node comes back
            return False
        return queued

    def hear(self, time_ns: int, frame: Frame, end_ns: int) -> None:
        """Notes a frame that came from the bus, where it was over at `end_ns`."""
        self.model.hear(time_ns, frame, end_ns)

    def run(self, time_ns: int) -> list[Delivered]:
        """Sends the frames that are over in the model by now; returns those that the bus accepted."""
        taken = []
        for sent in self.model.run(time_ns):
            can_id, data, remote = sent.frame
            if time_ns - sent.end_ns > self._old_ns:
                self.model.traffic[can_id].expire()
            elif self.bus.send(can_id, data, remote=remote):
                taken.append(sent)
                self.spoken.add(can_id)
        events = self.model.events
        while self._seen < len(events):
            if events[self._seen].kind is BusEventKind.OFF:
                self.model.clear(events[self._seen].node)
            self._seen += 1
        return taken

    @property
    def due_ns(self) -> int | None:
        """When `run` must be called next; None: no frame waits."""
        return self.model.due_ns
