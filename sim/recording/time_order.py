"""Putting the messages of many sources in order of time, whatever their order of arrival."""

from collections import Counter, deque
from collections.abc import Iterable
from typing import Final

from echelon.messages import Message
from echelon.plan.plan import Plan

_BEFORE_ALL_NS: Final = -(1 << 62)


def speakers(plan: Plan, virtual: bool, has_bus: bool) -> range:
    """Returns the indices of the roles whose messages are recorded, a range from 0: robots and nodes, then the bridge if it
    makes frames, then the drives.  Drives send messages of their own only on a closed torque path in virtual time."""
    if not plan.can.closed:
        return range(len(plan.formation) + has_bus)
    return range(len(plan.all_roles) if virtual else len(plan.formation) + 1)


class TimeOrder:
    """Releases messages in the order (time, source, channel): each when every source has sent a later message.

    Each source must send in order of time.  The order of the released messages does not depend on the order of arrival.

    With `hold_s`, for a wall clock, no message waits for longer than this for a source that is silent.  When that source speaks
    again, its messages are behind the order; they are released at once."""

    def __init__(self, sources: Iterable[int], hold_s: float | None = None) -> None:
        self._hold_s = hold_s
        self._came: deque[tuple[float, int]] = deque()
        """When messages came [s], and up to which instant [ns] these messages went"""
        self._passed_ns = _BEFORE_ALL_NS
        """Up to this instant no message waits any more, whoever is silent"""
        self._latest = dict.fromkeys(sources, _BEFORE_ALL_NS)
        self._waiting: dict[int, list[Message]] = {}
        self._released_ns = _BEFORE_ALL_NS
        self.pushed = 0
        """Number of accepted messages"""
        self.refused_of: Counter[int] = Counter()
        """Number of refused messages by source: of an unknown one, or not later than the last released one; with `hold_s` not
        later than the source's own last one"""

    @property
    def refused(self) -> int:
        """Number of all refused messages."""
        return self.refused_of.total()

    def push(self, messages: list[Message], now_s: float = 0.0) -> list[Message]:
        """Takes messages, in order of time for each source; returns the messages that are released now, in the common order.

        `now_s` is the present reading of a monotonic clock.  With `hold_s`, `push` must be called from time to time even if
        nothing came."""
        waiting, latest = self._waiting, self._latest
        late: list[Message] = []
        for message in messages:
            time_ns = message.time_ns
            if message.source not in latest:
                self.refused_of[message.source] += 1
                continue
            if time_ns <= self._released_ns:
                if self._hold_s is None or time_ns < latest[message.source]:
                    self.refused_of[message.source] += 1
                else:
                    self.pushed += 1
                    latest[message.source] = time_ns
                    late.append(message)
                continue
            self.pushed += 1
            if time_ns > latest[message.source]:
                latest[message.source] = time_ns
            bucket = waiting.get(time_ns)
            if bucket is None:
                waiting[time_ns] = [message]
            else:
                bucket.append(message)
        safe_ns = min(latest.values())
        if self._hold_s is not None:
            safe_ns = max(safe_ns, self._held_until(messages, now_s))
        return late + self._release(safe_ns)

    def _held_until(self, messages: list[Message], now_s: float) -> int:
        """Returns up to which instant messages have waited for `hold_s`."""
        assert self._hold_s is not None
        if messages:
            self._came.append((now_s, max(message.time_ns for message in messages)))
        while self._came and now_s - self._came[0][0] >= self._hold_s:
            self._passed_ns = max(self._passed_ns, self._came.popleft()[1] + 1)
        return self._passed_ns

    def rest(self) -> list[Message]:
        """Returns the messages that wait, in order.  For the end of a run: then no source sends a later message."""
        return self._release(1 << 63)

    def _release(self, safe_ns: int) -> list[Message]:
        """Releases all messages before `safe_ns`."""
        released: list[Message] = []
        for time_ns in sorted(time_ns for time_ns in self._waiting if time_ns < safe_ns):
            bucket = self._waiting.pop(time_ns)
            bucket.sort(key=lambda message: (message.source, message.channel))
            released.extend(bucket)
            self._released_ns = time_ns
        return released
