"""How many values a message has, by its source and channel: what comes from outside is held against it."""

from dataclasses import replace

from echelon.messages import GROUP_FIELDS, STATE_FIELDS, TORQUE_FIELDS, Channel
from echelon.plan import NodePlan, Plan


def message_size(plan: Plan, source: int, channel: Channel) -> int | None:
    """Returns the number of values, None if it varies (frames).  Raises ValueError if the source has no such channel."""
    one = plan.all_roles[source]
    match channel:
        case Channel.STATE if one.role == "robot":
            return len(STATE_FIELDS)
        case Channel.TORQUE if one.role == "robot":
            return len(TORQUE_FIELDS)
        case Channel.WHEELS if one.role == "bridge":
            return 2 * len(plan.robots)
        case Channel.FRAMES if one.role in ("bridge", "drives"):
            return None
    if not isinstance(one, NodePlan):
        raise ValueError(f"{one.name} says nothing on channel {channel.name}")
    forces = 2 * one.robots if plan.avoidance.enabled else 0
    match channel:
        case Channel.GROUP_STATE:
            return len(GROUP_FIELDS) + (2 * (one.robots - 1) if plan.coupled else 0) + forces
        case Channel.REFERENCE:
            return 2 * len(one.children) + (2 * len(plan.robots) if plan.coupled else 0) + forces
        case Channel.COMMAND:
            return 2 * len(one.children)
    raise ValueError(f"{one.name} says nothing on channel {channel.name}")


def sized(plan: Plan) -> Plan:
    """Returns a plan whose links say how many values their messages have."""
    links = (replace(link, size=message_size(plan, link.source, link.channel)) for link in plan.links)
    return replace(plan, links=tuple(links))


def said_by(plan: Plan) -> dict[tuple[int, Channel], int | None]:
    """Returns all that may be said in a run: by source and channel the number of values, None if it varies.

    Where torque is mirrored, the bridge is no member: it says frames under the number after the last."""
    found: dict[tuple[int, Channel], int | None] = {}
    for one in plan.all_roles:
        for channel in Channel:
            try:
                found[one.index, channel] = message_size(plan, one.index, channel)
            except ValueError:
                pass
    if not plan.can.closed:
        found[len(plan.formation), Channel.FRAMES] = None
    return found
