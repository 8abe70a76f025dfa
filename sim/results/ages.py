"""How old what a node acts on is, and the error that this leaves in a moving formation.

The state of t - τ is compared with the reference of t.  Where the formation moves with the velocity v, that is a constant
error of the measured position, -v τ, and the law takes it away: the formation stands v τ ahead of its reference.  It is no
instability (docs/architecture.md, 2.10).  Robots of different ages are moved apart in the same way: with the mean ages τ_k of
what a node knows of its children, a shape variable z of that node is off by v (Φ_node τ)_z, and the centroid by v times the
mean of the root's τ_k.
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
    """Returns for each block the times [s], (size/2,), by which its variables are off per velocity [m per m/s]."""
    age = {(link.source, link.receiver): link.age_mean_ns / 1e9 for link in links if link.channel in UP and link.used}
    below: dict[int, float] = {}
    """Of what a node tells: how old the robots' states in it are in the mean"""
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
    """Returns how much the age of what goes from a robot to the root and back varies about its mean [s], of the robot for
    which that is most.  Of one link it is what the largest age is above the mean, but no more than twice the mean: the
    largest of many ages says little about most of them."""
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
