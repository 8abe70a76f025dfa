"""A bus on a wall clock that is as fast as a real one: frames wait in a model of it, and go out when they are over there.

A virtual interface carries any number of frames at once.  Here each process has a model of the bus
(bridge.timing.arbitration) with its own frames in it, and those it heard of others; it puts a frame on the interface at the
end of the time that the frame takes in the model.
So all together send no more than the bit rate allows, by priority as far as one can know of the others; what finds no
room is lost; error frames and bus-off happen in the model. With an ideal bus for a model, frames go out at once: a real
bus takes its own time."""

from echelon.bridge.can.bus import Bus
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.timing.bus_model import BusEventKind, BusModel, Delivered


class PacedBus:
    """A bus and its model.  Times are run time, and never run backwards.

    After a standstill, frames that were over for more than `old_ns` are not sent any more, and count as lost."""

    def __init__(self, bus: Bus, model: BusModel, old_ns: int) -> None:
        self.bus, self.model = bus, model
        self._old_ns = old_ns
        self._seen = 0

    def send(self, time_ns: int, node: int, frame: Frame) -> bool:
        """Puts a frame into the queue of a node of this process; False: it is lost, and counted in the model."""
        queued = self.model.send(time_ns, node, frame)
        if self.model.is_off(node):
            self.model.clear(node)  # as all that waited when it went off: it would be old when it is back
            return False
        return queued

    def hear(self, time_ns: int, frame: Frame, end_ns: int) -> None:
        """Takes note of a frame that came from the bus, where it was over at `end_ns`."""
        self.model.hear(time_ns, frame, end_ns)

    def run(self, time_ns: int) -> list[Delivered]:
        """Sends what is over by now; returns what the bus took."""
        taken = []
        for sent in self.model.run(time_ns):
            can_id, data, remote = sent.frame
            if time_ns - sent.end_ns > self._old_ns:
                self.model.traffic[can_id].expire()
            elif self.bus.send(can_id, data, remote=remote):
                taken.append(sent)
        events = self.model.events
        while self._seen < len(events):
            if events[self._seen].kind is BusEventKind.OFF:
                self.model.clear(events[self._seen].node)
            self._seen += 1
        return taken

    @property
    def due_ns(self) -> int | None:
        """When `run` is next to be called; None: nothing waits."""
        return self.model.due_ns
