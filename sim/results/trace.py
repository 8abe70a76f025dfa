"""The trace of a run: the robots' states over time as arrays, collected in memory or read from a recording."""

import hashlib
from array import array
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.plan.plan import Plan

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Trace:
    """The states of all robots."""

    plan: Plan
    times_ns: tuple[NDArray[np.int64], ...]
    """For each robot its instants [ns], (T_i,), ascending"""
    states: tuple[NDArray[np.float64], ...]
    """For each robot its states at these instants, (T_i, len(STATE_FIELDS)); units in `messages`"""

    def common(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Returns the instants at which every robot has a state [ns], (T,), and the states, (T, robots, len(STATE_FIELDS))."""
        common = self.times_ns[0]
        for times in self.times_ns[1:]:
            if times.shape != common.shape or not np.array_equal(times, common):
                common = np.intersect1d(common, times, assume_unique=True)
        rows = [np.searchsorted(times, common) for times in self.times_ns]
        return common, np.stack([states[row] for states, row in zip(self.states, rows, strict=True)], axis=1)

    def digest(self) -> str:
        """Returns the digest of the trace (`Digest`)."""
        digest = Digest(len(self.states))
        for robot, states in enumerate(self.states):
            digest.update(robot, states)
        return digest.hexdigest()


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
        self._times = [array("q") for _ in plan.robots]
        self._states = [bytearray() for _ in plan.robots]

    def add(self, message: Message) -> None:
        """Adds a message; only states of robots are kept."""
        if message.channel is Channel.STATE:
            self._times[message.source].append(message.time_ns)
            self._states[message.source] += message.values.tobytes()

    def last(self) -> tuple[int, NDArray[np.float64]] | None:
        """Returns the latest instant that all robots have reached [ns], and each robot's last state, (robots,
        len(STATE_FIELDS)).

        Returns None as long as a robot has no state."""
        if not all(self._times):
            return None
        width = 8 * len(STATE_FIELDS)
        rows = [np.frombuffer(bytes(states[-width:])) for states in self._states]
        return min(times[-1] for times in self._times), np.array(rows)

    def build(self) -> Trace:
        """Returns the trace of all states that were added."""
        return Trace(
            self.plan,
            tuple(np.array(times, dtype=np.int64) for times in self._times),
            tuple(np.frombuffer(bytes(states)).reshape(-1, len(STATE_FIELDS)) for states in self._states),
        )
