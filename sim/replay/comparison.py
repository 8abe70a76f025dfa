"""Two series of messages compared, message by message and value by value."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from echelon.messages import Channel
from echelon.plan.plan import NodePlan, Plan
from echelon.runtime.turns import Turn
from echelon.sim.replay.value_names import SQUARE
from echelon.sim.results.recorded import Series
from echelon.sim.results.trace import Array

_TURNS: Final = {
    Channel.WHEELS: Turn.HEAR,
    Channel.STATE: Turn.SAY,
    Channel.GROUP_STATE: Turn.GATHER,
    Channel.REFERENCE: Turn.STEER,
    Channel.COMMAND: Turn.STEER,
    Channel.TORQUE: Turn.ACT,
}
"""The turn in which the messages of a channel are sent"""


@dataclass(frozen=True, slots=True)
class Difference:
    """A place where two series differ: a value, or a message that only one of them has."""

    time_ns: int
    sequence: int
    """The message's number in the first series, or in the second if the first lacks the message"""
    member: str
    channel: Channel
    value: str = ""
    """Name of the value; empty if one series lacks the message"""
    first: float | None = None
    """The value in the first series; None if one series lacks the message"""
    second: float | None = None
    lacking: Literal["", "first", "second"] = ""
    """The series that lacks the message"""

    @property
    def time(self) -> float:
        """Run time [s]."""
        return self.time_ns / 1e9


@dataclass(frozen=True, slots=True)
class ChannelComparison:
    """The messages of one member on one channel, compared."""

    member: str
    channel: Channel
    compared: int
    """Messages that both series have"""
    equal: int
    """Of these, how many have equal values"""
    only_first: int
    """Messages that only the first series has"""
    only_second: int
    first_difference: Difference | None
    largest: Difference | None
    """The largest difference of a value, also if it is within the tolerance; of a square of a torque only if all other values
    are the same; None if all values are the same"""
    unshared: tuple[str, ...]
    """Values that only one series has; they are not compared"""

    @property
    def is_equal(self) -> bool:
        """True if nothing differs."""
        return self.first_difference is None and not self.unshared


def compare(
    plan: Plan,
    first: tuple[Series, Sequence[str]],
    second: tuple[Series, Sequence[str]],
    *,
    tolerance: float,
    by_time: bool = False,
    complete: bool = True,
) -> ChannelComparison:
    """Compares two series, each with the names of its values; `plan` is that of the first.

    Messages with the same sequence number belong together, or with `by_time` those of the same time.  Two values are equal if
    they differ by `tolerance` at most, or are both NaN.  A message that only one series has is a difference only if both are
    `complete`."""
    (one, names), (other, other_names) = first, second
    keys, other_keys = (one.times_ns, other.times_ns) if by_time else (one.sequences, other.sequences)
    _, rows, other_rows = np.intersect1d(keys, other_keys, assume_unique=not by_time, return_indices=True)
    in_both = set(names) & set(other_names)
    shared = [name for name in names if name in in_both]
    a = one.values[rows][:, [names.index(name) for name in shared]]
    b = other.values[other_rows][:, [other_names.index(name) for name in shared]]
    distances = _distances(a, b)
    unequal = distances > tolerance
    member = plan.all_roles[one.source].name

    def at(row: int, column: int) -> Difference:
        number = rows[row]
        return Difference(
            int(one.times_ns[number]),
            int(one.sequences[number]),
            member,
            one.channel,
            shared[column],
            float(a[row, column]),
            float(b[row, column]),
        )

    found: list[Difference] = []
    if unequal.any():
        row = int(np.argmax(unequal.any(axis=1)))
        found.append(at(row, int(np.argmax(unequal[row]))))
    alone = _alone(one, rows), _alone(other, other_rows)
    if complete and len(alone[0]):
        found.append(_lone(one, int(alone[0][0]), member, "second"))
    if complete and len(alone[1]):
        found.append(_lone(other, int(alone[1][0]), member, "first"))
    largest = None
    squares = [name.endswith(SQUARE) for name in shared]
    if distances[:, np.logical_not(squares)].any():  # squares of large torques would hide all other values
        distances[:, squares] = 0.0
    if distances.any():
        largest = at(*divmod(int(np.argmax(distances)), distances.shape[1]))
    return ChannelComparison(
        member,
        one.channel,
        len(rows),
        len(rows) - int(unequal.any(axis=1).sum()),
        len(alone[0]),
        len(alone[1]),
        min(found, key=lambda difference: difference.time_ns, default=None),
        largest,
        tuple(name for name in (*names, *other_names) if name not in in_both),
    )


def _lone(series: Series, row: int, member: str, lacking: Literal["first", "second"]) -> Difference:
    """Returns the difference for a message that only this series has."""
    return Difference(int(series.times_ns[row]), int(series.sequences[row]), member, series.channel, lacking=lacking)


def _distances(a: Array, b: Array) -> Array:
    """Returns |a - b|; 0 where both are the same or NaN, infinite where only one is NaN."""
    with np.errstate(invalid="ignore", over="ignore"):
        distances: Array = np.abs(a - b)
    distances[np.isnan(distances)] = inf
    distances[(a == b) | (np.isnan(a) & np.isnan(b))] = 0.0
    return distances


def _alone(series: Series, rows: NDArray[np.intp]) -> NDArray[np.intp]:
    """Returns the rows of a series that are not among `rows`."""
    found: NDArray[np.intp] = np.setdiff1d(np.arange(len(series.sequences)), rows, assume_unique=True)
    return found


def earliest(plan: Plan, channels: Iterable[ChannelComparison]) -> Difference | None:
    """Returns the first difference of all.  Of one instant it is the one of the earliest turn (`echelon.runtime.turns`): those
    of later turns may follow from it."""
    indices = {one.name: one.index for one in plan.all_roles}

    def order(difference: Difference) -> tuple[int, int, int, int]:
        turn, index = _TURNS[difference.channel], indices[difference.member]
        one = plan.all_roles[index]
        depth = one.depth if isinstance(one, NodePlan) else 0
        return difference.time_ns, turn.value, -depth if turn is Turn.GATHER else depth, index

    found = [each.first_difference for each in channels if each.first_difference is not None]
    return min(found, key=order, default=None)
