"""The links of a plan: the rules of the scenario's `links`, and the events that concern links, applied to every link.

All functions raise PlanError with the key, the value and what is allowed.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

from echelon.errors import Mistakes
from echelon.messages import Channel
from echelon.plan.can_plan import NEVER_NS, BusRolePlan, CanPlan
from echelon.plan.delay_tables import TRUE_CLOCK, Bursts, DelayTable, DelayTrace, merged
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import NodePlan, PlanError, RobotPlan
from echelon.plan.punctuality import with_punctuality
from echelon.planning.delays import delays_of
from echelon.scenario.link_tables import Blackout, CutOff, LinkRule
from echelon.scenario.values import path_matches

SHOWN_NAMES: Final = 12
"""Number of members that an error lists"""
STATES: Final = (Channel.STATE, Channel.GROUP_STATE)
ACCELERATIONS: Final = (Channel.COMMAND, Channel.REFERENCE)
CHANNELS_OF_POLICY: Final = {"zero": ACCELERATIONS, "extrapolate": STATES, "predict": STATES}
"""The channels on which a policy makes sense; other policies do on all"""


@dataclass(frozen=True, slots=True)
class _Made:
    """What a rule says of every link that it fits."""

    rule: LinkRule
    key: str
    delay_min_ns: int
    delay_max_ns: int
    delays: DelayTable | DelayTrace | None
    loss: float
    bursts: Bursts | None


def make_links(
    rules: Sequence[LinkRule],
    events: Iterable[object],
    robots: Sequence[RobotPlan],
    nodes: Sequence[NodePlan],
    bus_roles: Sequence[BusRolePlan],
    can: CanPlan,
) -> tuple[LinkPlan, ...]:
    """Returns all links.  Links of the tree, and from robots to the bridge, are as the last rule says that fits; the others are
    ideal.

    Raises PlanError if a rule or an event fits no link, or a rule does not fit its links."""
    all_roles: list[RobotPlan | NodePlan | BusRolePlan] = [*robots, *nodes, *bus_roles]
    names = [one.name for one in all_roles]
    clocks = [TRUE_CLOCK if isinstance(one, BusRolePlan) else one.clock for one in all_roles]
    mistakes = Mistakes()
    made: list[_Made] = []
    for at, rule in enumerate(rules):
        if rule.name is not None and rule.name in [other.name for other in rules[:at]]:
            mistakes.lines.append(f"links.{at}.name = {rule.name!r}: is the name of another rule")
        with mistakes.noted():
            made.append(_made(rule, f"links.{at}"))
    mistakes.check(PlanError)
    used: set[str] = set()
    wrong: dict[str, str] = {}
    links: list[LinkPlan] = []
    plain = _made(LinkRule(), "")
    for source, receiver, channel, period_ns in [*_tree_links(robots, nodes), *_torque_links(robots, bus_roles)]:
        fitting = [each for each in made if _fits(each.rule, names[source], names[receiver], channel)]
        used.update(each.key for each in fitting)
        says = fitting[-1] if fitting else plain
        try:
            link = _link(says, source, receiver, channel, period_ns, can)
            links.append(replace(link, source_clock=clocks[source], receiver_clock=clocks[receiver]))
        except PlanError as error:
            wrong.setdefault(says.key, error.lines[0])
    unused = [_why_unused(each.rule, each.key, names, can.closed) for each in made if each.key not in used]
    if unused or wrong:
        raise PlanError(*unused, *wrong.values())
    of_rules = _with_blackouts(links, rules, events, names, can.closed)
    return (*with_punctuality(of_rules, nodes), *_shaft_links(robots, bus_roles, can))


def _fits(rule: LinkRule | Blackout, source: str, receiver: str, channel: Channel) -> bool:
    """True if a rule or an event is about a link."""
    return (
        rule.channel in ("*", channel.name.lower())
        and path_matches(rule.source, source)
        and path_matches(rule.receiver, receiver)
    )


def _made(rule: LinkRule, key: str) -> _Made:
    """Returns what a rule says.  Raises PlanError."""
    low_ns, high_ns, delays = delays_of(rule, f"{key}.delay")
    if isinstance(rule.loss, float | int):
        return _Made(rule, key, low_ns, high_ns, delays, rule.loss, None)
    said = rule.loss
    share = (said.mean - said.good) / (said.bad - said.good)
    to_good = 1 / said.burst
    bursts = Bursts(min(1.0, to_good * share / (1 - share)), to_good, said.good, said.bad)
    return _Made(rule, key, low_ns, high_ns, delays, said.mean, bursts)


def _link(made: _Made, source: int, receiver: int, channel: Channel, period_ns: int, can: CanPlan) -> LinkPlan:
    """Returns a link as a rule says.  Raises PlanError."""
    rule, key = made.rule, made.key
    policy = rule.policy or ("hold_then_stop" if can.closed else "hold")
    allowed = CHANNELS_OF_POLICY.get(policy)
    if allowed is not None and channel not in allowed:
        on = " and ".join(repr(each.name.lower()) for each in allowed)
        raise PlanError(
            f"{key}.policy = {policy!r}: is for the channels {on}, and the rule fits {channel.name.lower()!r} too"
        )
    timeout_ns = NEVER_NS
    if rule.timeout is not None:
        timeout_ns = round(rule.timeout * 1e9)
    elif policy == "hold_then_stop":
        # A message that comes once per period may be a whole period old; so the default is at least two periods.
        timeout_ns = max(can.watchdog_ns, 2 * period_ns)
    elif policy == "zero":
        if made.delays is not None:
            raise PlanError(
                f"{key}.timeout: missing; policy = 'zero' needs it where the delay is neither constant nor uniform"
            )
        timeout_ns = made.delay_max_ns + period_ns - 1
    return LinkPlan(
        source,
        receiver,
        channel,
        period_ns,
        made.delay_min_ns,
        made.delay_max_ns,
        made.loss,
        timeout_ns,
        name=rule.name or "",
        policy=policy,
        delays=made.delays,
        bursts=made.bursts,
        loss_of_message=rule.loss_of == "message",
        duplicates=rule.duplicates,
        fifo=rule.order == "fifo",
    )


def _with_blackouts(
    links: Sequence[LinkPlan], rules: Sequence[LinkRule], events: Iterable[object], names: Sequence[str], closed: bool
) -> list[LinkPlan]:
    """Returns the links with the times in which they lose everything.  Raises PlanError if an event fits no link."""
    windows: list[list[tuple[int, int]]] = [[] for _ in links]
    mistakes = Mistakes()
    for number, event in enumerate(events):
        if not isinstance(event, Blackout | CutOff):
            continue
        key = f"events.{number}"
        begin_ns = round(event.at * 1e9)
        window = begin_ns, NEVER_NS if event.duration is None else begin_ns + round(event.duration * 1e9)
        with mistakes.noted():
            if isinstance(event, CutOff):
                members = {at for at, name in enumerate(names) if path_matches(event.member, name)}
                hit = [at for at, link in enumerate(links) if {link.source, link.receiver} & members]
                if not hit:
                    raise PlanError(_no_member(f"{key}.member", event.member, names))
            else:
                _check_name(event, rules, key)
                hit = [
                    at
                    for at, link in enumerate(links)
                    if event.link in (None, link.name)
                    and _fits(event, names[link.source], names[link.receiver], link.channel)
                ]
                if not hit:
                    raise PlanError(_why_unused(event, key, names, closed))
            for at in hit:
                windows[at].append(window)
    mistakes.check(PlanError)
    return [replace(link, blackouts=merged(each)) if each else link for link, each in zip(links, windows, strict=True)]


def _check_name(event: Blackout, rules: Sequence[LinkRule], key: str) -> None:
    """Raises PlanError if no rule has the name that an event gives."""
    known = [rule.name for rule in rules if rule.name is not None]
    if event.link is not None and event.link not in known:
        allowed = f"must be one of {', '.join(map(repr, known))}" if known else "no rule in links has a name"
        raise PlanError(f"{key}.link = {event.link!r}: {allowed}")


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


def _no_member(key: str, pattern: str, names: Sequence[str]) -> str:
    """Returns the text that says that a pattern fits no member."""
    from_the_root = sorted(names, key=lambda name: (name != "coordinator", name.count("/")))
    shown = ", ".join(from_the_root[:SHOWN_NAMES])
    more = f", and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
    return f"{key} = {pattern!r}: fits no member; there are {shown}{more}"


def _why_unused(rule: LinkRule | Blackout, key: str, names: Sequence[str], closed: bool) -> str:
    """Returns the text that says why a rule or an event fits no link."""
    for end, pattern in (("source", rule.source), ("receiver", rule.receiver)):
        if not any(path_matches(pattern, name) for name in names):
            return _no_member(f"{key}.{end}", pattern, names)
    named = f" of the rule {rule.link!r}" if isinstance(rule, Blackout) and rule.link is not None else ""
    return (
        f"{key}: no link{named} goes from {rule.source!r} to {rule.receiver!r} on channel {rule.channel!r}; links go from a "
        "node's child to it on 'state' or 'group_state', and back on 'command' or 'reference'"
        + (", and from a robot to 'bridge' on 'torque'" if closed else "")
    )
