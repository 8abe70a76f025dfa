"""The engine in one process: it runs all roles of a plan and hands messages over directly (docs/architecture.md, 3.4).

It is the reference for the other ways to run a plan.  Stages of one instant run in the order of their turns
(`echelon.runtime.turns`).  Messages pass the same mailboxes and links as between processes.
"""

from collections.abc import Callable, Iterator, Sequence
from math import gcd
from typing import TYPE_CHECKING, NamedTuple, cast

from echelon.agents.robot import make_robot
from echelon.agents.torque_loop import Loop, usual
from echelon.controller.node import TreeNode
from echelon.messages import Heard, Message
from echelon.plan.plan import NodePlan, Plan, RobotPlan
from echelon.role import Role
from echelon.runtime.link import LinkCounts
from echelon.runtime.mailbox import Mailbox
from echelon.runtime.turns import Turn, level

if TYPE_CHECKING:
    from echelon.bridge.roles.commander import Commander
    from echelon.bridge.roles.drive_bank import DriveBank

Sink = Callable[[Message], None]


def make_roles(plan: Plan) -> list[Role]:
    """Returns the roles of a plan by index."""
    return [make_role(plan, index) for index in range(len(plan.all_roles))]


def make_role(plan: Plan, index: int, loop: Loop = usual) -> Role:
    """Returns one role of a plan: a robot, a node, the bridge or the drives.  `loop` is the usual torque loop of a robot.

    Raises IndexError if the plan has no role of that index."""
    one = plan.all_roles[index]
    if isinstance(one, RobotPlan):
        return make_robot(plan, index, loop)
    if isinstance(one, NodePlan):
        return TreeNode(plan, index)
    from echelon.bridge.roles.commander import Commander  # slow imports, which only bridge and drives need
    from echelon.bridge.roles.drive_bank import DriveBank

    return Commander(plan) if one.role == "bridge" else DriveBank(plan)


class Row(NamedTuple):
    """The stages of all roles with the same turn: (role, number of the stage, its function, its inputs)."""

    turn: Turn
    period_ns: int
    first_ns: int
    prompt: bool
    """True if these stages act at their nominal instants, once in each period"""
    stages: list[tuple[int, int, Callable[[int, Sequence[Heard]], tuple[Message, ...]], Mailbox]]

    def is_due(self, time_ns: int) -> bool:
        """Returns whether these stages run at an instant."""
        return time_ns % self.period_ns == 0 and time_ns >= self.first_ns


def _timetable(plan: Plan, roles: Sequence[Role], mailboxes: Sequence[Mailbox]) -> list[Row]:
    """Returns all stages of a run in the order of their turns."""
    rows: dict[tuple[int, int, int, bool], Row] = {}
    for role in roles:
        mailbox = mailboxes[role.index]
        for number, stage in enumerate(role.stages):
            prompt = mailbox.prompt[number]
            key = level(plan, stage.turn, stage.depth), stage.period_ns, stage.first_ns, prompt
            row = rows.setdefault(key, Row(stage.turn, stage.period_ns, stage.first_ns, prompt, []))
            row.stages.append((role.index, number, stage.run, mailbox))
    return [row for _, row in sorted(rows.items())]


class Engine:
    """A run in one process.  `sink`, if given, gets every message."""

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
        self.timetable = _timetable(plan, self.roles, self.mailboxes)
        self.tick_ns = gcd(*[row.period_ns for row in self.timetable])
        """Time between two instants [ns]"""
        self.first_ns = min(row.first_ns for row in self.timetable)
        """The first instant [ns]: negative if drives are brought up"""

    @property
    def commander(self) -> "Commander | None":
        """The role of the bridge; None on the mirrored path."""
        return None if self.plan.bridge is None else cast("Commander", self.roles[self.plan.bridge.index])

    @property
    def drives(self) -> "DriveBank | None":
        """The role of the virtual drives; None if there are none."""
        return None if self.plan.drives is None else cast("DriveBank", self.roles[self.plan.drives.index])

    def instants(self) -> Iterator[int]:
        """Runs the whole plan, from `first_ns` to its duration inclusive; yields each instant [ns] when it is done."""
        receivers, sink = self._receivers, self._sink
        # the body of `post` is repeated below, since this is the innermost loop
        for time_ns in range(self.first_ns, self.plan.duration_ns + 1, self.tick_ns):
            for _, period_ns, first_ns, prompt, stages in self.timetable:
                if time_ns % period_ns or time_ns < first_ns:
                    continue
                if not prompt:
                    for _, number, run, mailbox in stages:
                        self.act(time_ns, number, run, mailbox)
                    continue
                for _, number, run, mailbox in stages:
                    for message in run(time_ns, mailbox.take(number, time_ns)):
                        self.messages += 1
                        for receiver in receivers.get((message.source, message.channel), ()):
                            receiver.deliver(message)
                        if sink is not None:
                            sink(message)
            yield time_ns

    def act(
        self, time_ns: int, number: int, run: Callable[[int, Sequence[Heard]], tuple[Message, ...]], mailbox: Mailbox
    ) -> None:
        """Lets a stage act that is due at `time_ns`, as often as it does in its period."""
        for at_ns, heard in mailbox.acts(number, time_ns):
            for message in run(at_ns, heard):
                self.post(message)

    def post(self, message: Message) -> None:
        """Hands a message to all its receivers."""
        self.messages += 1
        for receiver in self._receivers.get((message.source, message.channel), ()):
            receiver.deliver(message)
        if self._sink is not None:
            self._sink(message)

    def run(self) -> None:
        """Runs the whole plan."""
        for _ in self.instants():
            pass

    def link_counts(self) -> list[LinkCounts]:
        """Returns the counts of all links, receiver by receiver."""
        return [counts for mailbox in self.mailboxes for counts in mailbox.counts()]
