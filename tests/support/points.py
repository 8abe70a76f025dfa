"""Robots that are points, which do exactly what accelerations ask: the in-process engine with such robots is the brute force
that predictions are held against."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

import echelon.sim.engines.in_process
from echelon.controller.trajectory import Line
from echelon.messages import STATE_FIELDS, Channel, Heard, Message, field_index
from echelon.plan.layout import with_message_sizes
from echelon.plan.plan import Array, Plan
from echelon.plugins import Part
from echelon.role import Acts, Input, Stage
from echelon.runtime.turns import Turn
from echelon.sim.engines.in_process import Engine
from support.growth import growth

_ACCELERATION = field_index(STATE_FIELDS, "ax", "ay")


class PointRobot:
    """A double integrator as a role, which moves when it is asked for its state or told another acceleration."""

    def __init__(self, plan: Plan, index: int, loop: object = None) -> None:
        robot = plan.robots[index]
        self.index, self._plan = index, robot
        self.p, self.v, self.a = np.array(robot.start), np.zeros(2), np.zeros(2)
        self.said: tuple[float, ...] = ()  # position and velocity at the beginning of its period
        self._moved_ns = 0
        self._mine = slice(2 * robot.child_number, 2 * robot.child_number + 2)
        self.stages = (
            Stage(Turn.SAY, robot.period_ns, (), self._say),
            Stage(
                Turn.ACT,
                robot.period_ns,
                (Input(robot.parent, Channel.COMMAND),),
                self._obey,
                acts=Acts.ON_ARRIVAL if robot.event_driven else Acts.AT_INSTANT,
            ),
        )

    def _say(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        self._move(time_ns)
        values = np.zeros(len(STATE_FIELDS))
        values[:4] = self.said = (*self.p, *self.v)
        values[_ACCELERATION] = self.a
        return (Message(Channel.STATE, self.index, time_ns // self._plan.period_ns, time_ns, values),)

    def _obey(self, time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        self._move(time_ns)
        self.a = np.zeros(2) if heard[0] is None else heard[0].values[self._mine]
        return ()

    def _move(self, time_ns: int) -> None:
        T, self._moved_ns = (time_ns - self._moved_ns) * 1e-9, time_ns
        self.p, self.v = self.p + T * self.v + T**2 / 2 * self.a, self.v + T * self.a


def time_driven(plan: Plan) -> Plan:
    """Returns a plan whose nodes and robots are all time-driven."""
    return replace(
        plan,
        robots=tuple(replace(robot, event_driven=False) for robot in plan.robots),
        nodes=tuple(replace(node, event_driven=False) for node in plan.nodes),
        links=tuple(replace(link, punctual=True) for link in plan.links),
    )


def at_rest(plan: Plan) -> Plan:
    """Returns a plan that wants all robots at the origin, at rest, without avoidance: its run is linear."""
    nodes = tuple(
        replace(node, shape=replace(node.shape, points=tuple((0.0, 0.0) for _ in node.shape.points)))
        for node in plan.nodes
    )
    rest = Part("line", {}, None, Line(velocity=(0.0, 0.0)))
    return with_message_sizes(
        replace(plan, nodes=nodes, trajectory=rest, avoidance=replace(plan.avoidance, enabled=False))
    )


def point_run(plan: Plan, hyperperiods: int, patch: pytest.MonkeyPatch) -> Array:
    """Returns (p, T v) of all robots at the beginning of each hyperperiod of the root's period T, (hyperperiods, 4 robots), in
    a plan that is `at_rest`; shorter if they run away."""
    period_ns = plan.root.period_ns
    patch.setattr(echelon.sim.engines.in_process, "make_robot", PointRobot)
    engine = Engine(replace(plan, duration_ns=hyperperiods * period_ns))
    robots = [role for role in engine.roles if isinstance(role, PointRobot)]
    rows, scale = [], np.array([1, 1, period_ns * 1e-9, period_ns * 1e-9])
    for time_ns in engine.instants():
        if time_ns % period_ns == 0:
            rows.append(np.concatenate([robot.said * scale for robot in robots]))
            if not np.abs(rows[-1]).max() < 1e100:
                break
    return np.array(rows)


def growth_of_points(plan: Plan, hyperperiods: int, patch: pytest.MonkeyPatch) -> float:
    """Returns the logarithm of the growth per period of the root, over the second half of a run of points."""
    return growth(np.linalg.norm(point_run(plan, hyperperiods, patch), axis=1))
