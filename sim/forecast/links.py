"""Warnings about links: delays that are rounded up, and links over which no message is ever used.

The tick of a link is the shorter of two periods: that of its sender and that of its receiver.  A time-driven receiver uses
messages at multiples of it, so a delay acts like the next multiple of the tick (docs/architecture.md, 4.6).  Robots and the
bridge on the closed torque path do the same.  An event-driven receiver takes a delay as it is."""

from collections import Counter
from collections.abc import Callable

from echelon.plan.can_plan import BusRolePlan
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan, RobotPlan


def link_warnings(plan: Plan) -> list[str]:
    """Returns the warnings about links, one line for all links with the same warning."""
    return [*_counted(plan, _silence), *_counted(plan, _rounding)]


def _counted(plan: Plan, what: Callable[[Plan, LinkPlan], str | None]) -> list[str]:
    """Returns the warnings that `what` gives for links: each text once for each channel, with the number of its links."""
    found = Counter(
        (link.channel.name.lower(), text) for link in plan.links if not link.ideal and (text := what(plan, link))
    )
    return [
        f"links: {channel} ({count} link{'s' if count > 1 else ''}): {text}" for (channel, text), count in found.items()
    ]


def _silence(plan: Plan, link: LinkPlan) -> str | None:
    """Returns why no message of a link is ever used; None if some are."""
    tick_ns, duration_ns = tick_of(plan, link), plan.duration_ns
    if link.loss == 1:
        return "loss = 1: nothing arrives"
    if link.delay_min_ns > duration_ns:
        return f"a delay of {link.delay_min_ns / 1e9:g} s in a run of {duration_ns / 1e9:g} s: nothing arrives"
    acts_ns = ticks_up(link.delay_min_ns, tick_ns) if _is_time_driven(plan, link) else link.delay_min_ns
    if acts_ns > link.timeout_ns:
        return (
            f"what arrives is {acts_ns / 1e9:g} s old, more than the timeout of {link.timeout_ns / 1e9:g} s: "
            "nothing is used"
        )
    return None


def _rounding(plan: Plan, link: LinkPlan) -> str | None:
    """Returns the delay like which that of a link acts, in words; None if it is the same."""
    tick_ns, least_ns, most_ns = tick_of(plan, link), link.delay_min_ns, link.delay_max_ns
    tick = f"messages are used at multiples of {tick_ns / 1e9:g} s"
    if most_ns > plan.duration_ns or link.delays is not None or not _is_time_driven(plan, link):
        return None
    if least_ns == most_ns:
        acts_ns = ticks_up(least_ns, tick_ns)
        return None if acts_ns == least_ns else f"a delay of {least_ns / 1e9:g} s acts as {acts_ns / 1e9:g} s: {tick}"
    low_ns, high_ns = least_ns // tick_ns * tick_ns + tick_ns, ticks_up(most_ns, tick_ns)
    acts = f"all act as {low_ns / 1e9:g} s" if low_ns == high_ns else f"act as {low_ns / 1e9:g} to {high_ns / 1e9:g} s"
    return f"delays from {least_ns / 1e9:g} to {most_ns / 1e9:g} s {acts}: {tick}"


def _is_time_driven(plan: Plan, link: LinkPlan) -> bool:
    """Returns whether the receiver of a link takes messages only at instants of its own."""
    receiver = plan.all_roles[link.receiver]
    if isinstance(receiver, BusRolePlan) or (isinstance(receiver, RobotPlan) and plan.can.closed):
        return True
    return not receiver.event_driven


def tick_of(plan: Plan, link: LinkPlan) -> int:
    """Returns the tick of a link [ns]."""
    receiver = plan.all_roles[link.receiver]
    if isinstance(receiver, RobotPlan) and plan.can.closed:
        return min(link.period_ns, receiver.torque_period_ns)
    if isinstance(receiver, BusRolePlan):
        return link.period_ns
    return min(link.period_ns, receiver.period_ns)


def ticks_up(delay_ns: int, tick_ns: int) -> int:
    """Returns a delay rounded up to a multiple of the tick [ns]."""
    return -(-delay_ns // tick_ns) * tick_ns
