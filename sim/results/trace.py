"""What a run was, as arrays: the robots' states over time, gathered in memory or read back from a recording."""

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
    """States of all robots: per robot (by index) its instants [ns], (T_i,), and states, (T_i, len(STATE_FIELDS))."""

    plan: Plan
    times_ns: tuple[NDArray[np.int64], ...]
    states: tuple[NDArray[np.float64], ...]

    def common(self) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
        """Returns the instants at which every robot has a state, (T,), and the states, (T, robots, fields)."""
        common = self.times_ns[0]
        for times in self.times_ns[1:]:
            if times.shape != common.shape or not np.array_equal(times, common):
                common = np.intersect1d(common, times, assume_unique=True)
        rows = [np.searchsorted(times, common) for times in self.times_ns]
        return common, np.stack([states[row] for states, row in zip(self.states, rows, strict=True)], axis=1)

    def digest(self) -> str:
        """Returns the trace digest (`Digest`)."""
        digest = Digest(len(self.states))
        for robot, states in enumerate(self.states):
            digest.update(robot, states)
        return digest.hexdigest()


class Digest:
    """SHA-256 over the robots' states: per robot over its float64 in order of time, then over those in robot order.

    It does not depend on the order in which robots' states come, only on each robot's own order."""

    def __init__(self, robots: int) -> None:
        self._robots = [hashlib.sha256() for _ in range(robots)]

    def update(self, robot: int, states: NDArray[np.float64]) -> None:
        """Takes one state or several of a robot."""
        self._robots[robot].update(np.ascontiguousarray(states, dtype="<f8").data)

    def hexdigest(self) -> str:
        """Returns the digest of all states so far."""
        return hashlib.sha256(b"".join(robot.digest() for robot in self._robots)).hexdigest()


class TraceBuilder:
    """Gathers state messages into a Trace; keeps the bytes of the values, not the messages."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self._times = [array("q") for _ in plan.robots]
        self._states = [bytearray() for _ in plan.robots]

    def add(self, message: Message) -> None:
        """Takes any message; only robots' states are kept."""
        if message.channel is Channel.STATE:
            self._times[message.source].append(message.time_ns)
            self._states[message.source] += message.values.tobytes()

    def last(self) -> tuple[int, NDArray[np.float64]] | None:
        """Returns the latest instant [ns] that all robots have reached and their last states, (robots, fields)."""
        if not all(self._times):
            return None
        width = 8 * len(STATE_FIELDS)
        rows = [np.frombuffer(bytes(states[-width:])) for states in self._states]
        return min(times[-1] for times in self._times), np.array(rows)

    def build(self) -> Trace:
        """Returns the trace of what was added."""
        return Trace(
            self.plan,
            tuple(np.array(times, dtype=np.int64) for times in self._times),
            tuple(np.frombuffer(bytes(states)).reshape(-1, len(STATE_FIELDS)) for states in self._states),
        )
