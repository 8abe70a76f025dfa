"""The admissions of a plan: for each source and channel what a receiver takes (`echelon.runtime.admission`)."""

from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from echelon.messages import TORQUE_FIELDS, Channel, Values
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.layout import message_sizes
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.runtime.admission import LARGEST, Admission, Fits, Refusals
from echelon.runtime.mailbox import MAX_AHEAD

TORQUE_MARGIN: Final = 1.000001
"""A torque may be above the limit of its robot by this factor: rounding"""


def torque_bounds(torque_limit: float) -> Fits:
    """Returns the bounds of the values of a robot's TORQUE (`TORQUE_FIELDS`): torques up to the robot's limit [N m], two marks
    that are 0 or 1, speeds up to `LARGEST` [rad/s]."""
    largest = min(torque_limit * TORQUE_MARGIN, LARGEST)
    assert TORQUE_FIELDS == ("tau_right", "tau_left", "commanded", "saturated", "speed_right", "speed_left")

    def fits(values: Values, time_ns: int) -> bool:
        right, left, commanded, saturated, speed_right, speed_left = values.tolist()
        return (
            -largest <= right <= largest
            and -largest <= left <= largest
            and (commanded == 1.0 or (commanded == 0.0 == right == left))
            and saturated in (0.0, 1.0)
            and -LARGEST <= speed_right <= LARGEST
            and -LARGEST <= speed_left <= LARGEST
        )

    return fits


def bounds_of(plan: Plan, frames: Fits | None = None) -> Callable[[int, Channel], Fits | None]:
    """Returns a function from source and channel to the bounds of their values; None stands for `within`.

    `frames` are the bounds of FRAMES, whose values are no numbers."""

    def of(source: int, channel: Channel) -> Fits | None:
        if channel is Channel.TORQUE:
            return torque_bounds(plan.robots[source].torque_limit)
        return frames if channel is Channel.FRAMES else None

    return of


def admissions_into(
    plan: Plan, receiver: int, refusals: Refusals, *, virtual: bool, frames: Fits | None = None
) -> list[Admission]:
    """Returns the admissions of all links into a role of a plan, in their order in the plan.

    In virtual time a source is ahead of the role by at most what a lockstep allows; on a wall clock no message is from the
    future."""
    names = [one.name for one in plan.all_roles]
    bounds = bounds_of(plan, frames)
    ahead_ns: Mapping[int, int] = lockstep_lead_ns(plan, receiver) if virtual else {}
    return [
        Admission(
            refusals,
            names[link.source],
            link.source,
            link.channel,
            link.size,
            first_ns=link.first_ns,
            period_ns=link.period_ns,
            late_ns=0 if virtual and link.punctual else link.period_ns - 1,
            end_ns=plan.duration_ns if virtual or link.source < len(plan.formation) else NEVER_NS,
            ahead_ns=ahead_ns.get(link.source, 0),
            fits=bounds(link.source, link.channel),
        )
        for link in plan.links_into(receiver)
    ]


def admissions_of(
    plan: Plan, sources: Iterable[int], refusals: Refusals, *, virtual: bool, frames: Fits
) -> list[Admission]:
    """Returns the admissions of all messages of some sources, for one that hears copies of them.

    It takes the states of robots as they are, also those that are not finite."""
    names = {one.index: one.name for one in plan.all_roles} | {len(plan.formation): "bridge"}
    links: dict[tuple[int, Channel], list[LinkPlan]] = {}
    for link in plan.links:
        links.setdefault((link.source, link.channel), []).append(link)
    bounds, wanted, found = bounds_of(plan, frames), set(sources), []
    for (source, channel), size in message_sizes(plan).items():
        if source not in wanted:
            continue
        common = {
            "end_ns": plan.duration_ns if virtual or source < len(plan.formation) else NEVER_NS,
            "fits": _any if channel is Channel.STATE else bounds(source, channel),
        }
        if channel is Channel.FRAMES and not (virtual and plan.can.closed):  # numbered one by one
            times = {"first_ns": -plan.can.bring_up_ns}
        else:
            of_it = links[source, channel]
            period_ns = of_it[0].period_ns
            late_ns = 0 if virtual and all(link.punctual for link in of_it) else period_ns - 1
            times = {"first_ns": of_it[0].first_ns, "period_ns": period_ns, "late_ns": late_ns}
        found.append(Admission(refusals, names[source], source, channel, size, **times, **common))  # type: ignore[arg-type]
    return found


def _any(values: Values, time_ns: int) -> bool:
    return True


def lockstep_lead_ns(plan: Plan, receiver: int) -> dict[int, int]:
    """Returns for each role how far it can be ahead of `receiver` in a lockstep [ns].

    A role is at most `mailbox.MAX_AHEAD` of the longest periods ahead of those that it hears, and an act may be a period late.
    So a role that hears the receiver through others may be ahead by as many times that."""
    longest_ns = max(
        [link.period_ns for link in plan.links] + [member.period_ns for member in plan.formation], default=0
    )
    hears: dict[int, set[int]] = {}
    for link in plan.links:
        hears.setdefault(link.source, set()).add(link.receiver)
    hops, waiting = {receiver: 0}, deque([receiver])
    while waiting:
        one = waiting.popleft()
        for other in hears.get(one, ()):
            if other not in hops:
                hops[other] = hops[one] + 1
                waiting.append(other)
    most = len(plan.all_roles)
    return {role.index: (MAX_AHEAD + 2) * longest_ns * hops.get(role.index, most) for role in plan.all_roles}
