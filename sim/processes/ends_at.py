"""Where a run ends."""

from enum import Enum, auto


class EndsAt(Enum):
    """Where a run ends before its duration is over."""

    DIVERGED = auto()
    """At the first instant at which a robot has diverged: it is beyond its reach (`sim.parts.reach`), or as for UNBOUNDED"""
    UNBOUNDED = auto()
    """At the first instant at which a state is not finite or beyond all bounds (`admission.within`)"""
    NOWHERE = auto()
    """It goes on to its end"""
