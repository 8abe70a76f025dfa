"""Random formations, and a record of all messages in them."""

from dataclasses import replace

import numpy as np

from echelon.agents.plant import state_at
from echelon.agents.robot import Robot
from echelon.messages import Channel, Message
from echelon.plan.layout import with_message_sizes
from echelon.plan.plan import Array, AvoidancePlan, Plan
from echelon.sim.engines.in_process import Engine
from support.trees import Tree, plan_of, random_epsilon, scenario, with_random_gains

NEAR = AvoidancePlan(True, avoidance_radius=0.3, sensing_radius=4.0, force_limit=500.0)


LAWS = {
    "linear": {},
    "integral": {"k_i": 0.3, "limit": 0.01},  # so small that the integral is clipped
    "terminal_sliding": {"gamma": 1.7, "beta": 2.0, "kappa": 1.5},
}


def random_plan(
    tree: Tree, seed: int, time_scales: str, coupling: float, avoidance: bool, use: str = "linear", **tables
) -> Plan:
    random = np.random.default_rng(seed)
    law = random_epsilon(tree, random, time_scales) | {"lead": random.choice([0.0, 0.5])}
    law |= {"use": use, "parameters": LAWS[use]}
    plan = with_random_gains(plan_of(scenario(tree, random, law=law, **tables)), random, coupling)
    return with_message_sizes(replace(plan, avoidance=NEAR)) if avoidance else plan


class Watched:
    """An engine whose robots start at random, and all its messages by (channel, source, instant)."""

    def __init__(self, plan: Plan, seed: int) -> None:
        self.plan = plan
        self.said: dict[tuple[Channel, int, int], Message] = {}
        self.engine = Engine(plan, self._note)
        random = np.random.default_rng(seed)
        for role in self.engine.roles:
            if isinstance(role, Robot):
                x, y = plan.robots[role.index].start
                role.state = state_at(x, y, *random.normal(size=3, scale=(2, 3, 2)).tolist())
        self.instants = list(self.engine.instants())

    def _note(self, message: Message) -> None:
        self.said[message.channel, message.source, message.time_ns] = message

    def states(self, time_ns: int) -> Array:
        """Returns the states of all robots at an instant, (N, fields)."""
        return np.array([self.said[Channel.STATE, robot.index, time_ns].values for robot in self.plan.robots])

    def commanded(self, time_ns: int) -> Array:
        """Returns the accelerations that were sent to the robots at an instant, (N, 2)."""
        return np.array(
            [
                self.said[Channel.COMMAND, robot.parent, time_ns].values.reshape(-1, 2)[robot.child_number]
                for robot in self.plan.robots
            ]
        )
