"""The trace of a run: the robots' states over time as arrays, collected in a run or read from a recording."""

import hashlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from echelon.large_arrays import Rows, RowsInFile, large_empty
from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.plan.plan import Plan

Array = NDArray[np.float64]
ALL: Final = tuple(range(len(STATE_FIELDS)))
WINDOW: Final = 8192
"""Instants of a piece of a trace"""


@dataclass(frozen=True, slots=True)
class Trace:
    """The states of all robots.  Those of a long run are in a file, and come into memory as they are used."""

    plan: Plan
    times_ns: tuple[NDArray[np.int64], ...]
    """For each robot its instants [ns], (T_i,), ascending"""
    states: tuple[NDArray[np.float64], ...]
    """For each robot its states at these instants, (T_i, len(STATE_FIELDS)); units in `messages`"""
    in_file: RowsInFile | None = None
    """Where they are in a file of this process"""

    def __reduce__(self) -> tuple[Any, ...]:
        """Another process that gets a trace opens its file, as long as this process keeps what it was built with."""
        if self.in_file is None:
            return Trace, (self.plan, self.times_ns, self.states)
        return _reopened, (self.plan, self.in_file)

    def common_ns(self) -> NDArray[np.int64]:
        """Returns the instants at which every robot has a state [ns], (T,)."""
        return self._common()[0]

    def common(self, fields: Sequence[int] = ALL) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Returns the instants at which every robot has a state [ns], (T,), and the `fields` of the states, (T, robots,
        len(fields)); fields by their index in STATE_FIELDS."""
        common, rows = self._common()
        return common, self._picked(rows, slice(None), fields)

    def windows(self, fields: Sequence[int], *, overlap: int = 0) -> Iterator[tuple[slice, NDArray[np.float64]]]:
        """Yields what `common` returns in pieces, in order: where a piece is among the T instants, and its states.

        Each piece begins with the last `overlap` instants of the piece before."""
        common, rows = self._common()
        for start in range(0, max(len(common) - overlap, min(len(common), 1)), WINDOW):
            part = slice(start, min(start + WINDOW + overlap, len(common)))
            yield part, self._picked(rows, part, fields)

    def _common(self) -> tuple[NDArray[np.int64], list[NDArray[np.int64]] | None]:
        """Returns the common instants, and for each robot their places among its own; None if all have the same instants."""
        common = first = self.times_ns[0]
        for times in self.times_ns[1:]:
            if times.shape != common.shape or not np.array_equal(times, common):
                common = np.intersect1d(common, times, assume_unique=True)
        if common is first:
            return common, None
        return common, [np.searchsorted(times, common) for times in self.times_ns]

    def _picked(self, rows: list[NDArray[np.int64]] | None, part: slice, fields: Sequence[int]) -> NDArray[np.float64]:
        robots = len(self.states)
        first = self.states[0][part] if rows is None else rows[0][part]
        picked = large_empty((len(first), robots, len(fields)))
        for robot, states in enumerate(self.states):
            of_robot = states[part] if rows is None else states[rows[robot][part]]
            picked[:, robot] = of_robot if fields is ALL else of_robot[:, fields]
        return picked

    def digest(self) -> str:
        """Returns the digest of the trace (`Digest`)."""
        digest = Digest(len(self.states))
        for robot, states in enumerate(self.states):
            digest.update(robot, states)
        return digest.hexdigest()


def _reopened(plan: Plan, in_file: RowsInFile) -> Trace:
    return Trace(plan, *in_file.read())


class Digest:
    """The digest of a trace: SHA-256 over the SHA-256 hashes of all robots, in the order of the plan.

    The hash of a robot is over its states as float64, little endian, in order of time.  So the digest does not depend on the
    order in which the states of different robots arrive."""

    def __init__(self, robots: int) -> None:
        self._robots = [hashlib.sha256() for _ in range(robots)]

    def update(self, robot: int, states: NDArray[np.float64]) -> None:
        """Adds one or several states of a robot (by index)."""
        self._robots[robot].update(np.ascontiguousarray(states, dtype="<f8").data)

    def hexdigest(self) -> str:
        """Returns the digest of all states so far."""
        return hashlib.sha256(b"".join(robot.digest() for robot in self._robots)).hexdigest()


class TraceBuilder:
    """Collects state messages into a Trace.  It keeps the bytes of their values, not the messages."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._rows = Rows([plan.duration_ns // robot.period_ns + 1 for robot in plan.robots], len(STATE_FIELDS))

    def add(self, message: Message) -> None:
        """Adds a message; only states of robots are kept."""
        if message.channel is Channel.STATE:
            self._rows.add(message.source, message.time_ns, message.values.tobytes())

    @property
    def surplus(self) -> int:
        """Number of states that are not kept, since a robot had more of them than there are instants in the plan."""
        return self._rows.surplus

    @property
    def failure(self) -> str | None:
        """Why no more states are kept, if they are in a file that cannot be written; None otherwise."""
        return self._rows.failure

    def last(self) -> tuple[int, NDArray[np.float64]] | None:
        """Returns the latest instant that all robots have reached [ns], and each robot's last state, (robots,
        len(STATE_FIELDS)).

        Returns None as long as a robot has no state."""
        rows = self._rows.last()
        if rows is None:
            return None
        return min(time_ns for time_ns, _ in rows), np.array([np.frombuffer(state) for _, state in rows])

    def build(self) -> Trace:
        """Returns the trace of all states that were added."""
        return Trace(self.plan, *self._rows.build())
