"""The link model: which message a receiver uses at a given instant (docs/architecture.md, 4.1 and 4.2).

Every triple (source, receiver, channel) has one link, applied at the receiver.  Whether message number k is lost, and how
long it takes, is a pure function of (scenario seed, link, k).  So the same messages are lost in every engine, at every speed
and in every start order.  The draws come from Philox 4x64, a counter-based generator: the key stands for the link, the
counter for the message, so any draw can be made without the draws before it.

A receiver uses a message at its first instant at or after the arrival.  The newest message that has arrived is *in use*; a
message that was overtaken arrives, but changes nothing.  On an *ideal* link, without delay and loss, the newest message that
was sent is in use, and nothing is drawn.
"""

import hashlib
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Final

import numpy as np

from echelon.messages import Channel, Values
from echelon.plan.plan import LinkPlan

_BLOCK: Final = 512
"""Messages per block of draws.  A message takes two 64-bit words; each count of the Philox counter gives four words."""


def link_key(seed: int, source: str, receiver: str, channel: Channel) -> int:
    """Returns the 128-bit Philox key of a link in a scenario."""
    name = f"{seed}|{source}|{receiver}|{channel.name}".encode()
    return int.from_bytes(hashlib.blake2b(name, digest_size=16).digest(), "little")


def draws(key: int, block: int) -> Values:
    """Returns the draws of a block, uniform in [0, 1), shape (_BLOCK, 2): for each message its loss and its delay."""
    from numpy.random import Philox  # 7 MB and 12 ms in each process, which ideal links do not need

    words = Philox(key=key, counter=block * (_BLOCK // 2)).random_raw(2 * _BLOCK)
    uniform: Values = np.multiply(words >> np.uint64(11), 2.0**-53)
    return uniform.reshape(_BLOCK, 2)


@dataclass(frozen=True, slots=True)
class LinkCounts:
    """Counts of a link's messages; sent = delivered + lost + in_flight.

    `used` counts uses.  `held` counts the uses in which the message was older than the instant and had been used before.
    `age_mean_ns` and `age_max_ns` are the mean and the largest age of the message in use, over all uses."""

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


class Link:
    """One directed link with its state.  `newest` must be called with ascending instants; `latest` is its last answer."""

    __slots__ = (
        "_age_max",
        "_age_sum",
        "_block",
        "_block_number",
        "_delivered",
        "_due_ns",
        "_first_ns",
        "_flying",
        "_held",
        "_ideal",
        "_key",
        "_last",
        "_lost",
        "_period_ns",
        "_sent",
        "_used",
        "latest",
        "plan",
    )

    def __init__(self, plan: LinkPlan, seed: int, source: str, receiver: str) -> None:
        self.plan = plan
        self._key = link_key(seed, source, receiver, plan.channel)
        self._ideal = plan.ideal
        self._first_ns, self._period_ns = plan.first_ns, plan.period_ns
        # the first block is drawn here, so that on a wall clock no stage has to wait for the import in `draws`
        self._block: list[list[float]] = [] if plan.ideal else draws(self._key, 0).tolist()
        self._block_number = 0
        self._due_ns = plan.first_ns  # when the next message is sent
        self._sent = self._delivered = self._lost = self._used = self._held = 0
        self.latest = self._last = -1
        self._flying: list[tuple[int, int]] = []
        self._age_sum = self._age_max = 0

    def sent_ns(self, sequence: int) -> int:
        """Returns the instant at which message number `sequence` is sent [ns]."""
        return self._first_ns + sequence * self._period_ns

    def fate(self, sequence: int) -> int | None:
        """Returns the delay [ns] of message number `sequence`, or None if it is lost."""
        plan = self.plan
        if self._ideal:
            return 0
        number, at = divmod(sequence, _BLOCK)
        if number != self._block_number:
            self._block, self._block_number = draws(self._key, number).tolist(), number
        loss, delay = self._block[at]
        if loss < plan.loss:
            return None
        return plan.delay_min_ns + round(delay * (plan.delay_max_ns - plan.delay_min_ns))

    def arrived(self, sequence: int, time_ns: int) -> bool:
        """True if message number `sequence` is not lost and has arrived by `time_ns`."""
        delay = self.fate(sequence)
        return delay is not None and self.sent_ns(sequence) + delay <= time_ns

    def newest(self, time_ns: int) -> int:
        """Returns the number of the message in use at `time_ns`, or -1 if none has arrived."""
        if self._ideal:
            self.latest = newest = (time_ns - self._first_ns) // self._period_ns
            return newest
        while self._due_ns <= time_ns:
            delay = self.fate(self._sent)
            if delay is None:
                self._lost += 1
            else:
                heappush(self._flying, (self._due_ns + delay, self._sent))
            self._sent += 1
            self._due_ns += self._period_ns
        while self._flying and self._flying[0][0] <= time_ns:
            _, sequence = heappop(self._flying)
            self._delivered += 1
            self.latest = max(self.latest, sequence)
        return self.latest

    def note_use(self, time_ns: int, sequence: int, sent_ns: int) -> None:
        """Counts a use at `time_ns` of message number `sequence`, which was sent at `sent_ns`."""
        self._used += 1
        if sent_ns != time_ns:
            age = time_ns - sent_ns
            self._held += sequence == self._last
            self._age_sum += age
            if age > self._age_max:
                self._age_max = age
        self._last = sequence

    def counts(self) -> LinkCounts:
        """Returns the counts up to the last instant for which `newest` was called."""
        sent, delivered = self._sent, self._delivered
        if self._ideal:
            sent = delivered = self.latest + 1
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
        )
