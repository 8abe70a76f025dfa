"""Putting the messages of many sources in order of time, whatever their order of arrival."""

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

    Each source must send in order of time.  The order of the released messages does not depend on the order of arrival."""

    def __init__(self, sources: Iterable[int]) -> None:
        self._latest = dict.fromkeys(sources, _BEFORE_ALL_NS)
        self._waiting: dict[int, list[Message]] = {}
        self._released_ns = _BEFORE_ALL_NS
        self.pushed = 0
        """Number of accepted messages"""
        self.refused = 0
        """Number of refused messages: from an unknown source, or not later than the last released one"""

    def push(self, messages: list[Message]) -> list[Message]:
        """Takes messages, in order of time for each source; returns the messages that are released now, in the common order."""
        waiting, latest = self._waiting, self._latest
        for message in messages:
            time_ns = message.time_ns
            if message.source not in latest or time_ns <= self._released_ns:
                self.refused += 1
                continue
            self.pushed += 1
            if time_ns > latest[message.source]:
                latest[message.source] = time_ns
            bucket = waiting.get(time_ns)
            if bucket is None:
                waiting[time_ns] = [message]
            else:
                bucket.append(message)
        return self._release(min(latest.values()))

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
