"""The linear run with links that lose messages, as steps (docs/architecture.md, 2.11).

*Time-driven* nodes act at their instants with what has come, whatever is lost.  All periods and constant delays are treated.

*Event-driven* nodes wait for a lost message to the end of their period (docs/architecture.md, 4.6), and a node that is late
makes all that is below it late.  This is exact where all periods are equal and only states have delays:

    every state and group state comes    the coordinator acts once all are there, and so does a node below, if all references
                                         from the coordinator down to it come
    otherwise                            the node acts at the end of the period; until then its robots keep their accelerations
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from math import gcd

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_roles import LinearStage
from echelon.controller.prediction.policies import check_policy
from echelon.controller.prediction.random_branches import Either, Window, forced, needs
from echelon.controller.prediction.random_delays import check_delays, varies
from echelon.controller.prediction.random_steps import Indices, Linear, Step
from echelon.controller.prediction.registers import Registers, Role, Taking
from echelon.messages import Channel
from echelon.plan.layout import with_message_sizes
from echelon.plan.plan import NodePlan, Plan
from echelon.role import Input
from echelon.runtime.turns import Turn


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """A part of the run whose registers do not act on those of others."""

    steps: tuple[Step, ...]
    """One hyperperiod, for the registers that matter"""
    registers: Indices
    """Which of the run's registers matter at the beginning of a hyperperiod"""


class RandomRun:
    """The linear run of a plan in which some links lose messages."""

    def __init__(self, plan: Plan, lossy: Iterable[int], chained: Iterable[int] = ()) -> None:
        """`lossy` are the links, by their place in `plan.links`, that lose messages each by itself; `chained` those that lose
        the same messages, as a Markov chain says.

        Raises PredictionError if the law is not linear, or if these losses cannot be treated exactly."""
        self.plan = plan = with_message_sizes(replace(plan, avoidance=replace(plan.avoidance, enabled=False)))
        self.hyperperiod_ns = plan.root.period_ns
        self._lossy, self._chained = frozenset(lossy), frozenset(chained)
        waits = _waits(plan, self._lossy | self._chained, self._chained)
        self.registers = Registers(plan, self._lossy, self._chained)
        made = self._event_driven() if waits else self._time_driven()
        self.steps = (*made, self.registers.shift())
        """One hyperperiod, over all registers"""

    def parts(self) -> list[Part]:
        """Returns the parts of the run that do not act on each other."""
        count = self.registers.count
        live = np.zeros(count, dtype=bool)
        for role in range(len(self.registers.roles)):
            live[self.registers.memory(role)] = True
        while ((before := needs(self.steps, live)) & ~live).any():
            live |= before
        pairs = [edge for step in self.steps for edge in step.edges()]
        rows, columns = (np.concatenate([pair[side] for pair in pairs]) for side in (0, 1))
        graph = coo_array((np.ones(len(rows)), (rows, columns)), (count, count))
        _, label = connected_components(graph, directed=False)
        own = [live & (label == each) for each in np.unique(label[live])]
        return [Part(forced(self.steps, each, each), np.flatnonzero(each)) for each in own]

    def _time_driven(self) -> Iterator[Step]:
        stages = self.registers.stages()
        tick_ns = gcd(*(stage.timed.period_ns for _, stage in stages))
        for time_ns in range(0, self.hyperperiod_ns, tick_ns):
            due = [pair for pair in stages if time_ns % pair[1].timed.period_ns == 0]
            for level in _levels(due):
                yield from self.registers.acts(level, time_ns)

    def _event_driven(self) -> Iterator[Step]:
        """One period: up the tree, then down as soon as all is there, or at the end of the period."""
        plan, T_ns = self.plan, self.hyperperiod_ns
        wait_ns = max((link.delay_min_ns % T_ns for link in plan.links if link.channel is Channel.STATE), default=0)
        rising = [pair for pair in self.registers.stages() if pair[1].timed.turn in (Turn.SAY, Turn.GATHER)]
        up, came = (
            tuple(
                step for level in _levels(rising) for step in self.registers.acts(level, 0, wait_ns=wait_ns, came=only)
            )
            for only in (False, True)
        )
        fall = _Fall(self.registers, self._lossy, self._chained, T_ns - wait_ns)
        first = (self.registers.move(range(len(plan.robots)), wait_ns),) if wait_ns else ()
        early, late = ((*first, *make(plan.root)) for make in (fall.early, fall.late))
        if all(isinstance(step, Linear) for step in up):
            yield from (*up, *early)
        else:
            yield Window(up, came, early, late)


class _Fall:
    """The way down in a period of event-driven nodes."""

    def __init__(self, registers: Registers, lossy: frozenset[int], chained: frozenset[int], rest_ns: int) -> None:
        """`lossy` and `chained` are those of the run, `rest_ns` is how much of the period is left when all states are there."""
        self._registers, self._plan, self._rest_ns = registers, registers.plan, rest_ns
        self._random, self._chained = lossy | chained, chained
        self._steer: dict[int, tuple[Role, LinearStage]] = {
            stage.timed.member: (role, stage) for role, stage in registers.stages() if stage.timed.turn is Turn.STEER
        }

    def early(self, node: NodePlan) -> list[Step]:
        """Returns the steps from a node on that acts once all is there, and the motion of the robots below."""
        robots, nodes = self._children(node)
        steps = [self._act(node), *self._take(node, robots)]
        if robots:
            steps.append(self._registers.move(robots, self._rest_ns))
        for together in self._sharing(node, nodes):
            comes = [
                *self._take(node, [child.index for child in together], certain=True),
                *(step for child in together for step in self.early(child)),
            ]
            at = self._registers.link(together[0].index, Input(node.index, Channel.REFERENCE))
            if at in self._random:
                kind = None if at in self._chained else at
                steps.append(Either(kind, tuple(comes), tuple(step for child in together for step in self.late(child))))
            else:
                steps += comes
        return steps

    def late(self, node: NodePlan) -> list[Step]:
        """Returns the steps from a node on that acts at the end of the period, after the motion of the robots below."""
        robots = range(node.first_robot, node.first_robot + node.robots)
        return [self._registers.move(robots, self._rest_ns), *self._end(node)]

    def _end(self, node: NodePlan) -> list[Step]:
        robots, nodes = self._children(node)
        steps = [self._act(node), *self._take(node, [*robots, *(child.index for child in nodes)])]
        return [*steps, *(step for child in nodes for step in self._end(child))]

    def _children(self, node: NodePlan) -> tuple[list[int], list[NodePlan]]:
        """Returns a node's children: robots, and nodes."""
        count = len(self._plan.robots)
        robots = [child for child in node.children if child < count]
        return robots, [self._plan.nodes[child - count] for child in node.children if child >= count]

    def _act(self, node: NodePlan) -> Step:
        return self._registers.run([self._steer[node.index]], 0)

    def _take(self, node: NodePlan, children: Sequence[int], *, certain: bool = False) -> list[Step]:
        """Returns the steps in which children take what a node has sent.  `certain`: no message is lost."""
        count, T_ns = len(self._plan.robots), self._plan.root.period_ns
        heard = [Input(node.index, Channel.COMMAND if child < count else Channel.REFERENCE) for child in children]
        takings = [Taking(child, each, -T_ns, 0) for child, each in zip(children, heard, strict=True)]
        return self._registers.take(takings, certain=certain)

    def _sharing(self, node: NodePlan, nodes: Sequence[NodePlan]) -> list[list[NodePlan]]:
        """Returns child nodes, together where their references are lost for all at once."""
        found: dict[int, list[NodePlan]] = {}
        for child in nodes:
            at = self._registers.link(child.index, Input(node.index, Channel.REFERENCE))
            shared = at in self._random and self._plan.links[at].loss_of_message
            found.setdefault(-1 if shared else child.index, []).append(child)
        return list(found.values())


def _levels(pairs: Iterable[tuple[Role, LinearStage]]) -> list[list[tuple[Role, LinearStage]]]:
    return [list(level) for _, level in groupby(pairs, key=lambda pair: pair[1].timed.level)]


def _waits(plan: Plan, random: frozenset[int], chained: frozenset[int]) -> bool:
    """Returns whether nodes wait for lost messages.  Raises PredictionError if the run cannot be treated."""
    for at, link in enumerate(plan.links):
        name = link.channel.name.lower()
        if varies(link) and at in chained:
            check_delays(plan, link)
        elif varies(link):
            raise PredictionError(f"several {name} links have delays that vary, or some that are lost in bursts, too")
        if at not in random and link.loss:
            raise PredictionError(f"{name} links lose messages in bursts of their own")
        check_policy(plan, link)
    kinds = {node.event_driven for node in plan.nodes}
    if len(kinds) == 2:
        raise PredictionError(
            "some nodes are event-driven, some time-driven: losses are computed where all are the same"
        )
    commands = [link for link in plan.links if link.channel is Channel.COMMAND]
    if kinds == {False}:
        within = any(link.delay_min_ns % plan.formation[link.receiver].period_ns for link in commands)
        if within and any(robot.event_driven for robot in plan.robots):
            raise PredictionError(
                "event-driven robots take commands within their periods: losses are computed for delays of whole periods"
            )
        return False
    late = any(link.delay_min_ns for link in plan.links if link.channel in _IN_TREE)
    if len({each.period_ns for each in plan.formation}) > 1 or late or plan.bridge is not None:
        raise PredictionError(
            "event-driven nodes: losses are computed where all acceleration periods are equal, torque is mirrored, and only "
            'states have delays; with timing = "time_driven" they are computed for all periods and delays'
        )
    within = any(link.delay_min_ns % link.period_ns for link in plan.links if link.channel is Channel.STATE)
    if within and not all(robot.event_driven for robot in plan.robots):
        raise PredictionError(
            "time-driven robots below event-driven nodes: losses are computed where states are late by whole periods"
        )
    return True


_IN_TREE = (Channel.GROUP_STATE, Channel.REFERENCE, Channel.COMMAND)
