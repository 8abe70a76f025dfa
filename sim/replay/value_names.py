"""Names of the values of a message, for those who look at one of them: `x`, `ax of g1/r2`, `error rate z1_x of g1`.

The order is that of the layouts (`echelon.messages`, `echelon.plan.layout`).
"""

from collections.abc import Iterable
from typing import Final

from echelon.messages import GROUP_FIELDS, STATE_FIELDS, TORQUE_FIELDS, Channel
from echelon.plan.layout import message_sizes_of
from echelon.plan.plan import BlockPlan, NodePlan, Plan
from echelon.sim.results.block_series import component_names

SQUARE: Final = "_square"
"""The end of the names of mean squares of torques"""
_UNITS: Final = {
    "x": "m", "y": "m", "vx": "m/s", "vy": "m/s", "v": "m/s", "theta": "rad", "omega": "rad/s",
    "ax": "m/s²", "ay": "m/s²", "fx": "m/s²", "fy": "m/s²", "error": "m/s",
    "tau_right": "N m", "tau_left": "N m", "tau_right_peak": "N m", "tau_left_peak": "N m",
    "tau_right_square": "N² m²", "tau_left_square": "N² m²",
    "speed_right": "rad/s", "speed_left": "rad/s",
    "saturated": "", "commanded": "",
}  # fmt: skip
"""By the first word of a name; that of `error rate …` is `error`"""


def unit_of(name: str) -> str:
    """Returns the unit of the value with a name that `value_names` gives; empty for a number without one or another name."""
    return _UNITS.get(name.split(" ", 1)[0], "")


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
