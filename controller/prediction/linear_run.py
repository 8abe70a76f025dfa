"""The run near its formation, as an exact linear map of one hyperperiod (docs/architecture.md, 2.7).

Near the formation, with avoidance silent and torques that do what accelerations ask, a run is linear in its errors:

- a robot is a double integrator under the acceleration a that it holds: p⁺ = p + T v + T²/2 a, v⁺ = v + T a;
- a node is the matrices of `controller.node.NodeLaw`, and integral action within its bounds where the law has it;
- with constant delays a stage acts in the long run at the same instants of each hyperperiod, and uses the same messages
  (`controller.prediction.schedule`).

All periods divide that of the root, the *hyperperiod* H.  The state x at the beginning of a hyperperiod consists of (p, v) of
all robots, the integrals q of nodes whose law has them, and the messages on their way.  M is found by taking unit vectors of x
through all stages of one hyperperiod, in the order of their turns (`echelon.runtime.turns`):

    x⁺ = M x

Time is counted in hyperperiods: x contains (p, H v, H² a, q/H), so the numbers in M are of similar size whatever the periods.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import gcd
from typing import Final

import numpy as np
from scipy.sparse import csr_array

from echelon.controller.late_states import EXTRAPOLATE, PREDICT
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_roles import LinearNode, LinearRobot, powers_of
from echelon.controller.prediction.schedule import schedule
from echelon.controller.prediction.unit_vectors import Columns, Rows
from echelon.messages import Channel
from echelon.plan.delay_tables import LOST, DelayTable, DelayTrace
from echelon.plan.layout import with_message_sizes
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, Plan
from echelon.plan.punctuality import with_punctuality

CHANNELS: Final = (Channel.STATE, Channel.GROUP_STATE, Channel.REFERENCE, Channel.COMMAND, Channel.TORQUE)
"""The channels to which the rules in a scenario's `links` apply; links of other channels stand for shafts and buses"""


Edge = tuple[int, int, Channel]
"""A link: source, receiver, channel"""
Edges = frozenset[Edge]


@dataclass(frozen=True, slots=True)
class Loop:
    """The linear run, cut open where the messages of some links are sent.  y are the messages that are sent in a hyperperiod,
    u are the messages that these links take in their place:

        x⁺ = A x + B u,   y = C x + D u
    """

    A: csr_array
    B: csr_array
    C: csr_array
    D: csr_array


def untreated(plan: Plan) -> tuple[LinkPlan, ...]:
    """Returns the links that the linear run cannot describe: they lose messages, their delays vary, or their states are brought
    to the present by a policy."""
    return tuple(link for link in plan.links if not link.steady or link.policy in (EXTRAPOLATE, PREDICT))


def lags(plan: Plan) -> bool:
    """Returns whether a moving formation keeps an error that the linear run does not have: late positions are compared with the
    reference of the present (`law.reference = "now"`)."""
    up = (Channel.STATE, Channel.GROUP_STATE)
    return plan.reference == "now" and any(link.delay_max_ns or link.loss for link in plan.links if link.channel in up)


def edges_of(plan: Plan, late: Channel | Edges) -> Edges:
    """Returns the links of a channel of `CHANNELS`, or these links themselves."""
    return late if isinstance(late, frozenset) else frozenset(map(edge_of, ruled_links(plan, late)))


def edge_of(link: LinkPlan) -> Edge:
    """Returns which link this is."""
    return link.source, link.receiver, link.channel


def later(plan: Plan, late: Channel | Edges, extra_ns: int) -> Plan:
    """Returns the plan with `extra_ns` added to the delays of some links, or of all links of a channel of `CHANNELS`."""
    edges = edges_of(plan, late)
    moved: dict[int, DelayTable | DelayTrace] = {}  # equal tables stay one object

    def longer(link: LinkPlan) -> LinkPlan:
        if edge_of(link) not in edges:
            return link
        delays = link.delays
        if delays is not None:
            if id(delays) not in moved:
                each_ns = tuple(each if each == LOST else each + extra_ns for each in delays.delays_ns)
                moved[id(delays)] = replace(delays, delays_ns=each_ns)
            delays = moved[id(delays)]
        return replace(
            link,
            delay_min_ns=link.delay_min_ns + extra_ns,
            delay_max_ns=link.delay_max_ns + extra_ns,
            delays=delays,
        )

    return replace(plan, links=tuple(with_punctuality(list(map(longer, plan.links)), plan.nodes)))


def ruled_links(plan: Plan, channel: Channel) -> list[LinkPlan]:
    """Returns the links of a channel of `CHANNELS` to which the rules of a scenario apply."""
    return [link for link in plan.links if link.channel is channel and _is_ruled(plan, link)]


def _is_ruled(plan: Plan, link: LinkPlan) -> bool:
    """Returns whether the rules of a scenario apply to a link; not to torques for the drives: they stand for the bus, without
    delay."""
    return link.channel in CHANNELS and (plan.drives is None or link.receiver != plan.drives.index)


class LinearRun:
    """The linear run of a plan whose links have constant delays and lose no messages.

    It leaves out what is not linear: avoidance, limits of torque and speed, the robots' headings, and on a closed torque path
    buses and drives."""

    def __init__(self, plan: Plan) -> None:
        """Raises PredictionError if the law is not linear, if a link loses messages or has varying delays, or if messages are
        older than their link's timeout when they would be used."""
        if found := untreated(plan):
            raise PredictionError(f"{len(found)} of {len(plan.links)} links lose messages or have delays that vary")
        self.plan = plan = with_message_sizes(replace(plan, avoidance=replace(plan.avoidance, enabled=False)))
        self.hyperperiod_ns = plan.root.period_ns
        robots = [LinearRobot(plan, robot) for robot in plan.robots]
        nodes = [LinearNode(plan, node) for node in plan.nodes]
        self._roles: list[LinearRobot | LinearNode] = [*robots, *nodes]
        self.stages = sorted(
            (stage for role in self._roles for stage in role.stages), key=lambda stage: stage.timed.level
        )
        """All stages, in the order of their levels"""
        self._tick_ns = gcd(*(stage.timed.period_ns for stage in self.stages))
        self.schedule = schedule(plan, [stage.timed for stage in self.stages])
        """For each stage when it acts, and with which messages"""
        self._places = [0]
        """Where in x the memory of each role begins, and where the last one ends"""
        for role in self._roles:
            self._places.append(self._places[-1] + len(role.powers))
        self._wires, self.size = self._lay_out(frozenset())

    def periods(self, late: Edges | None = None) -> set[int]:
        """Returns the periods of all stages [ns], or of the stages that use messages of some links."""
        return {
            stage.timed.period_ns
            for stage in self.stages
            if late is None
            or any((heard.source, stage.timed.member, heard.channel) in late for heard in stage.timed.inputs)
        }

    def map(self) -> csr_array:
        """Returns M, (size, size)."""
        return self._through(frozenset()).A

    def loop(self, cut: Edges) -> Loop:
        """Returns the linear run, cut open where the messages of some links are sent."""
        return self._through(cut)

    def _units(self, powers: Sequence[int]) -> Array:
        """Returns H to these powers: the factors that turn numbers in SI units into components of x."""
        return (self.hyperperiod_ns * 1e-9) ** np.array(powers, dtype=float)

    def _lay_out(self, cut: Edges) -> "tuple[dict[_Key, _Wire], int]":
        """Returns the wires of all that is heard, and the number of components of x.  Where links are cut, their receivers have
        a wire of their own."""
        plan = self.plan
        periods = {(link.source, link.channel): link.period_ns for link in plan.links}
        wires: dict[_Key, _Wire] = {}
        for stage, acts in zip(self.stages, self.schedule, strict=True):
            for act in (act for some in acts.values() for act in some):
                for heard, number in zip(stage.timed.inputs, act.used, strict=True):
                    at = heard.source, heard.channel
                    key = *at, (heard.source, stage.timed.member, heard.channel) in cut
                    if key not in wires:
                        wires[key] = _Wire(periods[at], self._units(powers_of(plan, *at)))
                    wires[key].used.add(number)
        size = self._places[-1]
        for wire in wires.values():
            wire.at = size
            size += wire.on_way * wire.size
        return wires, size

    def _through(self, cut: Edges) -> Loop:
        """Takes unit vectors through one hyperperiod; returns the linear run, cut open at the links `cut`."""
        hyperperiod_ns, columns = self.hyperperiod_ns, Columns()
        wires, size = self._lay_out(cut) if cut else (self._wires, self.size)
        units = [self._units(role.powers) for role in self._roles]
        memories = [columns.of_x(at, unit) for at, unit in zip(self._places[:-1], units, strict=True)]
        old = {
            (wire, number): columns.of_x(wire.place(number), wire.unit)
            for wire in wires.values()
            for number in sorted(wire.used)
            if number < 0
        }
        given = {
            (wire, number): columns.of_u(wire.unit)
            for (_, _, is_cut), wire in wires.items()
            if is_cut
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
            for stage, acts in zip(self.stages, self.schedule, strict=True):
                if time_ns not in acts:
                    continue
                member = stage.timed.member
                inputs = [
                    wires[heard.source, heard.channel, (heard.source, member, heard.channel) in cut].said
                    for heard in stage.timed.inputs
                ]
                heard = [
                    (after_ns, [said[number] for said, number in zip(inputs, used, strict=True)])
                    for after_ns, used in acts[time_ns]
                ]
                values = stage.run(heard)
                for channel, period_ns in stage.timed.says:
                    if time_ns % period_ns:
                        continue
                    number = time_ns // period_ns
                    if (cut_wire := wires.get((member, channel, True))) is not None:
                        said[cut_wire, number] = values[channel]
                    if (whole_wire := wires.get((member, channel, False))) is not None:
                        whole_wire.said[number] = values[channel]

        rows = Rows(columns)
        for role, at, unit in zip(self._roles, self._places[:-1], units, strict=True):
            rows.add(at, unit[:, None] * role.memory)
        for wire in wires.values():
            for number in range(-wire.on_way, 0):
                now = number + hyperperiod_ns // wire.period_ns  # its number as counted in the hyperperiod that ends
                if now in wire.said:
                    rows.add(wire.place(number), wire.unit[:, None] * wire.said[now])
                else:
                    rows.move(wire.place(number), wire.place(now), wire.size)
        A, B = rows.matrices(size, size)
        out, at = Rows(columns), 0
        for wire, number in given:
            out.add(at, wire.unit[:, None] * said[wire, number])
            at += wire.size
        C, D = out.matrices(at, size)
        return Loop(A, B, C, D)


_Key = tuple[int, Channel, bool]
"""Source and channel of a wire, and whether its links are cut"""


class _Wire:
    """The messages of one source on one channel.  Message number 0 is sent at time 0, the beginning of the hyperperiod."""

    def __init__(self, period_ns: int, unit: Array) -> None:
        self.period_ns, self.unit, self.size = period_ns, unit, len(unit)
        self.used: set[int] = set()
        """Numbers of the messages that are used in the hyperperiod from 0 on; number 0 is said in its first period"""
        self.at = 0
        """Where in x the messages on their way begin, the oldest first"""
        self.said: dict[int, Array] = {}
        """Messages by number"""

    @property
    def on_way(self) -> int:
        """How many messages of earlier hyperperiods are used in this one, or may be in later ones."""
        return max(0, -min(self.used))

    def place(self, number: int) -> int:
        """Returns where a message of an earlier hyperperiod begins in x."""
        return self.at + (self.on_way + number) * self.size
