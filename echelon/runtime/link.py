"""The link: when each message arrives at its receiver, and which one is in use (docs/architecture.md, 4.1 and 4.2).

Every triple (source, receiver, channel) has one link, applied at the receiver.  What becomes of a message is told by
`echelon.runtime.fates`.  A message arrives its delay after the instant at which it was sent, which is the time in its header.
The newest message that has arrived is *in use*; a message that was overtaken arrives, but changes nothing.

Message number k is due at the *nominal* instant first + k × period.  A sender that waits for its own inputs sends it later,
but always before number k + 1 is due (docs/architecture.md, 4.6).  So a receiver knows without the message that it cannot
arrive before its nominal instant plus its delay.  This look-ahead lets a lockstep run on while messages are on their way.

On a *prompt* link, which is ideal and whose sender always sends at nominal instants, a message is in use from its nominal
instant on, and nothing is drawn.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from heapq import heapify, heappop, heappush
from typing import Final

from echelon.messages import Channel, Message
from echelon.plan.link_plan import LinkPlan
from echelon.runtime.ages import AgeCounts
from echelon.runtime.fates import Copies, Fates

PERCENTILES: Final = (0.5, 0.95, 0.99)
"""The shares of uses whose largest age is told"""
_Open = tuple[int, int, int]
"""When a message is first needed [ns], its number, and its earliest possible arrival [ns].  It is needed when it may arrive; on
a link that keeps the order, when all those before it may, too"""


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
    """One directed link with its state.  Instants must be given in ascending order; `latest` is the number last in use."""

    __slots__ = (
        "_age_max",
        "_age_sum",
        "_aged",
        "_ages",
        "_awaited",
        "_copies",
        "_delivered",
        "_duplicates",
        "_earliest",
        "_expected",
        "_fates",
        "_first_ns",
        "_flying",
        "_held",
        "_last",
        "_latest_ns",
        "_lost",
        "_needed_ns",
        "_open",
        "_period_ns",
        "_sent",
        "_used",
        "latest",
        "plan",
    )

    def __init__(self, plan: LinkPlan, seed: int, source: str, receiver: str) -> None:
        self.plan = plan
        self._fates = Fates(plan, seed, source, receiver)
        self._first_ns, self._period_ns = plan.first_ns, plan.period_ns
        self._latest_ns = plan.first_ns
        """The latest arrival so far, of first copies"""
        self._needed_ns = plan.first_ns
        """When the message drawn last is needed"""
        self._sent = self._delivered = self._duplicates = self._lost = self._used = self._held = 0
        self.latest = self._last = self._expected = -1
        self._open: list[_Open] = []
        """Messages that are due, not lost, and not needed yet, as a heap"""
        self._awaited: list[_Open] = []
        """Messages that were needed already, and have not come, in the order in which they were needed"""
        self._flying: list[tuple[int, int]] = []
        """Messages on their way, as a heap: instant of arrival and number"""
        self._copies: list[int] = []
        """Arrivals of second copies, as a heap"""
        self._earliest: dict[int, int] = {}
        """On a wall clock, when messages of `_flying` would arrive by the rule of the link, by number, where they came later"""
        self._age_sum = self._age_max = self._aged = 0
        self._ages = AgeCounts()

    def due(self, time_ns: int) -> int:
        """Returns the number of the last message that is due at `time_ns`, or a negative number before the first one."""
        return (time_ns - self._first_ns) // self._period_ns

    def sent_ns(self, sequence: int) -> int:
        """Returns the nominal instant of message number `sequence` [ns]: it is sent then, or later."""
        return self._first_ns + sequence * self._period_ns

    def is_lost(self, sequence: int) -> bool:
        """Returns whether message number `sequence` is lost, as far as that can be told without its instant of sending."""
        return not self._known(sequence)

    def _known(self, sequence: int) -> Copies:
        """Returns the delays of the copies of a message, as far as they can be told without its instant of sending."""
        if self.plan.punctual:
            return self._fates.of(sequence, self.sent_ns(sequence))
        return self._fates.drawn(sequence)

    def take_up(self, time_ns: int, until_ns: int, came: dict[int, Message], in_use: int) -> bool:
        """Takes up the messages that are due at `time_ns` and may arrive by `until_ns`; returns True if none of them is
        missing.

        `came` has the messages that have come, by number, from number `in_use` + 1 on.  Those that a blackout takes away are
        removed from it."""
        self._open_due(time_ns)
        opened = self._open
        needed = self._awaited
        if not needed and not (opened and opened[0][0] <= until_ns):
            return True
        while opened and opened[0][0] <= until_ns:
            needed.append(heappop(opened))
        complete, fifo = True, self.plan.fifo
        awaited: list[_Open] = []
        self._awaited = awaited
        for at, one in enumerate(needed):
            if fifo and awaited:  # it cannot arrive before those that were sent before it
                awaited += needed[at:]
                break
            needed_ns, number, earliest_ns = one
            if needed_ns > until_ns:
                awaited.append(one)
            elif number <= in_use:  # it was overtaken, and changes nothing
                heappush(self._flying, (earliest_ns, number))
            elif (message := came.get(number)) is None:
                complete = False
                awaited.append(one)
            elif self._depart(message) is None:
                self._lost += 1
                del came[number]
        return complete

    def _open_due(self, time_ns: int) -> None:
        """Draws the fates of the messages that are due at `time_ns`."""
        last = (time_ns - self._first_ns) // self._period_ns
        while self._sent <= last:
            copies = self._known(self._sent)
            if copies:
                earliest_ns = self.sent_ns(self._sent) + min(copies)
                self._needed_ns = max(self._needed_ns, earliest_ns) if self.plan.fifo else earliest_ns
                heappush(self._open, (self._needed_ns, self._sent, earliest_ns))
            else:
                self._lost += 1
            self._sent += 1

    def _depart(self, message: Message, received_ns: int | None = None) -> int | None:
        """Puts a message on its way; returns when it arrives, `received_ns` at the earliest, or None if it is lost."""
        sent_ns = message.time_ns
        arrivals: Sequence[int] = [sent_ns + delay for delay in self._fates.of(message.sequence, sent_ns)]
        if not arrivals:
            return None
        if len(arrivals) > 1:
            arrivals = sorted(arrivals)
        if received_ns is not None:
            if arrivals[0] < received_ns:
                self._earliest[message.sequence] = arrivals[0]
            arrivals = [max(received_ns, arrival) for arrival in arrivals]
        if self.plan.fifo:
            arrivals = [max(self._latest_ns, arrival) for arrival in arrivals]
            self._latest_ns = arrivals[0]
        heappush(self._flying, (arrivals[0], message.sequence))
        for arrival in arrivals[1:]:
            heappush(self._copies, arrival)
        return arrivals[0]

    def expected(self, time_ns: int) -> int:
        """Returns the number of the newest message that would have arrived by `time_ns` if all were sent when they are due."""
        self._open_due(time_ns)
        while self._open and self._open[0][0] <= time_ns:
            self._expected = max(self._expected, heappop(self._open)[1])
        return self._expected

    def receive(self, message: Message, time_ns: int) -> int | None:
        """Takes a message that comes at `time_ns` of a wall clock.  Returns when it arrives: then, or after the delay of its
        link; None if it is lost."""
        return self._depart(message, time_ns)

    def newest(self, time_ns: int) -> int:
        """Returns the number of the message in use at `time_ns`, or -1 if none has arrived, of those that were taken up."""
        flying, copies = self._flying, self._copies
        while flying and flying[0][0] <= time_ns:
            _, sequence = heappop(flying)
            self._earliest.pop(sequence, None)
            self._delivered += 1
            if sequence > self.latest:
                self.latest = sequence
        while copies and copies[0] <= time_ns:
            heappop(copies)
            self._duplicates += 1
        return self.latest

    def next_arrival(self, than: int) -> int | None:
        """Returns the first instant at which a message arrives that is newer than number `than`, of those on their way."""
        flying = self._flying
        if flying and flying[0][1] > than:
            return flying[0][0]
        return min((arrives_ns for arrives_ns, number in flying if number > than), default=None)

    def hasten(self, time_ns: int) -> list[int]:
        """Lets messages that have come after `time_ns` of a wall clock arrive then, if they were sent by then and the rule of
        the link allows it; returns their numbers."""
        flying, earliest = self._flying, self._earliest
        if not earliest:
            return []
        hastened = [
            number
            for arrives_ns, number in flying
            if arrives_ns > time_ns and earliest.get(number, arrives_ns) <= time_ns
        ]
        if hastened:
            flying[:] = [(time_ns if number in hastened else arrives_ns, number) for arrives_ns, number in flying]
            heapify(flying)
        return hastened

    def arrival(self, sequence: int) -> int | None:
        """Returns when message number `sequence` arrives, if it is on its way."""
        return next((arrives_ns for arrives_ns, number in self._flying if number == sequence), None)

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
        """Returns the counts up to the last instant for which a number was asked."""
        sent, delivered = self._sent, self._delivered
        if self.plan.prompt:
            sent = delivered = self.latest + 1
        p50, p95, p99 = self._ages.percentiles(PERCENTILES, self._used - self._aged)
        return LinkCounts(
            self.plan.source,
            self.plan.receiver,
            self.plan.channel,
            sent,
            delivered,
            self._lost,
            max(0, sent - delivered - self._lost),
            self._used,
            self._held,
            self._age_sum / self._used if self._used else 0.0,
            self._age_max,
            min(p50, self._age_max),
            min(p95, self._age_max),
            min(p99, self._age_max),
            self._duplicates,
        )
