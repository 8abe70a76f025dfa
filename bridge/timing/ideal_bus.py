"""A bus on which frames take no time.  Pure.

It serves runs with `can.timing = "ideal"`, and runs on a wall clock, where the real bus takes its own time.
"""

from collections import defaultdict
from collections.abc import Mapping

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.timing.bus_load import check_frame
from echelon.bridge.timing.bus_model import BusEvent, BusModel, Delivered, Traffic

_EVER = -(2**62)


class IdealBus(BusModel):
    """A bus that delivers every frame at the instant it is sent, in the order of sending, and loses none."""

    def __init__(self) -> None:
        self.events: list[BusEvent] = []
        self._traffic: defaultdict[int, Traffic] = defaultdict(Traffic)
        self._now_ns = _EVER
        self._delivered: list[Delivered] = []

    @property
    def traffic(self) -> Mapping[int, Traffic]:
        return self._traffic

    @property
    def due_ns(self) -> int | None:
        return self._delivered[0].end_ns if self._delivered else None

    @property
    def busy_ns(self) -> int:
        return 0

    @property
    def load(self) -> float:
        return 0.0

    def duration_ns(self, frame: Frame) -> int:
        check_frame(*frame)
        return 0

    def send(self, time_ns: int, node: int, frame: Frame) -> bool:
        check_frame(*frame)
        self._advance(time_ns)
        self._traffic[frame.can_id].sent += 1
        self._delivered.append(Delivered(time_ns, time_ns, node, frame))
        return True

    def hear(self, time_ns: int, frame: Frame, end_ns: int) -> None:
        self._advance(time_ns)

    def run(self, until_ns: int) -> list[Delivered]:
        self._advance(until_ns)
        delivered, self._delivered = self._delivered, []
        for _, _, _, frame in delivered:
            self._traffic[frame.can_id].deliver(0)
        return delivered

    def set_error_rate(self, rate: float) -> None:
        if rate:
            raise ValueError(f"an ideal bus has no errors: its error rate must be 0, not {rate!r}")

    def is_off(self, node: int) -> bool:
        return False

    def clear(self, node: int) -> int:
        return 0

    def bus_off(self, node: int) -> None:
        raise ValueError(f"an ideal bus has no errors: node {node!r} cannot be off")

    def _advance(self, time_ns: int) -> None:
        if time_ns < self._now_ns:
            raise ValueError(f"time must not be before {self._now_ns} ns, not {time_ns!r}")
        self._now_ns = time_ns
