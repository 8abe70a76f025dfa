"""What a role is: a plain object with stages, each a function of (time, what it heard) that returns messages.

Who calls the stages is none of the role's business: the in-process engine, a lockstep over Zenoh, or a wall clock.
A stage runs at every multiple of its period; stages of one instant run in the order of their turns (`echelon.runtime.turns`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

from echelon.messages import Channel, Heard, Message
from echelon.runtime.turns import Turn


@dataclass(frozen=True, slots=True)
class Input:
    """One channel of one source."""

    source: int
    channel: Channel


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of a role: at multiples of `period_ns`, `run(time_ns, heard)` with one entry of `heard` per input."""

    turn: Turn
    """When it runs within an instant: after all stages whose turn comes earlier, over all roles of a run"""
    period_ns: int
    inputs: tuple[Input, ...]
    run: Callable[[int, Sequence[Heard]], tuple[Message, ...]]
    first_ns: int = 0
    """When it runs first; before the run where drives have to be brought up"""
    depth: int = 0
    """How deep in the tree its node stands, for turns that nodes take one depth after the other"""


class Role(Protocol):
    """A robot, a leader, the coordinator; or the bridge or the drives between robots and their wheels."""

    @property
    def index(self) -> int:
        """The member's index in the plan."""

    @property
    def stages(self) -> tuple[Stage, ...]:
        """Its stages, in the order in which they run at one instant."""
