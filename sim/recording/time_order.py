"""Putting the messages of many sources into one order of time, whatever the order of arrival."""

from collections.abc import Iterable
from typing import Final

from echelon.messages import Message
from echelon.plan.plan import Plan

_BEFORE_ALL_NS: Final = -(1 << 62)


def speakers(plan: Plan, virtual: bool, has_bus: bool) -> range:
    """Returns the indices of the roles whose messages are recorded: robots and nodes, then the bridge, then the drives.

    Drives send messages of their own only in virtual time."""
    if not plan.can.closed:
        return range(len(plan.formation) + has_bus)
    return range(len(plan.all_roles) if virtual else len(plan.formation) + 1)


class TimeOrder:
    """Orders messages by (time, source, channel, sequence).  A message is released when every source has sent a later one.

    Each source sends in order of time.  The order of the released messages does not depend on the order of arrival.
    """

    def __init__(self, sources: Iterable[int]) -> None:
        self._latest = dict.fromkeys(sources, _BEFORE_ALL_NS)
        self._waiting: dict[int, list[Message]] = {}
        self._released_ns = _BEFORE_ALL_NS
        self.pushed = 0
        """Number of accepted messages."""
        self.refused = 0
        """Number of messages from unknown sources, or older than released ones."""

    def push(self, messages: list[Message]) -> list[Message]:
        """Takes messages, in order for each source; returns the released ones in the common order."""
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
        """Returns the remaining messages in order.  The end of a run needs it, since no source sends anything later then."""
        return self._release(1 << 63)

    def _release(self, safe_ns: int) -> list[Message]:
        """Releases everything before `safe_ns`."""
        released: list[Message] = []
        for time_ns in sorted(time_ns for time_ns in self._waiting if time_ns < safe_ns):
            bucket = self._waiting.pop(time_ns)
            bucket.sort(key=lambda message: (message.source, message.channel, message.sequence))
            released.extend(bucket)
            self._released_ns = time_ns
        return released
