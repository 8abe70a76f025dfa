"""What the batch engine cannot run."""

from collections.abc import Iterator
from dataclasses import fields
from typing import Final

from echelon.agents.plant import Hill, Paper, RigidBody
from echelon.controller.laws import Integral, Linear, TerminalSliding
from echelon.controller.trajectory import Circle, Line, Sine, Waypoints
from echelon.plan.plan import Plan

KINDS: Final = {
    "law": (Linear, Integral, TerminalSliding),
    "trajectory": (Line, Circle, Sine, Waypoints),
    "plant": (Paper, RigidBody, Hill),
}


_LINK: Final = frozenset({
    "source", "receiver", "channel", "period_ns", "delay_min_ns", "delay_max_ns", "loss", "timeout_ns", "first_ns", "size",
    "punctual", "name", "policy", "delays", "bursts", "loss_of_message", "duplicates", "fifo", "blackouts", "source_clock",
    "receiver_clock",
})  # fmt: skip
"""What this engine knows of a link"""


def refusal(plan: Plan) -> str | None:
    """Returns why this engine cannot run a plan, and which engine can; None if it can."""
    return next((f"{why}; use --engine inprocess" for why in _reasons(plan)), None)


def gpu_refusal() -> str | None:
    """Returns why this engine finds no GPU here, and what does the same; None if it finds one."""
    try:
        from echelon.sim.batch.gpu import why_not
    except ImportError:
        return "engine gpu needs numba-cuda: pip install 'echelon[gpu]'; --engine batch makes the same runs on the processor"
    why = why_not()
    return why and f"engine gpu: {why}; --engine batch makes the same runs on the processor"


def _reasons(plan: Plan) -> Iterator[str]:
    if plan.can.closed:
        yield "can.path = 'closed': the batch engine has no bus and no drives"
    parts = [("law", plan.law), ("trajectory", plan.trajectory), *(("plant", robot.model) for robot in plan.robots)]
    for kind, part in parts:
        if type(part.made) not in KINDS[kind]:
            yield f"{part.use}: the batch engine can run only a {kind} that is built in"
    for link in plan.links:
        for field in fields(link):
            if field.name not in _LINK and getattr(link, field.name) != field.default:
                yield f"links: the batch engine does not know {field.name}"
