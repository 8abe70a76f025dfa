"""Users' own parts in a run: which role runs which, and which one hangs.

A part that raises or returns nonsense causes PartRunError.  A part that never returns must be found from outside: the
supervisor finds a silent process; in one process the time of an instant is limited.
"""

from collections.abc import Iterator
from traceback import walk_tb

from echelon.agents.robot import Robot
from echelon.controller.node import TreeNode
from echelon.plan.plan import NodePlan, Plan, RobotPlan
from echelon.sim.parts.time_limit import TookTooLong, time_limit


def parts_of(plan: Plan, index: int) -> tuple[str, ...]:
    """Returns the users' parts that a role runs, as the scenario names them."""
    one = plan.all_roles[index]
    parts = []
    if isinstance(one, RobotPlan):
        parts = [one.model]
    elif isinstance(one, NodePlan):
        parts = [plan.law] if one.parent is not None else [plan.law, plan.trajectory]
    return tuple(part.use for part in parts if not part.is_own)


def runs_text(plan: Plan, index: int) -> str:
    """Returns words about the users' parts that a role runs, to follow its name; "" if there are none."""
    parts = parts_of(plan, index)
    return f", which runs {' and '.join(parts)}" if parts else ""


def unstalled(plan: Plan, instants: Iterator[int], seconds: float) -> Iterator[int]:
    """Yields the instants of a run in one process.

    If the plan has users' parts, raises TookTooLong when an instant takes longer than `seconds`."""
    if not any(parts_of(plan, one.index) for one in plan.formation):
        yield from instants
        return
    while True:
        with time_limit(seconds):
            time_ns = next(instants, None)
        if time_ns is None:
            return
        yield time_ns


def stalled_in(plan: Plan, error: TookTooLong) -> str:
    """Returns in words which part was running when an instant took too long."""
    for frame, _ in walk_tb(error.__traceback__):
        role = frame.f_locals.get("self")
        if isinstance(role, (Robot, TreeNode)):
            return f"{plan.all_roles[role.index].name}{runs_text(plan, role.index)}"
    return "a role that is not known"
