"""The link model: when each message arrives at its receiver (docs/architecture.md, 4.1 and 4.2).

Every triple (source, receiver, channel) has one link, applied at the receiver.  Whether message number k is lost, and how
long it takes, is a pure function of (scenario seed, link, k).  So the same messages are lost in every engine, at every speed
and in every start order.  The draws come from Philox 4x64, a counter-based generator: the key stands for the link, the
counter for the message, so any draw can be made without the draws before it.

A message arrives its delay after the instant at which it was sent, which is the time in its header.  The newest message that
has arrived is *in use*; a message that was overtaken arrives, but changes nothing.  On an *ideal* link, without delay and
loss, a message arrives when it is sent, and nothing is drawn.

Message number k is due at the *nominal* instant first + k × period.  A sender that waits for its own inputs sends it later,
but always before number k + 1 is due (docs/architecture.md, 4.6).  So a receiver knows without the message that it cannot
arrive before its nominal instant plus its delay; this look-ahead lets a lockstep run on while messages are on their way.  The
link of a *punctual* sender, which always sends at its nominal instants, is ideal at best: then number ⌊(t - first)/period⌋ is
in use at t.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from heapq import heappop, heappush
from typing import Final

import numpy as np
from numpy.random import Philox

from echelon.messages import Channel, Message, Values
from echelon.plan.plan import LinkPlan

_BLOCK: Final = 512
"""Messages per block of draws.  A message takes two 64-bit words; each count of the Philox counter gives four words."""


def link_key(seed: int, source: str, receiver: str, channel: Channel) -> int:
    """Returns the 128-bit Philox key of a link in a scenario."""
    name = f"{seed}|{source}|{receiver}|{channel.name}".encode()
    return int.from_bytes(hashlib.blake2b(name, digest_size=16).digest(), "little")


def draws(key: int, block: int) -> Values:
    """Returns the draws of a block, uniform in [0, 1), shape (_BLOCK, 2): for each message its loss and its delay."""
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
    """One directed link with its state.  Instants must be given in ascending order."""

    __slots__ = (
        "_age_max",
        "_age_sum",
        "_block",
        "_block_number",
        "_delivered",
        "_expected",
        "_first_ns",
        "_flying",
        "_held",
        "_ideal",
        "_key",
        "_last",
        "_lost",
        "_newest",
        "_open",
        "_period_ns",
        "_sent",
        "_used",
        "plan",
    )

    def __init__(self, plan: LinkPlan, seed: int, source: str, receiver: str) -> None:
        self.plan = plan
        self._key = link_key(seed, source, receiver, plan.channel)
        self._ideal = plan.ideal
        self._first_ns, self._period_ns = plan.first_ns, plan.period_ns
        self._block: list[list[float]] = []
        self._block_number = -1
        self._sent = self._delivered = self._lost = self._used = self._held = 0
        self._newest = self._last = self._expected = -1
        self._open: list[tuple[int, int]] = []
        """Messages that are due, not lost, and not in `_flying` yet: number and delay"""
        self._flying: list[tuple[int, int]] = []
        """Messages on their way, as a heap: instant of arrival and number"""
        self._age_sum = self._age_max = 0

    def due(self, time_ns: int) -> int:
        """Returns the number of the last message that is due at `time_ns`, or a negative number before the first one."""
        return (time_ns - self._first_ns) // self._period_ns

    def sent_ns(self, sequence: int) -> int:
        """Returns the nominal instant of message number `sequence` [ns]: it is sent then, or later."""
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

    def due_by(self, time_ns: int) -> int:
        """Returns the number of the message in use at `time_ns` on a prompt link: the last one that is due."""
        self._newest = newest = (time_ns - self._first_ns) // self._period_ns
        return newest

    def take_up(self, time_ns: int, until_ns: int, came: Mapping[int, Message], in_use: int) -> bool:
        """Takes up the messages that are due at `time_ns` and may arrive by `until_ns`; returns True if none of them is
        missing.

        `came` has the messages that have come, by number, from number `in_use` + 1 on."""
        self._open_due(time_ns)
        if not self._open:
            return True
        complete, still_open = True, []
        for number, delay in self._open:
            arrives_ns = self._first_ns + number * self._period_ns + delay
            if arrives_ns <= until_ns and number > in_use:
                message = came.get(number)
                if message is None:
                    complete = False
                    arrives_ns = until_ns + 1
                else:
                    arrives_ns = message.time_ns + delay
                    heappush(self._flying, (arrives_ns, number))
                    continue
            if arrives_ns <= until_ns:  # it was overtaken, and changes nothing
                heappush(self._flying, (arrives_ns, number))
            else:
                still_open.append((number, delay))
        self._open = still_open
        return complete

    def _open_due(self, time_ns: int) -> None:
        """Draws the fates of the messages that are due at `time_ns`."""
        last = (time_ns - self._first_ns) // self._period_ns
        while self._sent <= last:
            delay = self.fate(self._sent)
            if delay is None:
                self._lost += 1
            else:
                self._open.append((self._sent, delay))
            self._sent += 1

    def expected(self, time_ns: int) -> int:
        """Returns the number of the newest message that would have arrived by `time_ns` if all were sent when they are due."""
        self._open_due(time_ns)
        if self._open:
            still_open = []
            for number, delay in self._open:
                if self.sent_ns(number) + delay > time_ns:
                    still_open.append((number, delay))
                elif number > self._expected:
                    self._expected = number
            self._open = still_open
        return self._expected

    def receive(self, message: Message, time_ns: int) -> None:
        """Takes a message that comes at `time_ns` of a wall clock: it arrives then, or after the delay of its link."""
        delay = self.fate(message.sequence)
        if delay is not None:
            heappush(self._flying, (max(time_ns, message.time_ns + delay), message.sequence))

    def newest(self, time_ns: int) -> int:
        """Returns the number of the message in use at `time_ns`, or -1 if none has arrived, of those that were taken up."""
        flying = self._flying
        while flying and flying[0][0] <= time_ns:
            _, sequence = heappop(flying)
            self._delivered += 1
            if sequence > self._newest:
                self._newest = sequence
        return self._newest

    def next_arrival(self, than: int) -> int | None:
        """Returns the first instant at which a message arrives that is newer than number `than`, of those on their way."""
        return min((arrives_ns for arrives_ns, number in self._flying if number > than), default=None)

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
        """Returns the counts up to the last instant for which a number was asked."""
        sent, delivered = self._sent, self._delivered
        if self.plan.prompt:
            sent = delivered = self._newest + 1
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
        )
