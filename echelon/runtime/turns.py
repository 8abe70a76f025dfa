"""Turns: what happens at one instant, and in which order.

Every stage of a role (`echelon.role.Stage`) has a turn.  At one instant the turns come in this order; a stage hears what was
said in the turns before its own, or at earlier instants, and never waits for a later turn:

    turn        whose             what is done
    ----------  ----------------  -----------------------------------------------------------------------------------
    REPORT   *  drives            say what they feed back at this instant
    HEAR     *  bridge            takes that, and tells robots the torques of their wheels in the period that ends
    CATCH_UP *  robots on a bus   move through the torque period that ends, with these torques
    SAY         robots            say their state
    GATHER      nodes             gather the states of their children, from the deepest nodes up to the root
    STEER       nodes             hand accelerations down, from the root to the deepest nodes
    ACT         robots            move through the period that begins; or, on a bus, say what torques they want
    SEND     *  bridge            makes frames of the torques, and lets the buses carry them until the next instant
    SERVE    *  drives            work through the frames that the buses carry until the next instant

Turns with a star exist only where the torque path is closed (`plan.can.closed`); where torque is mirrored, the bridge only
watches.  Nodes of one depth have their turn together; the root has depth 0.

In virtual time only the order counts.  On a wall clock the turns share the period: a stage waits for what it hears until its
deadline.  The deadline of the first turn is the beginning of the period, that of the last its end, and the others lie evenly
between.
"""

from enum import Enum, auto
from typing import Final

from echelon.plan.plan import Plan


class Turn(Enum):
    """The turns in the order of an instant; what each is for is the table above."""

    REPORT = auto()
    HEAR = auto()
    CATCH_UP = auto()
    SAY = auto()
    GATHER = auto()
    STEER = auto()
    ACT = auto()
    SEND = auto()
    SERVE = auto()


ON_BUS: Final = frozenset({Turn.REPORT, Turn.HEAR, Turn.CATCH_UP, Turn.SEND, Turn.SERVE})
"""Turns that exist only where the torque path is closed."""


def turns(plan: Plan) -> list[tuple[Turn, int]]:
    """Returns all turns of an instant in their order, each with the depth of the nodes whose turn it is; 0 for other roles."""
    deepest = max(node.depth for node in plan.nodes)
    depths = {Turn.GATHER: range(deepest, -1, -1), Turn.STEER: range(deepest + 1)}
    return [
        (turn, depth) for turn in Turn if plan.can.closed or turn not in ON_BUS for depth in depths.get(turn, range(1))
    ]


def level(plan: Plan, turn: Turn, depth: int) -> int:
    """Returns how many turns of an instant come before this one.  Raises ValueError if the plan has no such turn."""
    return turns(plan).index((turn, depth))


def deadline_ns(plan: Plan, turn: Turn, depth: int, period_ns: int) -> int:
    """Returns how long after an instant a stage may wait on a wall clock, from 0 to its period [ns], rounded down.

    Raises ValueError if the plan has no such turn."""
    return period_ns * level(plan, turn, depth) // (len(turns(plan)) - 1)
