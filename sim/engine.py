"""The in-process engine: all roles of a plan in one process, messages handed over directly.  The truth of the others.

Stages of one instant run in the order of their turns (`echelon.turns`).  What the roles hear goes through the same
mailboxes, and so through the same links, as between processes.
"""

from collections.abc import Callable, Iterator
from itertools import groupby
from math import gcd
from typing import TYPE_CHECKING, cast

from echelon.agents.robot import make_robot
from echelon.controller.node import TreeNode
from echelon.link import LinkCounts
from echelon.mailbox import Mailbox
from echelon.messages import Message
from echelon.plan import NodePlan, Plan, RobotPlan
from echelon.role import Role
from echelon.turns import level

if TYPE_CHECKING:
    from echelon.bridge.commander import Commander
    from echelon.bridge.drive_bank import DriveBank

Sink = Callable[[Message], None]


def make_roles(plan: Plan) -> list[Role]:
    """Returns the roles of a plan by index."""
    return [make_role(plan, index) for index in range(len(plan.all_roles))]


def make_role(plan: Plan, index: int) -> Role:
    """Returns one role of a plan: a robot, a node, or the bridge or the drives between robots and their wheels.

    Raises IndexError if the plan has no role of that index."""
    one = plan.all_roles[index]
    if isinstance(one, RobotPlan):
        return make_robot(plan, index)
    if isinstance(one, NodePlan):
        return TreeNode(plan, index)
    from echelon.bridge.commander import Commander  # the protocols of drives, for two processes alone
    from echelon.bridge.drive_bank import DriveBank

    return Commander(plan) if one.role == "bridge" else DriveBank(plan)


class Engine:
    """A run in one process."""

    def __init__(self, plan: Plan, sink: Sink | None = None) -> None:
        self.plan = plan
        self.roles = make_roles(plan)
        self.mailboxes = [Mailbox(role, plan) for role in self.roles]
        self.messages = 0
        self._sink = sink
        receivers: dict[tuple[int, int], list[Mailbox]] = {}
        for link in plan.links:
            receivers.setdefault((link.source, link.channel), []).append(self.mailboxes[link.receiver])
        self._receivers = receivers
        stages = [
            (
                level(plan, stage.turn, stage.depth),
                stage.period_ns,
                stage.first_ns,
                role.index,
                number,
                stage.run,
                self.mailboxes[role.index],
            )
            for role in self.roles
            for number, stage in enumerate(role.stages)
        ]
        self._stages = [
            (period, first, [(number, run, mailbox) for *_, number, run, mailbox in group])
            for (_, period, first), group in groupby(
                sorted(stages, key=lambda stage: stage[:5]), key=lambda stage: stage[:3]
            )
        ]
        self._tick_ns = gcd(*[period for period, _, _ in self._stages])
        self._first_ns = min(first for _, first, _ in self._stages)

    @property
    def commander(self) -> "Commander | None":
        """The role of the bridge, where the torque path is closed."""
        return None if self.plan.bridge is None else cast("Commander", self.roles[self.plan.bridge.index])

    @property
    def drives(self) -> "DriveBank | None":
        """The role of the virtual drives, where there are any."""
        return None if self.plan.drives is None else cast("DriveBank", self.roles[self.plan.drives.index])

    def instants(self) -> Iterator[int]:
        """Runs the whole plan, from 0 (or from when drives are brought up) to its duration inclusive; yields each instant
        [ns] when it is done."""
        receivers, sink, stages = self._receivers, self._sink, self._stages
        for time_ns in range(self._first_ns, self.plan.duration_ns + 1, self._tick_ns):
            for period, first_ns, group in stages:
                if time_ns % period or time_ns < first_ns:
                    continue
                for number, run, mailbox in group:
                    for message in run(time_ns, mailbox.take(number, time_ns)):
                        self.messages += 1
                        for receiver in receivers.get((message.source, message.channel), ()):
                            receiver.deliver(message)
                        if sink is not None:
                            sink(message)
            yield time_ns

    def run(self) -> None:
        """Runs the whole plan."""
        for _ in self.instants():
            pass

    def link_counts(self) -> list[LinkCounts]:
        """Returns the counts of all links, receiver by receiver."""
        return [counts for mailbox in self.mailboxes for counts in mailbox.counts()]
