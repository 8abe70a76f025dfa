"""What may come in: every message from another process is checked here before it is stored or used (docs/architecture.md, 3.7).

A receiver has one `Admission` for each source and channel that it hears.  The checks, in their order:

    check                                                  otherwise refused as
    -----------------------------------------------------  -------------------------------------------
    the header begins as all headers of this channel from  what `wire.decode` says; if it is a message:
    this source do: version, channel, source               `of another source or channel`
    the length is that of the number of values             what `wire.decode` says
    as many values as the plan says, or none (a null       `wrong number of values`
    message)
    its number is larger than that of the message before   `number sent before`
    its time is that of its number: first + number ·       `time does not fit its number`
    period, or later within the period if the source may
    act later than it is due
    its time is within the run, and not further ahead than `from the future`
    its source can be
    its values are finite and within their bounds          `values out of bounds`
    it has values, if its source always has something to   `no values`
    say (`ALWAYS`)

Of a message whose values alone are wrong the number is taken: it counts as a null message, so its receiver acts as if nothing
had come, and a lockstep goes on.  All others are dropped.  Since numbers rise and times are bounded, one source can fill no
queue with more messages than it may honestly send.  `echelon.runtime.admission_rules` makes the admissions of a plan.
"""

import struct
from collections.abc import Callable
from math import hypot
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.messages import NULL, Channel, Message, Values
from echelon.plan.can_plan import NEVER_NS
from echelon.runtime.wire import HEADER, SCHEMA_VERSION, WireError, decode

LARGEST: Final = 1e15
"""Bound of the root of the sum of squares of a message's values, each in its SI unit.  No formation is as far, as fast or as
strong; a run whose states are larger has diverged"""
LARGEST_SQUARE: Final = LARGEST * LARGEST
EARLY_NS: Final = 10_000_000_000
"""On a wall clock a process that does not know yet when the run starts takes messages of so much run time [ns]"""
OF_ANOTHER: Final = "of another source or channel"
MISSHAPEN: Final = "wrong number of values"
AGAIN: Final = "number sent before"
TIME: Final = "time does not fit its number"
FUTURE: Final = "from the future"
VALUES: Final = "values out of bounds"
EMPTY: Final = "no values"
ALWAYS: Final = frozenset({Channel.STATE, Channel.TORQUE, Channel.WHEELS})
"""Channels without null messages"""

Fits = Callable[[Values, int], bool]
"""Returns whether the values of a message of some time [ns] are within their bounds"""

_BEGIN: Final = struct.Struct("<HBBI")
_REST: Final = struct.Struct("<QqQ")
_unpack_rest: Final = _REST.unpack_from
BEGIN: Final = _BEGIN.size
"""Number of bytes by which a source and a channel are known"""
_HEADER_SIZE: Final = HEADER.size
_FLOAT64: Final = np.dtype("<f8")
_view: Final = np.frombuffer
_product: Final = np.vdot  # unlike `dot` it warns of nothing
_FEW: Final = 16
"""For so many values `hypot` is faster"""


class Refusals:
    """Counts of what was refused, by source and reason."""

    __slots__ = ("_counts",)

    def __init__(self) -> None:
        self._counts: dict[str, dict[str, int]] = {}

    def count(self, source: str, reason: str, number: int = 1) -> None:
        """Counts refusals."""
        counts = self._counts.setdefault(source, {})
        counts[reason] = counts.get(reason, 0) + number

    @property
    def total(self) -> int:
        """The number of all refusals."""
        return sum(sum(counts.values()) for counts in self._counts.values())

    def by_source(self) -> dict[str, dict[str, int]]:
        """Returns the counts by source, then by reason."""
        return {source: dict(counts) for source, counts in list(self._counts.items())}  # another thread may count


class Admission:
    """The checks of all messages of one source on one channel, for one receiver."""

    __slots__ = (
        "_ahead_ns",
        "_begin",
        "_end_ns",
        "_first_ns",
        "_fits",
        "_late_ns",
        "_name",
        "_period_ns",
        "_refusals",
        "_size",
        "channel",
        "newest",
        "source",
        "time_ns",
    )

    def __init__(
        self,
        refusals: Refusals,
        name: str,
        source: int,
        channel: Channel,
        size: int | None,
        *,
        first_ns: int = 0,
        period_ns: int = 0,
        late_ns: int = 0,
        end_ns: int = NEVER_NS,
        ahead_ns: int = 0,
        fits: Fits | None = None,
    ) -> None:
        """Refusals are counted in `refusals` by the `name` of the source.

        Message number k is due at `first_ns` + k `period_ns` and sent up to `late_ns` later.  With `period_ns` 0 a number says
        nothing about the time, which must not fall.  No message is sent after `end_ns`, or more than `ahead_ns` after the
        instant at which its receiver is."""
        self._refusals, self._name = refusals, name
        self.source, self.channel = source, channel
        self._begin = _BEGIN.pack(SCHEMA_VERSION, channel, 0, source)
        self._size = size
        self._first_ns, self._period_ns, self._late_ns = first_ns, period_ns, late_ns
        self._end_ns, self._ahead_ns = end_ns, ahead_ns
        self._fits = fits
        self.newest = -1
        """The number of the last message that was admitted"""
        self.time_ns = first_ns
        """Its time [ns]"""

    @property
    def name(self) -> str:
        """The name of its source."""
        return self._name

    @property
    def begin(self) -> bytes:
        """The first eight bytes of each of its messages."""
        return self._begin

    def admit(self, payload: bytes, now_ns: int) -> Message | None:
        """Returns the message of a payload that comes when its receiver is at `now_ns`; None if it is refused."""
        length = len(payload)
        if length < _HEADER_SIZE or not payload.startswith(self._begin):
            return self._refuse(why(payload))
        number, time_ns, count = _unpack_rest(payload, BEGIN)
        if length != _HEADER_SIZE + 8 * count:
            return self._refuse(why(payload))
        if count and count != self._size and self._size is not None:
            return self._refuse(MISSHAPEN)
        if number <= self.newest:
            return self._refuse(AGAIN)
        if self._period_ns:
            if not 0 <= time_ns - self._first_ns - number * self._period_ns <= self._late_ns:
                return self._refuse(TIME)
        elif time_ns < self.time_ns:
            return self._refuse(TIME)
        if time_ns > self._end_ns or time_ns > now_ns + self._ahead_ns:
            return self._refuse(FUTURE)
        self.newest, self.time_ns = number, time_ns
        if not count:
            if self.channel in ALWAYS:
                self._refusals.count(self._name, EMPTY)
            return Message(self.channel, self.source, number, time_ns, NULL)
        values = _view(payload, _FLOAT64, count, _HEADER_SIZE)
        fits = self._fits
        if not (within(values) if fits is None else fits(values, time_ns)):
            self._refusals.count(self._name, VALUES)
            values = NULL
        return Message(self.channel, self.source, number, time_ns, values)

    def _refuse(self, reason: str) -> Message | None:
        """Counts a refusal; returns None."""
        self._refusals.count(self._name, reason)
        return None


def why(payload: bytes) -> str:
    """Returns why a payload is refused that does not begin as it should, or has another length."""
    try:
        decode(payload)
    except WireError as error:
        return error.reason
    return OF_ANOTHER


def within(values: Values) -> bool:
    """Returns whether values are finite and within the bounds of all messages: the root of the sum of their squares is at most
    `LARGEST`."""
    if values.size <= _FEW:
        return hypot(*values.tolist()) <= LARGEST  # false for NaN
    return bool(_product(values, values) <= LARGEST_SQUARE)  # a sum may overflow


def rows_within(rows: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Returns for each row of values, (…, n), what `within` says of it, (…)."""
    with np.errstate(all="ignore"):  # a sum may overflow
        found: NDArray[np.bool_] = np.einsum("...n,...n->...", rows, rows) <= LARGEST_SQUARE
    return found
