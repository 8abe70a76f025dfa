"""The link: which message a receiver uses at a given instant (docs/architecture.md, 4.1 and 4.2).

Every triple (source, receiver, channel) has one link, applied at the receiver.  What becomes of a message is told by
`echelon.runtime.fates`.

A receiver uses a message at its first instant at or after the arrival.  The newest message that has arrived is *in use*; a
message that was overtaken arrives, but changes nothing.  On an *ideal* link, without delay and loss, the newest message that
was sent is in use, and nothing is drawn.
"""

from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Final

from echelon.messages import Channel
from echelon.plan.plan import LinkPlan
from echelon.runtime.ages import AgeCounts
from echelon.runtime.fates import Fates

PERCENTILES: Final = (0.5, 0.95, 0.99)
"""The shares of uses whose largest age is told"""


@dataclass(frozen=True, slots=True)
class LinkCounts:
    """Counts of a link's messages; sent = delivered + lost + in_flight.

    A message is delivered when its first copy arrives.  `duplicates` counts the second copies that have arrived.  `used` counts
    uses.  `held` counts the uses in which the message was older than the instant and had been used before.  The ages are those
    of the message in use, over all uses: mean, largest, and the ages that half, 95 % and 99 % of the uses do not exceed
    (echelon.runtime.ages)."""

    source: int
    receiver: int
    channel: Channel
    sent: int
    delivered: int
    lost: int
    in_flight: int
    used: int
    held: int
    age_mean_ns: float
    age_max_ns: int
    age_p50_ns: int = 0
    age_p95_ns: int = 0
    age_p99_ns: int = 0
    duplicates: int = 0


class Link:
    """One directed link with its state.  `newest` must be called with ascending instants."""

    __slots__ = (
        "_age_max",
        "_age_sum",
        "_aged",
        "_ages",
        "_copies",
        "_delivered",
        "_due_ns",
        "_duplicates",
        "_fates",
        "_first_ns",
        "_flying",
        "_held",
        "_ideal",
        "_last",
        "_latest_ns",
        "_lost",
        "_newest",
        "_period_ns",
        "_sent",
        "_used",
        "plan",
    )

    def __init__(self, plan: LinkPlan, seed: int, source: str, receiver: str) -> None:
        self.plan = plan
        self._fates = Fates(plan, seed, source, receiver)
        self._ideal = plan.ideal
        self._first_ns, self._period_ns = plan.first_ns, plan.period_ns
        self._due_ns = plan.first_ns  # when the next message is sent
        self._latest_ns = plan.first_ns  # the latest arrival so far, of first copies
        self._sent = self._delivered = self._duplicates = self._lost = self._used = self._held = 0
        self._newest = self._last = -1
        self._flying: list[tuple[int, int]] = []
        self._copies: list[int] = []  # arrivals of second copies
        self._age_sum = self._age_max = self._aged = 0
        self._ages = AgeCounts()

    def sent_ns(self, sequence: int) -> int:
        """Returns the instant at which message number `sequence` is sent [ns]."""
        return self._first_ns + sequence * self._period_ns

    def fate(self, sequence: int) -> int | None:
        """Returns the delay [ns] of the first copy of message number `sequence`, or None if it is lost."""
        return min(self._fates.of(sequence, self.sent_ns(sequence)), default=None)

    def arrived(self, sequence: int, time_ns: int) -> bool:
        """True if message number `sequence` is not lost and has arrived by `time_ns`."""
        if self.sent_ns(sequence) > time_ns:
            return False
        delay = self.fate(sequence)
        if delay is None or self.sent_ns(sequence) + delay > time_ns:
            return False
        return not self.plan.fifo or all(number != sequence for _, number in self._flying)

    def newest(self, time_ns: int) -> int:
        """Returns the number of the message in use at `time_ns`, or -1 if none has arrived."""
        if self._ideal:
            self._newest = newest = (time_ns - self._first_ns) // self._period_ns
            return newest
        while self._due_ns <= time_ns:
            copies = self._fates.of(self._sent, self._due_ns)
            if not copies:
                self._lost += 1
            else:
                arrival = self._due_ns + (copies[0] if len(copies) == 1 else min(copies))
                if self.plan.fifo:
                    self._latest_ns = arrival = max(arrival, self._latest_ns)
                heappush(self._flying, (arrival, self._sent))
                if len(copies) > 1:
                    heappush(self._copies, max(arrival, self._due_ns + max(copies)))
            self._sent += 1
            self._due_ns += self._period_ns
        while self._flying and self._flying[0][0] <= time_ns:
            _, sequence = heappop(self._flying)
            self._delivered += 1
            self._newest = max(self._newest, sequence)
        while self._copies and self._copies[0] <= time_ns:
            heappop(self._copies)
            self._duplicates += 1
        return self._newest

    def note_use(self, time_ns: int, sequence: int, sent_ns: int) -> None:
        """Counts a use at `time_ns` of message number `sequence`, which was sent at `sent_ns`."""
        self._used += 1
        if sent_ns != time_ns:
            age = time_ns - sent_ns
            self._held += sequence == self._last
            self._age_sum += age
            self._aged += 1
            self._ages.note(age)
            if age > self._age_max:
                self._age_max = age
        self._last = sequence

    def counts(self) -> LinkCounts:
        """Returns the counts up to the last instant for which `newest` was called."""
        sent, delivered = self._sent, self._delivered
        if self._ideal:
            sent = delivered = self._newest + 1
        p50, p95, p99 = self._ages.percentiles(PERCENTILES, self._used - self._aged)
        return LinkCounts(
            self.plan.source,
            self.plan.receiver,
            self.plan.channel,
            sent,
            delivered,
            self._lost,
            len(self._flying),
            self._used,
            self._held,
            self._age_sum / self._used if self._used else 0.0,
            self._age_max,
            min(p50, self._age_max),
            min(p95, self._age_max),
            min(p99, self._age_max),
            self._duplicates,
        )
