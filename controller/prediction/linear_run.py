"""The run near its formation, as an exact linear map of one hyperperiod (docs/architecture.md, 2.7).

Near the formation, with avoidance silent and torques that do what accelerations ask, a run is linear in its errors:

- a robot is a double integrator under the acceleration a that it holds: p⁺ = p + T v + T²/2 a, v⁺ = v + T a;
- a node is the matrices of `controller.node.NodeLaw`, and integral action within its bounds where the law has it;
- with constant delays a stage acts in the long run at the same instants of each hyperperiod, and uses the same messages
  (`controller.prediction.schedule`).

All periods divide that of the root, the *hyperperiod* H.  The state x at its beginning is (p, v) of all robots, the integrals q
of nodes whose law has them, and the messages on their way.  Unit vectors of x go through all stages of one hyperperiod, in the
order of their turns (`echelon.runtime.turns`):

    x⁺ = M x

Time is counted in hyperperiods, so x has (p, H v, H² a, q/H) and the numbers in M are of one size whatever the periods.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import gcd
from typing import Final

import numpy as np
from scipy.sparse import coo_array, csr_array

from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_roles import LinearNode, LinearRobot, powers_of
from echelon.controller.prediction.schedule import schedule
from echelon.messages import Channel
from echelon.plan.layout import with_message_sizes
from echelon.plan.plan import Array, LinkPlan, Plan
from echelon.plan.punctuality import with_punctuality

CHANNELS: Final = (Channel.STATE, Channel.GROUP_STATE, Channel.REFERENCE, Channel.COMMAND, Channel.TORQUE)
"""Of the links that a scenario's rules are about; the others stand for shafts and buses"""


@dataclass(frozen=True, slots=True)
class Loop:
    """The linear run, cut open where one channel is said.  y is what is said there in a hyperperiod, and u what is handed over
    as if it had been said in this hyperperiod:

        x⁺ = A x + B u,   y = C x + D u
    """

    A: csr_array
    B: csr_array
    C: csr_array
    D: csr_array


def untreated(plan: Plan) -> tuple[LinkPlan, ...]:
    """Returns the links that are no part of a linear map: their messages are lost at times, or take different times."""
    return tuple(link for link in plan.links if not link.steady)


def later(plan: Plan, channel: Channel, extra_ns: int) -> Plan:
    """Returns a plan in which all messages of a channel of `CHANNELS` take longer."""

    def longer(link: LinkPlan) -> LinkPlan:
        if link.channel is not channel or not _is_ruled(plan, link):
            return link
        return replace(link, delay_min_ns=link.delay_min_ns + extra_ns, delay_max_ns=link.delay_max_ns + extra_ns)

    return replace(plan, links=tuple(with_punctuality(list(map(longer, plan.links)), plan.nodes)))


def ruled_links(plan: Plan, channel: Channel) -> list[LinkPlan]:
    """Returns the links of a channel of `CHANNELS` that a scenario's rules are about."""
    return [link for link in plan.links if link.channel is channel and _is_ruled(plan, link)]


def _is_ruled(plan: Plan, link: LinkPlan) -> bool:
    """False for the torques that the drives are told: they stand for the bus, and are never late."""
    return link.channel in CHANNELS and (plan.drives is None or link.receiver != plan.drives.index)


class LinearRun:
    """The linear run of a plan whose links have constant delays and lose nothing.

    Left out, for they are not linear: avoidance, limits of torque and speed, how a robot turns, and, where the torque path is
    closed, what buses and drives do."""

    def __init__(self, plan: Plan) -> None:
        """Raises PredictionError if the law is not linear, a link is not constant, or messages are older than their link's
        timeout when they would be used."""
        if found := untreated(plan):
            raise PredictionError(f"{len(found)} of {len(plan.links)} links lose messages or have delays that vary")
        self.plan = plan = with_message_sizes(replace(plan, avoidance=replace(plan.avoidance, enabled=False)))
        self.hyperperiod_ns = plan.root.period_ns
        robots = [LinearRobot(plan, robot) for robot in plan.robots]
        nodes = [LinearNode(plan, node) for node in plan.nodes]
        self._roles: list[LinearRobot | LinearNode] = [*robots, *nodes]
        self._stages = sorted(
            (stage for role in self._roles for stage in role.stages), key=lambda stage: stage.timed.level
        )
        self._tick_ns = gcd(*(stage.timed.period_ns for stage in self._stages))
        self._schedule = schedule(plan, [stage.timed for stage in self._stages])
        self._wires = self._make_wires()
        self._places: list[int] = []
        """Where in x the memory of each role begins"""
        self.size = 0
        """Of x"""
        for role in self._roles:
            self._places.append(self.size)
            self.size += len(role.powers)
        for wire in self._wires.values():
            wire.at = self.size
            self.size += wire.on_way * wire.size

    def periods(self, channel: Channel | None = None) -> set[int]:
        """Returns the periods of all stages [ns], or of those that hear a channel."""
        return {
            stage.timed.period_ns
            for stage in self._stages
            if channel is None or any(heard.channel is channel for heard in stage.timed.inputs)
        }

    def map(self) -> csr_array:
        """Returns M, (size, size)."""
        return self._through(None).A

    def loop(self, channel: Channel) -> Loop:
        """Returns the linear run, cut open where a channel is said."""
        return self._through(channel)

    def _units(self, powers: Sequence[int]) -> Array:
        """Returns H to the powers of time of some numbers."""
        return (self.hyperperiod_ns * 1e-9) ** np.array(powers, dtype=float)

    def _make_wires(self) -> "dict[tuple[int, Channel], _Wire]":
        """Returns the wires of all that is heard, by source and channel."""
        plan = self.plan
        periods = {(link.source, link.channel): link.period_ns for link in plan.links}
        wires: dict[tuple[int, Channel], _Wire] = {}
        for stage, acts in zip(self._stages, self._schedule, strict=True):
            for act in (act for some in acts.values() for act in some):
                for heard, number in zip(stage.timed.inputs, act.used, strict=True):
                    at = heard.source, heard.channel
                    if at not in wires:
                        wires[at] = _Wire(periods[at], self._units(powers_of(plan, *at)))
                    wires[at].used.add(number)
        return wires

    def _through(self, cut: Channel | None) -> Loop:
        """Takes unit vectors through one hyperperiod."""
        hyperperiod_ns, wires, columns = self.hyperperiod_ns, self._wires, _Columns()
        units = [self._units(role.powers) for role in self._roles]
        memories = [columns.of_x(at, unit) for at, unit in zip(self._places, units, strict=True)]
        old = {
            (wire, number): columns.of_x(wire.place(number), wire.unit)
            for wire in wires.values()
            for number in sorted(wire.used)
            if number < 0
        }
        given = {
            (wire, number): columns.of_u(wire.unit)
            for (_, channel), wire in wires.items()
            if channel is cut
            for number in range(hyperperiod_ns // wire.period_ns)
        }
        for role, seed in zip(self._roles, memories, strict=True):
            role.memory = columns.unit_vectors(seed)
        for wire in wires.values():
            wire.said.clear()
        for (wire, number), seed in (old | given).items():
            wire.said[number] = columns.unit_vectors(seed)
        said: dict[tuple[_Wire, int], Array] = {}

        for time_ns in range(0, hyperperiod_ns, self._tick_ns):
            for stage, acts in zip(self._stages, self._schedule, strict=True):
                if time_ns not in acts:
                    continue
                inputs = [wires[heard.source, heard.channel].said for heard in stage.timed.inputs]
                heard = [
                    (after_ns, [said[number] for said, number in zip(inputs, used, strict=True)])
                    for after_ns, used in acts[time_ns]
                ]
                values = stage.run(heard)
                for channel, period_ns in stage.timed.says:
                    if time_ns % period_ns == 0 and (stage.timed.member, channel) in wires:
                        wire, number = wires[stage.timed.member, channel], time_ns // period_ns
                        said[wire, number] = values[channel]
                        if (wire, number) not in given:
                            wire.said[number] = values[channel]

        rows = _Rows(columns)
        for role, at, unit in zip(self._roles, self._places, units, strict=True):
            rows.add(at, unit[:, None] * role.memory)
        for wire in wires.values():
            for number in range(-wire.on_way, 0):
                now = number + hyperperiod_ns // wire.period_ns  # as it is numbered in the hyperperiod that ends
                if now in wire.said:
                    rows.add(wire.place(number), wire.unit[:, None] * wire.said[now])
                else:
                    rows.move(wire.place(number), wire.place(now), wire.size)
        A, B = rows.matrices(self.size, self.size)
        out, at = _Rows(columns), 0
        for wire, number in given:
            out.add(at, wire.unit[:, None] * said[wire, number])
            at += wire.size
        C, D = out.matrices(at, self.size)
        return Loop(A, B, C, D)


class _Wire:
    """All that one source says on one channel."""

    def __init__(self, period_ns: int, unit: Array) -> None:
        self.period_ns, self.unit, self.size = period_ns, unit, len(unit)
        self.used: set[int] = set()
        """Numbers of the messages that are used in the hyperperiod from 0 on; number 0 is said in its first period"""
        self.at = 0
        """Where the messages on their way stand in x, the oldest first"""
        self.said: dict[int, Array] = {}

    @property
    def on_way(self) -> int:
        """How many messages of earlier hyperperiods are used in this one, or may be in later ones."""
        return max(0, -min(self.used))

    def place(self, number: int) -> int:
        """Returns where a message of an earlier hyperperiod begins in x."""
        return self.at + (self.on_way + number) * self.size


class _Columns:
    """The unit vectors that are taken through: those of x that the hyperperiod uses, then those of u."""

    def __init__(self) -> None:
        self.x: list[int] = []
        """Where in x each of the first columns stands"""
        self.u = 0
        """How many are of u"""

    def of_x(self, at: int, unit: Array) -> tuple[int, Array]:
        """Adds the columns of what stands at a place in x; they come before all of u."""
        self.x.extend(range(at, at + len(unit)))
        return len(self.x) - len(unit), unit

    def of_u(self, unit: Array) -> tuple[int, Array]:
        """Adds columns of u."""
        self.u += len(unit)
        return len(self.x) + self.u - len(unit), unit

    def unit_vectors(self, seed: tuple[int, Array]) -> Array:
        """Returns what stands at added columns as a matrix over all of them, in SI units."""
        at, unit = seed
        matrix = np.zeros((len(unit), len(self.x) + self.u))
        matrix[np.arange(len(unit)), at + np.arange(len(unit))] = 1 / unit
        return matrix


class _Rows:
    """Rows of a matrix over x and u, as they are found."""

    def __init__(self, columns: _Columns) -> None:
        self._columns = columns
        self._found: list[tuple[int, Array]] = []
        self._moved: list[tuple[int, int]] = []

    def add(self, at: int, values: Array) -> None:
        """Adds rows over the columns, the first of them number `at`."""
        self._found.append((at, values))

    def move(self, at: int, source: int, size: int) -> None:
        """Adds rows that are what stands at `source` in x."""
        self._moved += [(at + each, source + each) for each in range(size)]

    def matrices(self, rows: int, size: int) -> tuple[csr_array, csr_array]:
        """Returns the rows over x and over u."""
        count = len(self._columns.x)
        stacked = (
            np.vstack([values for _, values in self._found]) if self._found else np.zeros((0, count + self._columns.u))
        )
        at = np.concatenate([start + np.arange(len(values)) for start, values in self._found] or [np.zeros(0, int)])
        one, two = stacked.nonzero()
        is_x = two < count
        moved = np.array(self._moved, dtype=int).reshape(-1, 2)
        x = np.array(self._columns.x, dtype=int)
        over_x = coo_array(
            (
                np.concatenate([stacked[one[is_x], two[is_x]], np.ones(len(moved))]),
                (np.concatenate([at[one[is_x]], moved[:, 0]]), np.concatenate([x[two[is_x]], moved[:, 1]])),
            ),
            (rows, size),
        )
        over_u = coo_array(
            (stacked[one[~is_x], two[~is_x]], (at[one[~is_x]], two[~is_x] - count)), (rows, self._columns.u)
        )
        return over_x.tocsr(), over_u.tocsr()
