"""Users' own parts in a run: which role runs which, and which one hangs.

A part that raises or returns nonsense causes PartRunError.  A part that never returns must be found from outside: the
supervisor finds a silent process; in one process the time of an instant is limited.
"""

from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from traceback import walk_tb

from echelon.agents.robot import Robot
from echelon.bridge.roles.commander import Commander
from echelon.bridge.roles.drive_bank import DriveBank
from echelon.controller.node import TreeNode
from echelon.plan.plan import NodePlan, Plan, RobotPlan
from echelon.sim.parts.time_limit import TookTooLong, time_limit


def parts_of(plan: Plan, index: int) -> tuple[str, ...]:
    """Returns the users' parts that a role runs, as the scenario names them.  Bridge, drives and referee, which may be no roles
    of the plan, run the protocols of all drives."""
    one = plan.all_roles[index] if 0 <= index < len(plan.formation) else None
    if isinstance(one, RobotPlan):
        parts = [one.model]
    elif isinstance(one, NodePlan):
        parts = [plan.law] if one.parent is not None else [plan.law, plan.trajectory]
    else:
        parts = [robot.drive.protocol for robot in plan.robots]
    return tuple(dict.fromkeys(part.use for part in parts if not part.is_own))


def runs_text(plan: Plan, index: int) -> str:
    """Returns words about the users' parts that a role runs, to follow its name; "" if there are none."""
    parts = parts_of(plan, index)
    return f", which runs {' and '.join(parts)}" if parts else ""


def unstalled(plan: Plan, instants: Iterator[int], seconds: float) -> Iterator[int]:
    """Yields the instants of a run in one process.

    If its roles run users' parts, raises TookTooLong when an instant takes longer than `seconds`."""
    if not any(parts_of(plan, one.index) for one in plan.all_roles):
        yield from instants
        return
    while True:
        with time_limit(seconds):
            time_ns = next(instants, None)
        if time_ns is None:
            return
        yield time_ns


def patience_with_bridge(plan: Plan, seconds: float) -> AbstractContextManager[object]:
    """Returns a context that raises TookTooLong if what a bridge does in one process takes longer than `seconds`; without a
    limit if no drive speaks a user's own protocol."""
    return time_limit(seconds) if parts_of(plan, len(plan.formation)) else nullcontext()


def stalled_in(plan: Plan, error: TookTooLong) -> str:
    """Returns in words which part was running when an instant took too long."""
    for frame, _ in walk_tb(error.__traceback__):
        role = frame.f_locals.get("self")
        if isinstance(role, (Robot, TreeNode, Commander, DriveBank)):
            return f"{plan.all_roles[role.index].name}{runs_text(plan, role.index)}"
    return f"bridge{runs_text(plan, len(plan.formation))}"
