"""Makes the plan of a scenario: members, blocks, links and events, and checks that they fit together.

The tables of a scenario check their own values.  This module checks values against each other: periods must divide each
other, shapes and gains must have the right size, rules must fit something, and robots must start in different places.  It
raises PlanError with a line for each mistake: the key, the value and what is allowed.
"""

from collections.abc import Sequence
from itertools import combinations
from math import dist

import numpy as np

from echelon.errors import Mistakes
from echelon.part_groups import Registry
from echelon.plan.can_plan import BusRolePlan, CanPlan, EventPlan
from echelon.plan.layout import with_message_sizes
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import (
    COORDINATOR,
    AvoidancePlan,
    BlockPlan,
    ClaimPlan,
    HealthPlan,
    NodePlan,
    Plan,
    PlanError,
    RobotPlan,
)
from echelon.planning.blocks import fitting, make_blocks, make_coupling
from echelon.planning.drives import make_events
from echelon.planning.links import make_links
from echelon.planning.members import MAX_ROBOTS, make_members, nanoseconds, robot_key
from echelon.scenario.law_tables import Law
from echelon.scenario.tables import Scenario
from echelon.scenario.values import path_matches


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
        links = make_links(scenario.links, scenario.events, robots, nodes, bus_roles, can)
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
        reference=scenario.law.reference,
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


__all__ = ["COORDINATOR", "MAX_ROBOTS", "PlanError", "make_plan", "path_matches"]
