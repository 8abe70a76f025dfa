"""Names of the values of a message, for those who look at one of them: `x`, `ax of g1/r2`, `error rate z1_x of g1`.

The order is that of the layouts (`echelon.messages`, `echelon.plan.layout`).
"""

from collections.abc import Iterable

from echelon.messages import GROUP_FIELDS, STATE_FIELDS, TORQUE_FIELDS, Channel
from echelon.plan.layout import message_sizes_of
from echelon.plan.plan import BlockPlan, NodePlan, Plan
from echelon.sim.results.block_series import component_names


def value_names(plan: Plan, source: int, channel: Channel) -> tuple[str, ...]:
    """Returns the names of the values of a role's messages on a channel, in their order; no two of them are the same.

    Raises ValueError if the role sends no messages with values of a constant number on this channel."""
    one = plan.all_roles[source]
    if not message_sizes_of(plan, one).get(channel):
        raise ValueError(f"{one.name} sends no {channel.name} with values that have names")
    match channel:
        case Channel.STATE:
            return STATE_FIELDS
        case Channel.TORQUE:
            return TORQUE_FIELDS
        case Channel.WHEELS:
            return _of(("tau_right", "tau_left"), [robot.name for robot in plan.robots])
    assert isinstance(one, NodePlan)
    robots = [robot.name for robot in plan.robots[one.first_robot : one.first_robot + one.robots]]
    if channel is Channel.GROUP_STATE:
        rates = _error_rates(plan, one) if plan.coupled else ()
        return (*GROUP_FIELDS, *rates, *(_of(("x", "y"), robots) if plan.avoidance.enabled else ()))
    accelerations = _of(("ax", "ay"), [plan.formation[child].name for child in one.children])
    if channel is Channel.COMMAND:
        return accelerations
    rates = _error_rates(plan, plan.root) if plan.coupled else ()
    return (*accelerations, *rates, *(_of(("fx", "fy"), robots) if plan.avoidance.enabled else ()))


def _error_rates(plan: Plan, node: NodePlan) -> tuple[str, ...]:
    """Returns the names of the error rates that a node has: of the blocks below, child by child, then of its own block, then,
    at the root, of the centroid."""
    below = [plan.nodes[child - len(plan.robots)] for child in node.children if child >= len(plan.robots)]
    names = [name for child in below for name in _error_rates(plan, child)]
    names += _rates_of(plan.block_of(node.index))
    return (*names, *(_rates_of(plan.blocks[-1]) if node.parent is None else ()))


def _rates_of(block: BlockPlan) -> list[str]:
    return [f"error rate {component} of {block.name}" for component in component_names(block)]


def _of(fields: Iterable[str], owners: Iterable[str]) -> tuple[str, ...]:
    return tuple(f"{field} of {owner}" for owner in owners for field in fields)
