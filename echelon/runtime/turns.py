"""Turns: the order of the stages of one instant.

Every stage of a role (`echelon.role.Stage`) has a turn.  At one instant the turns follow each other in the order of this
table.  A stage uses messages of earlier turns or of earlier instants, and never waits for a later turn.

    turn        role              what the stage does
    ----------  ----------------  -----------------------------------------------------------------------------------
    REPORT   *  drives            send their feedback of this instant
    HEAR     *  bridge            take the feedback; send robots the torques of their wheels in the period that ends
    CATCH_UP *  robots            move through the torque period that ends, with these torques
    SAY         robots            send their state
    GATHER      nodes             gather the states of their children, from the deepest nodes up to the root
    STEER       nodes             send accelerations to their children, from the root down to the deepest nodes
    ACT         robots            torque mirrored: move through the period that begins; closed: send the wanted torques
    SEND     *  bridge            make frames of the torques; the buses carry them until the next instant
    SERVE    *  drives            process the frames that the buses carry until the next instant

Turns with a star exist only if the torque path is closed (`plan.can.closed`); where torque is mirrored, the bridge only
observes.  Nodes of the same depth have their turn together; the root has depth 0.

In virtual time only the order matters.  On a wall clock the turns share the period: a stage waits for its inputs until the
deadline of its turn.  The deadline of the first turn is the beginning of the period, that of the last turn its end; the
others are evenly spaced between them.
"""

from enum import Enum, auto
from typing import Final

from echelon.plan.plan import Plan


class Turn(Enum):
    """The turns in their order within an instant; the table above says what each does."""

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
"""Turns that exist only if the torque path is closed."""


def turns(plan: Plan) -> list[tuple[Turn, int]]:
    """Returns the turns of an instant in their order, each with the depth of its nodes in the tree, or 0 for other roles."""
    deepest = max(node.depth for node in plan.nodes)
    depths = {Turn.GATHER: range(deepest, -1, -1), Turn.STEER: range(deepest + 1)}
    return [
        (turn, depth) for turn in Turn if plan.can.closed or turn not in ON_BUS for depth in depths.get(turn, range(1))
    ]


def level(plan: Plan, turn: Turn, depth: int) -> int:
    """Returns the number of turns of an instant that come before this one.  Raises ValueError if the plan has no such turn."""
    return turns(plan).index((turn, depth))


def deadline_ns(plan: Plan, turn: Turn, depth: int, period_ns: int) -> int:
    """Returns how long after an instant a stage of this turn may wait on a wall clock [ns]: 0 to its period, rounded down.

    Raises ValueError if the plan has no such turn."""
    return period_ns * level(plan, turn, depth) // (len(turns(plan)) - 1)
