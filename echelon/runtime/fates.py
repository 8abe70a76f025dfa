"""The fate of messages: which are lost, which come twice, and how long each takes (docs/architecture.md, 4.1).

Every triple (source, receiver, channel) has one link.  What becomes of message number k is a pure function of (scenario seed,
link, k), and of the instant of sending where the scenario says so (blackouts, traces by time).  So the same messages are lost
in every engine, at every speed and in every start order.  It does not matter which numbers were asked for before.

The draws come from Philox 4x64, a counter-based generator.  The key stands for the link, the counter for the message; the
highest 64 bits of the counter are the number of a *stream*.  Message k takes two words of each stream:

    stream  first word               second word
    ------  -----------------------  ---------------------
    0       whether it is lost       its delay
    1       whether it comes twice   the delay of its copy
    2       whether a burst goes on  not used

Where a message is lost for all receivers at once, the words that decide about its loss have a key without the receiver.

Bursts (Gilbert and Elliott) are a chain of two states, and correlated delays a Gaussian sequence (`echelon.plan.delay_tables`).
Both are functions of k nevertheless.  The state of the chain follows from the last draw that decides it whatever the state was
before.  The Gaussian sequence begins anew every `CHAIN` messages.
"""

import hashlib
from bisect import bisect_right
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.messages import Channel, Values
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.delay_tables import (
    BITS,
    FACTOR_BITS,
    LOST,
    Z_BITS,
    Bursts,
    DelayTable,
    DelayTrace,
    Words,
    edges,
    factors,
    looked_up,
    looked_up_z,
)
from echelon.plan.link_plan import LinkPlan

BLOCK: Final = 512
"""Messages per block of draws.  A message takes two 64-bit words; each count of the Philox counter gives four words."""
CHAIN: Final = 128 * BLOCK
"""Correlated delays begin anew after so many messages, so that any message can be asked for in bounded time"""
LOSS, COPY, BURST = range(3)
"""The streams"""
ALL: Final = "*"
"""Stands for the receiver in the key of what happens to all receivers at once; no member is called so"""

Copies = tuple[int, ...]
"""Delays [ns] of the copies of a message: none if it is lost, two if it comes twice"""


def link_key(seed: int, source: str, receiver: str, channel: Channel) -> int:
    """Returns the 128-bit Philox key of a link in a scenario."""
    name = f"{seed}|{source}|{receiver}|{channel.name}".encode()
    return int.from_bytes(hashlib.blake2b(name, digest_size=16).digest(), "little")


def words(key: int, block: int, stream: int = LOSS) -> Words:
    """Returns the words of a block, whole numbers of 53 bits, shape (BLOCK, 2)."""
    from numpy.random import Philox  # 7 MB and 12 ms in each process, which ideal links do not need

    raw = Philox(key=key, counter=(stream << 192) + block * (BLOCK // 2)).random_raw(2 * BLOCK)
    return (raw >> np.uint64(64 - BITS)).astype(np.int64).reshape(BLOCK, 2)


def draws(key: int, block: int, stream: int = LOSS) -> Values:
    """Returns the same words as numbers in [0, 1)."""
    uniform: Values = np.multiply(words(key, block, stream), 2.0**-BITS)
    return uniform


def bad_states(draws: Values, bursts: Bursts, first: bool) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Returns for each message of a block whether the link is bad, where it was good at the message before the block, and where
    it was bad.  `first`: the block begins with message 0, whose state is drawn from the shares of both states."""
    low, high = sorted((bursts.to_bad, 1 - bursts.to_good))
    becomes_bad, becomes_good = draws < low, draws >= high
    if first:
        np.copyto(becomes_bad[:1], draws[:1] < bursts.share_bad)
        np.copyto(becomes_good[:1], ~becomes_bad[:1])
    # Between the two bounds the state stays as it is; if bursts are shorter than by chance, it changes there.
    decided = becomes_bad | becomes_good
    last = np.maximum.accumulate(np.where(decided, np.arange(draws.size), -1))
    changed = np.zeros(draws.size, bool)
    if bursts.to_bad > 1 - bursts.to_good:
        count: Words = np.cumsum(~decided)
        since: Words = count - np.where(last >= 0, count[last], 0)
        changed = since % 2 == 1
    after_good, after_bad = (np.where(last >= 0, becomes_bad[last], was_bad) ^ changed for was_bad in (False, True))
    return after_good, after_bad


class Fates:
    """What becomes of the messages of one link."""

    __slots__ = (
        "_block",
        "_fixed",
        "_loss_key",
        "_number",
        "_states",
        "_table",
        "_z_ends",
        "by_instant",
        "key",
        "plan",
    )

    def __init__(self, plan: LinkPlan, seed: int, source: str, receiver: str) -> None:
        self.plan = plan
        self.key = link_key(seed, source, receiver, plan.channel)
        self._loss_key = link_key(seed, source, ALL, plan.channel) if plan.loss_of_message else self.key
        self._number = -1
        self._block: list[Copies] = []
        """The copies of block `_number`"""
        self._states: tuple[int, bool] = -1, False
        """A block, and whether the link is bad at its last message"""
        self._z_ends: dict[int, int] = {}
        """z of the last message of blocks, by block"""
        self._table: Words = np.array(plan.delays.delays_ns if plan.delays else (), np.int64)
        constant = plan.delay_min_ns == plan.delay_max_ns and plan.delays is None
        self._fixed: Copies | None = (
            (plan.delay_min_ns,) if constant and not plan.loss and not plan.duplicates else None
        )
        """The copies of every message, where they are the same for all"""
        self.by_instant = bool(plan.blackouts) or (isinstance(plan.delays, DelayTrace) and bool(plan.delays.times_ns))
        """True if the instant of sending matters: then `of` differs from `drawn`"""
        self.drawn(0)  # so that on a wall clock no stage has to wait for the imports of the first draw

    def of(self, sequence: int, sent_ns: int) -> Copies:
        """Returns the delays [ns] of the copies of message number `sequence`, which is sent at `sent_ns`."""
        copies = self.drawn(sequence)
        return self._at_instant(copies, sent_ns) if self.by_instant and copies else copies

    def drawn(self, sequence: int) -> Copies:
        """Returns what the number of a message alone says: no copies if it is lost whenever it is sent.  With a trace by time,
        delays are 0."""
        if self._fixed is not None:
            return self._fixed
        number, at = divmod(sequence, BLOCK)
        if number != self._number:
            self._block, self._number = _as_tuples(self.block(number)), number
        return self._block[at]

    def block(self, number: int) -> Words:
        """Returns the delays [ns] of a block, shape (BLOCK, 2): of each message, and of its copy if it comes twice; `LOST`
        where nothing comes.  Blackouts and traces by time, which need the instant of sending, are left out."""
        plan = self.plan
        found: Words = np.full((BLOCK, 2), LOST, np.int64)
        own = words(self.key, number)
        copy = words(self.key, number, COPY) if plan.duplicates else own
        delays = self._delays(number, own[:, 1], copy[:, 1])
        found[:, 0] = np.where(self._lost(number), LOST, delays[0])
        if plan.duplicates:
            twice = (copy[:, 0] * 2.0**-BITS < plan.duplicates) & (found[:, 0] != LOST)
            found[:, 1] = np.where(twice, delays[1], LOST)
        return found

    def _lost(self, number: int) -> NDArray[np.bool_]:
        """Returns which messages of a block are lost, (BLOCK,)."""
        plan = self.plan
        if not plan.loss:
            return np.zeros(BLOCK, bool)
        loss = draws(self._loss_key, number)[:, 0]
        if (bursts := plan.bursts) is None:
            return loss < plan.loss
        lost: NDArray[np.bool_] = loss < np.where(self._bad(number, bursts), bursts.loss_bad, bursts.loss_good)
        return lost

    def _bad(self, number: int, bursts: Bursts) -> NDArray[np.bool_]:
        """Returns at which messages of a block the link is bad, (BLOCK,)."""
        wanted = self._both(number, bursts)
        pending, at = [], number  # blocks before it whose draws do not decide their last state
        bad = False
        while at:
            at -= 1
            if at == self._states[0]:
                bad = self._states[1]
                break
            after_good, after_bad = self._both(at, bursts)
            bad = bool(after_good[-1])
            if after_good[-1] == after_bad[-1]:
                break
            pending.append((after_good[-1], after_bad[-1]))
        for last_after_good, last_after_bad in reversed(pending):
            bad = bool(last_after_bad if bad else last_after_good)
        found = wanted[bad]
        self._states = number, bool(found[-1])
        return found

    def _both(self, number: int, bursts: Bursts) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
        return bad_states(draws(self._loss_key, number, BURST)[:, 0], bursts, first=not number)

    def _delays(self, number: int, own: Words, copy: Words) -> tuple[Words, Words]:
        """Returns the delays of the messages of a block and of their copies [ns], as their words say."""
        plan = self.plan
        match plan.delays:
            case None:
                span = plan.delay_max_ns - plan.delay_min_ns
                first, second = (
                    plan.delay_min_ns + np.rint(each * 2.0**-BITS * span).astype(np.int64) for each in (own, copy)
                )
            case DelayTrace(times_ns=()):
                first = second = self._table[np.arange(number * BLOCK, (number + 1) * BLOCK) % self._table.size]
            case DelayTrace():
                first = second = np.zeros(BLOCK, np.int64)
            case DelayTable(correlation=0.0):
                first, second = looked_up(self._table, own), looked_up(self._table, copy)
            case DelayTable():
                first = looked_up_z(self._table, self._z(number, own))
                second = looked_up_z(self._table, looked_up(normal_table(), copy))
        return first, second

    def _z(self, number: int, own: Words) -> Words:
        """Returns the Gaussian sequence over a block, whose words are `own`, in units of 2⁻²⁸."""
        first = number - number % (CHAIN // BLOCK)
        at = number
        while at > first and at - 1 not in self._z_ends:
            at -= 1
        for block in range(at, number):
            self._z_of(block, words(self.key, block)[:, 1])
        return self._z_of(number, own)

    def _z_of(self, number: int, own: Words) -> Words:
        """Does the same where the block before is known, or the sequence begins anew; notes the last z of the block."""
        assert isinstance(self.plan.delays, DelayTable)
        rho, rest = factors(self.plan.delays.correlation)
        normal = looked_up(normal_table(), own)
        steps = ((normal * rest) >> FACTOR_BITS).tolist()
        if number % (CHAIN // BLOCK):
            z = self._z_ends[number - 1]
        else:
            z, steps[0] = 0, int(normal[0])
        found = []
        for step in steps:
            z = (rho * z >> FACTOR_BITS) + step
            found.append(z)
        self._z_ends[number] = z
        return np.array(found, np.int64)

    def _at_instant(self, copies: Copies, sent_ns: int) -> Copies:
        """Returns what the instant of sending leaves of the copies of a message."""
        delays, windows = self.plan.delays, self.plan.blackouts
        if windows:
            at = bisect_right(windows, (sent_ns, NEVER_NS)) - 1
            if at >= 0 and sent_ns < windows[at][1]:
                return ()
        if isinstance(delays, DelayTrace) and delays.times_ns:
            delay_ns = delays.delays_ns[max(0, bisect_right(delays.times_ns, sent_ns) - 1)]
            return () if delay_ns == LOST else (delay_ns,) * len(copies)
        return copies


def _as_tuples(delays: Words) -> list[Copies]:
    """Returns the copies of each message of a block."""
    if (delays[:, 1] == LOST).all():
        return [(first,) if first != LOST else () for first in delays[:, 0].tolist()]
    return [tuple(each for each in pair if each != LOST) for pair in delays.tolist()]


@cache
def normal_table() -> Words:
    """Returns the table over u of the standard normal distribution, in units of 2⁻²⁸."""
    from statistics import NormalDist  # slow to import, and only correlated delays need it

    below = edges() * 2.0**-BITS
    below[0] = below[1] / 2  # the distribution has no end; its last cell ends in its middle
    half = np.array([round(z * 2**Z_BITS) for z in map(NormalDist().inv_cdf, below.tolist())])
    return np.concatenate((half, -half[-2::-1]))
