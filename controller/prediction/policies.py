"""What receivers make of messages that are late or lost, in registers (docs/architecture.md, 2.11 and 4.3).

All nodes are time-driven, and a link has the period T of its receiver.  Let k be the age of an arriving message in periods.

    policy           value in use u at instant n, if the message m of n - k comes    if it is lost
    ---------------  --------------------------------------------------------------  ---------------------------------------
    hold             m                                                               u of n - 1
    predict          m moved through what was commanded since                        u of n - 1, moved through the last period
    extrapolate      m moved with its acceleration through k T                       u of n - 1, moved with it through T
    zero,            m                                                               u of n - 1 while that is young enough,
    hold_then_stop                                                                   else 0

Moving by k periods is moving k times by one, so no age need be known.  For the last row there is a register for each age: u_j
is the newest message if it is at most j periods older than a new one, else 0.
"""

from collections.abc import Callable, Sequence
from typing import Final, NamedTuple

import numpy as np

from echelon.controller.late_states import EXTRAPOLATE, PREDICT
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_roles import MOTION, moved
from echelon.controller.prediction.random_steps import Indices
from echelon.messages import Channel
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, NodePlan, Plan

Block = tuple[Indices, Indices, Array]
"""Rows, columns, and the numbers of a matrix there"""
MOST: Final = 200
"""Largest number of periods that a message may be older than a new one before it is too old, where it has a timeout"""
ACCELERATION: Final = (2, 2)
"""Powers of 1/s in the units of an acceleration"""


class Taken(NamedTuple):
    """How a message is taken."""

    before: list[Block]
    """What happens first, whether it comes or not"""
    dest: Indices
    """Registers that change if it comes"""
    source: Indices
    """Registers whose values they take"""


class Policies:
    """The policies of all links of a plan other than `hold`."""

    def __init__(self, plan: Plan, new: Callable[[Sequence[int]], Indices]) -> None:
        """`new` allocates registers for numbers with these powers of 1/s in their units."""
        self._plan = plan
        self._brought: dict[int, Indices] = {}
        self._young: dict[int, list[Indices]] = {}
        self._history: dict[int, list[Indices]] = {}
        longest: dict[int, int] = {}
        for link in plan.links:
            if link.policy == PREDICT:
                node = self._node(link.receiver)
                longest[node.index] = max(longest.get(node.index, 1), self._age(link) + self._command_delay(link), 1)
                longest[node.index] = max(longest[node.index], self._command_delay(link) + 1)
        for index, count in longest.items():
            size = 2 * len(self._node(index).children)
            self._history[index] = [new((2,) * size) for _ in range(count)]

    def further(self, source: int, channel: Channel) -> tuple[int, ...]:
        """Returns the powers of further numbers that messages have because of a policy: a robot's acceleration."""
        asked = channel is Channel.STATE and any(
            link.policy == EXTRAPOLATE for link in self._plan.links if (link.source, link.channel) == (source, channel)
        )
        return ACCELERATION if asked else ()

    def add(self, at: int, powers: Sequence[int], new: Callable[[Sequence[int]], Indices]) -> None:
        """Allocates what a link needs, by its place in `plan.links`; `powers` are those of its messages."""
        link = self._plan.links[at]
        if link.policy in (PREDICT, EXTRAPOLATE):
            self._brought[at] = new(powers)
        elif link.timeout_ns < NEVER_NS:
            older = (link.timeout_ns - self._age(link) * link.period_ns) // link.period_ns
            if older > MOST:
                raise PredictionError(
                    f"a timeout of {link.timeout_ns / 1e9:g} s: losses are computed for {MOST} periods at most"
                )
            if older < 0:
                raise PredictionError(
                    f"{link.channel.name.lower()} messages are older than their timeout when they arrive"
                )
            self._young[at] = [new(powers) for _ in range(older)]

    def taken(self, at: int, held: Indices, message: Indices) -> Taken:
        """Returns how a message is taken that has arrived: from the registers `message` to those in use, `held`."""
        link = self._plan.links[at]
        T = link.period_ns * 1e-9
        if link.policy == PREDICT:
            child = self._plan.formation[link.source]
            part = slice(2 * child.child_number, 2 * child.child_number + 2)
            delay, age = self._command_delay(link), self._age(link)
            commands = [each[part] for each in self._history[link.receiver]]
            used = [commands[back + delay] for back in range(age)][::-1]
            brought = self._brought[at]
            return Taken(
                [_moved_block(held, held, [commands[delay]], T), _moved_block(brought, message, used, T)], held, brought
            )
        if link.policy == EXTRAPOLATE:
            brought = self._brought[at]
            return Taken([_ahead(held, held, T), _ahead(brought, message, T * self._age(link))], held, brought)
        if at not in self._young:
            return Taken([], held, message)
        all_ages = [*self._young[at], held]
        shifted: list[Block] = [
            (older, younger, np.eye(len(held))) for younger, older in zip(all_ages[:-1], all_ages[1:], strict=True)
        ]
        shifted.append((all_ages[0], held[:0], np.zeros((len(held), 0))))
        return Taken(shifted, np.concatenate(all_ages), np.concatenate([message] * len(all_ages)))

    def noted(self, node: int, accelerations: Array, columns: Indices) -> list[Block]:
        """Returns what a node remembers of what it commands."""
        history = self._history.get(node)
        if history is None:
            return []
        blocks: list[Block] = [(history[0], columns, accelerations[: len(history[0])])]
        return blocks + [(old, new, np.eye(len(old))) for new, old in zip(history[:-1], history[1:], strict=True)]

    def _node(self, index: int) -> NodePlan:
        return self._plan.nodes[index - len(self._plan.robots)]

    def _age(self, link: LinkPlan) -> int:
        """Returns how old a message is when it is taken that comes [periods]."""
        return -(-link.delay_min_ns // link.period_ns)

    def _command_delay(self, link: LinkPlan) -> int:
        """Returns after how many periods what a node commands is taken to act."""
        down = next(each for each in self._plan.links if (each.source, each.receiver) == (link.receiver, link.source))
        return -(-down.delay_min_ns // down.period_ns)


def _moved_block(to: Indices, begin: Indices, commands: Sequence[Indices], T: float) -> Block:
    """Returns the motion from registers `begin` to `to` under commands, one for each period T; what else they have stays."""
    columns = np.concatenate([begin, *commands])
    unit = np.eye(len(columns))
    values, at = unit[: len(MOTION)], len(begin)
    for _ in commands:
        values, at = moved(values, unit[at : at + 2], T), at + 2
    return to, columns, np.vstack([values, unit[len(MOTION) : len(begin)]])


def _ahead(to: Indices, begin: Indices, T: float) -> Block:
    """Returns the motion from registers `begin` to `to` with the acceleration that is in them."""
    unit = np.eye(len(begin))
    return to, begin, np.vstack([moved(unit[: len(MOTION)], unit[len(MOTION) :], T), unit[len(MOTION) :]])


def check_policy(plan: Plan, link: LinkPlan) -> None:
    """Raises PredictionError if the policy of a link is not computed."""
    if link.policy == "hold":
        return
    name = f"{link.channel.name.lower()} links with the policy {link.policy}"
    if any(each.event_driven for each in plan.nodes):
        raise PredictionError(f'{name}: losses are computed with timing = "time_driven"')
    if len({each.period_ns for each in plan.formation}) > 1 or link.delay_min_ns % link.period_ns:
        raise PredictionError(f"{name}: losses are computed for equal periods and delays of whole periods")
    if not (link.clocks_are_true):
        raise PredictionError(f"{name}: losses are computed for clocks that are true")
    if link.policy == EXTRAPOLATE and link.channel is not Channel.STATE:
        raise PredictionError(f"{name}: losses are computed for states of robots")
    if link.timeout_ns < NEVER_NS and link.channel is not Channel.COMMAND and link.policy != "zero":
        raise PredictionError(f"{name}: a node that misses something stops all below it; this is not linear")
