"""Makes the plan of a scenario: members, blocks, links and events, and checks that they fit together.

The tables of a scenario check their own values.  This module checks values against each other: periods must divide each
other, shapes and gains must have the right size, rules must fit something, and robots must start in different places.  It
raises PlanError with a line for each mistake: the key, the value and what is allowed.
"""

from collections.abc import Sequence
from itertools import combinations
from math import dist
from typing import Final

import numpy as np

from echelon.errors import Mistakes
from echelon.messages import Channel
from echelon.part_groups import Registry
from echelon.plan.can_plan import NEVER_NS, BusRolePlan, CanPlan, EventPlan
from echelon.plan.layout import with_message_sizes
from echelon.plan.plan import (
    COORDINATOR,
    AvoidancePlan,
    BlockPlan,
    ClaimPlan,
    HealthPlan,
    LinkPlan,
    NodePlan,
    Plan,
    PlanError,
    RobotPlan,
)
from echelon.planning.blocks import fitting, make_blocks, make_coupling
from echelon.planning.drives import make_events
from echelon.planning.members import MAX_ROBOTS, make_members, nanoseconds, robot_key
from echelon.scenario.tables import Law, LinkRule, Scenario, Uniform
from echelon.scenario.values import path_matches

MAX_DELAY: Final = 1e6
"""Largest delay of a link [s]"""
SHOWN_NAMES: Final = 12
"""Number of members that an error lists"""


def make_plan(scenario: Scenario, registry: Registry) -> Plan:
    """Returns the plan of a scenario.  Default parts come from `registry`.

    Raises PlanError with all mistakes that can be found; a mistake may hide others that depend on it."""
    robots, nodes, can = make_members(scenario, registry)
    mistakes = Mistakes()
    bus_roles: tuple[BusRolePlan, ...] = ()
    links: tuple[LinkPlan, ...] = ()
    blocks: tuple[BlockPlan, ...] = ()
    events: tuple[EventPlan, ...] = ()
    coupling = np.zeros((0, 0))
    duration_ns = display_ns = 0
    with mistakes.noted():
        bus_roles = _bus_roles(robots, nodes, can)
    with mistakes.noted():
        _check_starts(robots, scenario.avoidance.avoidance_radius if scenario.avoidance.enabled else 0.0)
    with mistakes.noted():
        duration_ns = _duration_ns(scenario, nodes[-1])
    with mistakes.noted():
        display_ns = nanoseconds(scenario.record.display_period, "record.display_period")
    with mistakes.noted():
        _check_law(scenario.law)
    with mistakes.noted():
        blocks = make_blocks(scenario.law, nodes)
        for at, claim in enumerate(scenario.claims):
            with mistakes.noted():
                fitting(blocks, claim.block, f"claims.{at}.block")
        coupling = make_coupling(scenario.law, blocks)
    with mistakes.noted():
        links = _links(scenario.links, robots, nodes, bus_roles, can)
    with mistakes.noted():
        events = make_events(scenario.events, robots, can)
    mistakes.check(PlanError)
    plan = Plan(
        name=scenario.name,
        seed=scenario.seed,
        duration_ns=duration_ns,
        display_period_ns=max(display_ns, nanoseconds(scenario.periods.acceleration, "periods.acceleration")),
        robots=robots,
        nodes=nodes,
        blocks=blocks,
        law=scenario.law.parameters,
        coupling=coupling,
        lead=scenario.law.lead,
        trajectory=scenario.trajectory,
        avoidance=AvoidancePlan(**scenario.avoidance.model_dump()),
        links=links,
        can=can,
        claims=tuple(ClaimPlan(claim.block, claim.settled_by, claim.band, claim.dwell) for claim in scenario.claims),
        health=HealthPlan(**scenario.health.model_dump() | {"off": frozenset(scenario.health.off)}),
        events=events,
        bus_roles=bus_roles,
    )
    return with_message_sizes(plan)


def _duration_ns(scenario: Scenario, root: NodePlan) -> int:
    """Returns the length of the run [ns].  Raises PlanError if it is not a multiple of the root's period."""
    duration_ns = nanoseconds(scenario.duration, "duration")
    if duration_ns % root.period_ns:
        period = root.period_ns / 1e9
        raise PlanError(f"duration = {scenario.duration}: must be a multiple of {period}, the coordinator's period")
    return duration_ns


def _check_law(law: Law) -> None:
    """Raises PlanError if the scenario gives gains or `lead` to a law that does not use them."""
    for key, value, unset in (("gains", law.gains, []), ("lead", law.lead, 0.0)):
        if value != unset and key not in law.parameters.made.uses:
            what = "has gains of its own, in law.parameters" if key == "gains" else "does not look ahead"
            raise PlanError(f"law.{key}: the law {law.use!r} {what}; leave {key} out")


def _bus_roles(robots: Sequence[RobotPlan], nodes: Sequence[NodePlan], can: CanPlan) -> tuple[BusRolePlan, ...]:
    """Returns the bridge and the virtual drives, if there are any; empty if torque is mirrored.  Raises PlanError."""
    if not can.closed:
        return ()
    if not can.enabled:
        raise PlanError("can.enabled = false: must be true where can.path = 'closed'")
    first, cycle_ns = len(robots) + len(nodes), robots[0].torque_period_ns
    roles = ("bridge", "drives") if can.virtual_drives else ("bridge",)
    return tuple(BusRolePlan(first + at, role, cycle_ns, -can.bring_up_ns) for at, role in enumerate(roles))


def _check_starts(robots: Sequence[RobotPlan], radius: float) -> None:
    """Raises PlanError if two robots start in the same place, or at a distance of at most `radius` [m]."""
    mistakes: dict[str, str] = {}
    for one, other in combinations(robots, 2):
        distance = dist(one.start, other.start)
        if distance == 0 or distance <= radius:
            key = f"{robot_key(other.path)}.start = {list(other.start)}"
            why = f"is where {one.name!r} starts"
            if distance > 0:
                why = (
                    f"{distance:.6g} m from {one.name}, must be more than avoidance.avoidance_radius = {radius} "
                    "where robots avoid each other"
                )
            mistakes.setdefault(key, f"{key}: {why}")
    if mistakes:
        raise PlanError(*mistakes.values())


def _links(
    rules: Sequence[LinkRule],
    robots: Sequence[RobotPlan],
    nodes: Sequence[NodePlan],
    bus_roles: Sequence[BusRolePlan],
    can: CanPlan,
) -> tuple[LinkPlan, ...]:
    """Returns all links.  Links of the tree, and from robots to the bridge, get delay and loss from the last rule that fits.

    Raises PlanError if a rule fits no link."""
    all_roles: list[RobotPlan | NodePlan | BusRolePlan] = [*robots, *nodes, *bus_roles]
    names = [one.name for one in all_roles]
    limits = [_delay_ns(rule, f"links.{at}.delay") for at, rule in enumerate(rules)]
    used: set[int] = set()
    links = []
    for source, receiver, channel, period_ns in [*_tree_links(robots, nodes), *_torque_links(robots, bus_roles)]:
        rule, delay_min_ns, delay_max_ns = LinkRule(), 0, 0
        for at, (each, limit) in enumerate(zip(rules, limits, strict=True)):
            if (
                each.channel in ("*", channel.name.lower())
                and path_matches(each.source, names[source])
                and path_matches(each.receiver, names[receiver])
            ):
                used.add(at)
                rule, (delay_min_ns, delay_max_ns) = each, limit
        timeout_ns = NEVER_NS
        if (rule.policy or ("hold_then_stop" if can.closed else "hold")) == "hold_then_stop":
            # A message that comes once per period may be a whole period old; so the default is at least two periods.
            wanted = can.watchdog_ns if rule.timeout is None else round(rule.timeout * 1e9)
            timeout_ns = max(wanted, 2 * period_ns) if rule.timeout is None else wanted
        links.append(LinkPlan(source, receiver, channel, period_ns, delay_min_ns, delay_max_ns, rule.loss, timeout_ns))
    unused = [_why_unused(rule, f"links.{at}", names, can.closed) for at, rule in enumerate(rules) if at not in used]
    if unused:
        raise PlanError(*unused)
    return (*links, *_shaft_links(robots, bus_roles, can))


def _torque_links(robots: Sequence[RobotPlan], bus_roles: Sequence[BusRolePlan]) -> list[tuple[int, int, Channel, int]]:
    """Returns source, receiver, channel and period [ns] of the links from robots to the bridge, which carry torques.  They can
    have delay and loss."""
    return [
        (robot.index, bridge.index, Channel.TORQUE, bridge.period_ns) for bridge in bus_roles[:1] for robot in robots
    ]


def _shaft_links(robots: Sequence[RobotPlan], bus_roles: Sequence[BusRolePlan], can: CanPlan) -> list[LinkPlan]:
    """Returns the links that do not stand for a network, but for shafts and for the bus.  They have no delay and no loss; the
    delay of the bus is in `bridge.timing.arbitration`."""
    links: list[LinkPlan] = []
    if not can.closed:
        return links
    bridge, *drives = bus_roles
    period_ns, first_ns = bridge.period_ns, bridge.first_ns
    # A robot that gets no torques from the bridge for this time uses none: by then its drives have stopped.
    timeout_ns = max(can.watchdog_ns, 2 * period_ns)
    links += [LinkPlan(bridge.index, robot.index, Channel.WHEELS, period_ns, timeout_ns=timeout_ns) for robot in robots]
    for each in drives:
        links.append(LinkPlan(bridge.index, each.index, Channel.FRAMES, period_ns, first_ns=first_ns))
        links.append(LinkPlan(each.index, bridge.index, Channel.FRAMES, period_ns, first_ns=first_ns))
        links += [LinkPlan(robot.index, each.index, Channel.TORQUE, period_ns) for robot in robots]
    return links


def _tree_links(robots: Sequence[RobotPlan], nodes: Sequence[NodePlan]) -> list[tuple[int, int, Channel, int]]:
    """Returns source, receiver, channel and period [ns] of every link of the tree, sorted by receiver, channel and source."""
    links = []
    for node in nodes:
        for child in node.children:
            is_node = child >= len(robots)
            links.append((child, node.index, Channel.GROUP_STATE if is_node else Channel.STATE, node.period_ns))
            links.append((node.index, child, Channel.REFERENCE if is_node else Channel.COMMAND, node.period_ns))
    return sorted(links, key=lambda link: (link[1], link[2], link[0]))


def _delay_ns(rule: LinkRule, key: str) -> tuple[int, int]:
    """Returns the bounds of a rule's delay, to the nearest nanosecond.  Raises PlanError if it is too large."""
    if isinstance(rule.delay, Uniform):
        low, high, key = rule.delay.min, rule.delay.max, f"{key}.max"
    else:
        low = high = rule.delay
    if high > MAX_DELAY:
        raise PlanError(f"{key} = {high}: must be at most {MAX_DELAY:g}")
    return round(low * 1e9), round(high * 1e9)


def _why_unused(rule: LinkRule, key: str, names: Sequence[str], closed: bool) -> str:
    """Returns the text that says why a rule fits no link."""
    for end, pattern in (("source", rule.source), ("receiver", rule.receiver)):
        if not any(path_matches(pattern, name) for name in names):
            shown = ", ".join(reversed(names[-SHOWN_NAMES:]))
            more = f", and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
            return f"{key}.{end} = {pattern!r}: fits no member; there are {shown}{more}"
    return (
        f"{key}: no link goes from {rule.source!r} to {rule.receiver!r} on channel {rule.channel!r}; links go from a "
        "node's child to it on 'state' or 'group_state', and back on 'command' or 'reference'"
        + (", and from a robot to 'bridge' on 'torque'" if closed else "")
    )


__all__ = ["COORDINATOR", "MAX_ROBOTS", "PlanError", "make_plan", "path_matches"]
