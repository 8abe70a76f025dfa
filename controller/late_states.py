"""What a node makes of the states of its children that are late (docs/architecture.md, 2.5 and 4.3).

A state that is τ old when the node acts, by the clocks of sender and receiver, is brought to the present t:

    policy of the link        position and velocity that the node uses
    ------------------------  ---------------------------------------------------------------------------------------------
    hold, hold_then_stop,     as they are, if law.reference is "now"; otherwise moved on as the reference has moved:
    zero                      p + z_cd(t) - z_cd(t - τ),  v + ż_cd(t) - ż_cd(t - τ)
    extrapolate               p + v τ + a τ²/2,  v + a τ, with the last acceleration a that is known
    predict                   moved through the accelerations that the node itself has commanded since t - τ

The last known acceleration of a robot is the one in its STATE; that of a group is the one that the node last commanded.  What a
node commands is taken to act when it is sent, plus the smallest delay of the link on which it is sent.  For double integrators
*predict* is exact while no command is lost or late beyond that: the loop is then the one without delay.

Positions of robots below a child move as the child's centroid does.
"""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np

from echelon.controller.trajectory import Desired
from echelon.messages import STATE_FIELDS, Channel, Heard, Message, Values, field_index
from echelon.plan.layout import CENTROID, GroupStateLayout, length
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, NodePlan, Plan

EXTRAPOLATE, PREDICT = "extrapolate", "predict"
_ACCELERATION = field_index(STATE_FIELDS, "ax", "ay")


@dataclass(frozen=True, slots=True)
class _Child:
    """One child of a node."""

    link: LinkPlan
    """The link of its states"""
    command_delay_ns: int
    """Smallest delay of what the node commands it"""
    positions: slice | None
    """Where its message has positions of the robots below; None: nowhere beside its centroid"""


class LateStates:
    """The children's states of one node, brought to the present."""

    def __init__(self, plan: Plan, node: NodePlan, trajectory: Desired) -> None:
        robots = len(plan.robots)
        up = {link.source: link for link in plan.links_into(node.index) if link.channel is not Channel.REFERENCE}
        down = {link.receiver: link for link in plan.links if link.source == node.index}
        self._children = [
            _Child(up[child], down[child].delay_min_ns, _positions(plan, child) if child >= robots else None)
            for child in node.children
        ]
        self._trajectory = trajectory
        self._of_message = plan.reference == "message"
        policies = {child.link.policy for child in self._children}
        self.remembers = PREDICT in policies or (
            EXTRAPOLATE in policies and any(child >= robots for child in node.children)
        )
        """True if the node must tell what it commands (`note`)"""
        self._acts = self._of_message or bool(policies & {EXTRAPOLATE, PREDICT})
        self._odd_clocks = any(not child.link.clocks_are_true for child in self._children)
        self._commanded: deque[tuple[int, Array]] = deque([(0, np.zeros((len(node.children), 2)))])
        """What was commanded: instant [ns], accelerations (children, 2) [m/s²]; in order of time"""

    def note(self, time_ns: int, accelerations: Array | None) -> None:
        """Takes the accelerations that the node commands at an instant, (2 n,); None if it commands nothing."""
        shape = self._commanded[-1][1].shape
        self._commanded.append((time_ns, np.zeros(shape) if accelerations is None else accelerations.reshape(shape)))

    def present(self, time_ns: int, heard: Sequence[Heard]) -> list[Values]:
        """Returns the values of the messages of all children, brought to the present; leaves out those that are missing."""
        said = [message.values for message in heard if message is not None]
        if self._acts and len(said) == len(heard):
            for message in heard:
                if self._odd_clocks or (message is not None and message.time_ns != time_ns):
                    return self._brought(time_ns, heard)
        return said

    def _brought(self, time_ns: int, heard: Sequence[Heard]) -> list[Values]:
        said, oldest_ns = [], time_ns
        for number, (child, message) in enumerate(zip(self._children, heard, strict=True)):
            assert message is not None
            since_ns = time_ns - child.link.read_age_ns(time_ns, message.time_ns)
            oldest_ns = min(oldest_ns, since_ns - child.command_delay_ns)
            moved = self._moved(time_ns, since_ns, number, message)
            if moved is None:
                said.append(message.values)
                continue
            values = message.values.copy()
            values[CENTROID] += moved
            if child.positions is not None:
                values[child.positions] += np.tile(moved[:2], length(child.positions) // 2)
            said.append(values)
        # By a clock that drifts a held message becomes older: one command more is kept.
        while len(self._commanded) > 2 and self._commanded[2][0] <= oldest_ns:
            self._commanded.popleft()
        return said

    def _moved(self, time_ns: int, since_ns: int, number: int, message: Message) -> Array | None:
        """Returns by how much a child's centroid and its velocity have moved since an instant, (4,); None: not at all."""
        child = self._children[number]
        policy, tau = child.link.policy, (time_ns - since_ns) * 1e-9
        if since_ns == time_ns:
            return None
        if policy == PREDICT:
            return self._replayed(time_ns, since_ns, number, message.values[CENTROID][2:])
        if policy == EXTRAPOLATE:
            velocity = message.values[CENTROID][2:]
            of_robot = message.channel is Channel.STATE
            a = message.values[_ACCELERATION] if of_robot else self._commanded[-1][1][number]
            return np.concatenate((velocity * tau + a * (tau**2 / 2), a * tau))
        if self._of_message:
            now, then = (self._trajectory.at(max(0, at_ns) * 1e-9)[:2] for at_ns in (time_ns, since_ns))
            return np.asarray((now - then).ravel())
        return None

    def _replayed(self, time_ns: int, since_ns: int, number: int, velocity: Array) -> Array:
        """Returns the motion from an instant to the present under the accelerations commanded to a child, (4,)."""
        delay_ns = self._children[number].command_delay_ns
        p, v = np.zeros(2), velocity
        instants = [since_ns, *(at_ns + delay_ns for at_ns, _ in islice(self._commanded, 1, None))]
        for (_, accelerations), begin_ns, end_ns in zip(
            self._commanded, instants, [*instants[1:], time_ns], strict=True
        ):
            h = (min(end_ns, time_ns) - max(begin_ns, since_ns)) * 1e-9
            if h > 0:
                a = accelerations[number]
                p, v = p + h * v + h**2 / 2 * a, v + h * a
        return np.concatenate((p, v - velocity))


def _positions(plan: Plan, child: int) -> slice | None:
    """Returns where the GROUP_STATE of a child node has the positions of the robots below; None if it has none."""
    node = plan.formation[child]
    assert isinstance(node, NodePlan)
    positions = GroupStateLayout.of(plan, node).positions
    return positions if length(positions) else None
