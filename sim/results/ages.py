"""How old the states are that nodes use, and the steady error that these ages cause in a moving formation.

With `law.reference = "now"` a node compares states of t - τ with the reference of t.  If the formation moves with the velocity
v, the measured position is wrong by -v τ, and the law makes up for this: the formation stands v τ ahead of its reference.
This is a steady error, not an instability (docs/architecture.md, 2.10).  If a node's children have different ages, the shape is
wrong, too: with the mean ages τ = (τ_1, τ_2, …) of the states of its children, its shape variable z is off by v (Φ_node τ)_z,
and the centroid of the formation by v times the weighted mean of the root's τ.
"""

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from echelon.controller.transformation import node_matrix
from echelon.messages import Channel
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.sim.results.trace import Array

UP: Final = (Channel.STATE, Channel.GROUP_STATE)
DOWN: Final = (Channel.REFERENCE, Channel.COMMAND)


def lag_times(plan: Plan, links: Sequence[LinkCounts]) -> Mapping[str, Array]:
    """Returns for each block the times [s], (size/2,), by which the velocity is multiplied to give the steady errors of its
    variables.  A link without a used message counts with the age 0.  With the reference of the message's own time
    (`law.reference`) there is no lag, and all times are 0."""
    age = {(link.source, link.receiver): link.age_mean_ns / 1e9 for link in links if link.channel in UP and link.used}
    if plan.reference == "message":
        age = {}
    below: dict[int, float] = {}
    """By node: the weighted mean age [s] of the robots' states in its group's state when the node computes it"""
    times: dict[int, Array] = {}
    for node in plan.nodes:
        ages = np.array([age.get((child, node.index), 0.0) + below.get(child, 0.0) for child in node.children])
        rows = node_matrix(node.weights) @ ages
        below[node.index], times[node.index] = float(rows[-1]), rows[:-1]
    return {
        block.name: np.array([below[plan.root.index]]) if block.node is None else times[block.node]
        for block in plan.blocks
    }


def loop_jitter(plan: Plan, links: Sequence[LinkCounts]) -> float:
    """Returns how much later than on average a message can go from a robot to the root and back [s]: the largest value of all
    robots.  For one link it is the largest age less the mean age, at most twice the mean age: a single very old message says
    little about the others."""
    jitter = {
        (link.source, link.receiver): min(link.age_max_ns - link.age_mean_ns, 2 * link.age_mean_ns) / 1e9
        for link in links
        if link.channel in (*UP, *DOWN) and link.used
    }
    most = 0.0
    for robot in plan.robots:
        total, member = 0.0, robot.index
        while (parent := plan.formation[member].parent) is not None:
            total += jitter.get((member, parent), 0.0) + jitter.get((parent, member), 0.0)
            member = parent
        most = max(most, total)
    return most
