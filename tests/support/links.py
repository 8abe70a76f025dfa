"""A link whose messages are all sent at their nominal instants, and all come: what it does can be asked without messages."""

import numpy as np

from echelon.messages import Message
from echelon.plan.link_plan import LinkPlan
from echelon.runtime.fates import Fates
from echelon.runtime.link import Link


class _Come(dict[int, Message]):
    """Every message of a link, as if it had come."""

    def __init__(self, plan: LinkPlan) -> None:
        super().__init__()
        self._plan = plan

    def get(self, number: int, default: object = None) -> Message:  # type: ignore[override]
        """Returns message number `number`."""
        plan = self._plan
        return Message(plan.channel, plan.source, number, plan.first_ns + number * plan.period_ns, np.ones(1))

    def __delitem__(self, number: int) -> None:
        """Does nothing."""


class PunctualLink(Link):
    """A link with all its messages."""

    def __init__(self, plan: LinkPlan, seed: int, source: str, receiver: str) -> None:
        super().__init__(plan, seed, source, receiver)
        self._model = Fates(plan, seed, source, receiver)
        self._come = _Come(plan)
        self._seen = 0
        self._latest_arrival_ns = plan.first_ns
        self._arrivals: dict[int, int] = {}

    def fate(self, sequence: int) -> int | None:
        """Returns the delay [ns] of the first copy of message number `sequence`, or None if it is lost."""
        return min(self._model.of(sequence, self.sent_ns(sequence)), default=None)

    def arrived(self, sequence: int, time_ns: int) -> bool:
        """Returns whether message number `sequence` is not lost and has arrived by `time_ns`, counted from its fate alone."""
        while self._seen <= sequence:
            delay = self.fate(self._seen)
            if delay is not None:
                arrival = self.sent_ns(self._seen) + delay
                if self.plan.fifo:
                    arrival = self._latest_arrival_ns = max(arrival, self._latest_arrival_ns)
                self._arrivals[self._seen] = arrival
            self._seen += 1
        return sequence in self._arrivals and self._arrivals[sequence] <= time_ns

    def newest(self, time_ns: int) -> int:
        """Returns the number of the message in use at `time_ns`, or -1 if none has arrived."""
        if self.plan.prompt:
            self.latest = self.due(time_ns)
            return self.latest
        self.take_up(time_ns, time_ns, self._come, -1)
        return super().newest(time_ns)
