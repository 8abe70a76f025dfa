"""Roles and their stages.  A role is a plain object; a stage is a function of a time and of inputs that returns messages.

A role does not know what calls its stages: the in-process engine, a lockstep over Zenoh, or a wall clock.  A stage is due at
every multiple of its period; when it acts then, its `Acts` say.  Stages that are due at one instant run in the order of their
turns (`echelon.runtime.turns`).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from typing import Protocol

from echelon.messages import Channel, Heard, Message
from echelon.runtime.turns import Turn


@dataclass(frozen=True, slots=True)
class Input:
    """An input of a stage: the messages of one source on one channel."""

    source: int
    channel: Channel


class Acts(Enum):
    """When a stage acts that is due (the table in `echelon.runtime.mailbox`)."""

    IN_TURN = auto()
    """At its instant.  On a wall clock it waits until the deadline of its turn for messages that are missing"""
    AT_INSTANT = auto()
    """At its instant, with what has arrived: a time-driven node or robot"""
    WHEN_HEARD = auto()
    """When every input has something newer, or at the end of its period: an event-driven node"""
    ON_ARRIVAL = auto()
    """At its instant, and whenever something newer arrives: an event-driven robot.  Such a stage is the last of its role"""


@dataclass(frozen=True, slots=True)
class Stage:
    """One step of a role.  It is due at multiples of `period_ns`, and called as `run(time_ns, heard)` with the instant at which
    it acts, in the period that begins when it is due; `heard` has one entry for each of `inputs`, in the same order."""

    turn: Turn
    """The stage's place in the order of an instant: it runs after all stages, of any role, that have an earlier turn"""
    period_ns: int
    inputs: tuple[Input, ...]
    run: Callable[[int, Sequence[Heard]], tuple[Message, ...]]
    first_ns: int = 0
    """Run time of its first call; negative for bridge and drives, which bring the drives up before run time 0"""
    acts: Acts = Acts.IN_TURN
    """When it acts"""
    depth: int = 0
    """Depth of its node in the tree, for turns that nodes take depth by depth; otherwise 0"""


class Role(Protocol):
    """A robot, a leader, the coordinator, the bridge, or the drives."""

    @property
    def index(self) -> int:
        """The member's index in the plan."""

    @property
    def stages(self) -> tuple[Stage, ...]:
        """The role's stages, in the order in which they run at one instant."""
