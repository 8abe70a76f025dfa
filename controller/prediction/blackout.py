"""What a blackout of links does to a run near its formation (docs/architecture.md, 2.11): exact, by the linear run itself.

In a blackout all that is sent on some links is lost; before and after it nothing is.  So the run is a sequence of linear maps.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from echelon.controller.prediction.cost import block_rows, registers_at_rest
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.mean_square import Losses, places_of
from echelon.controller.prediction.random_branches import mean
from echelon.controller.prediction.random_steps import Chances
from echelon.messages import Channel
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, Plan


@dataclass(frozen=True, slots=True)
class BlackoutEffect:
    """The error of one block in a run with a blackout."""

    name: str
    peak: float
    """Largest |e| from the beginning of the blackout on [m]"""
    peak_time: float
    """When it is so large [s of run time]"""
    recovery: float | None
    """How long after the blackout |e| comes to stay below what it was at its beginning [s]; 0 if it never exceeds that
    afterwards, None if it does to the end of the run"""
    errors: tuple[float, ...]
    """|e| at the beginning of each hyperperiod [m]"""


def blackout(
    plan: Plan, links: Sequence[LinkPlan] | Channel, at_ns: int, duration_ns: int
) -> tuple[BlackoutEffect, ...]:
    """Returns the errors of all blocks in a run of a plan from its start, in which all is lost that is sent on links from
    `at_ns` on for `duration_ns`.  `links` are some of `plan.links`, or the channel of all that rules apply to.

    Raises PredictionError if the plan loses other messages, if links have delays, or if nothing exact can be said, ValueError
    if the blackout does not begin within the run."""
    if not 0 <= at_ns <= plan.duration_ns or duration_ns < 0:
        raise ValueError(
            f"a blackout from {at_ns / 1e9:g} s on for {duration_ns / 1e9:g} s: must begin within the run's "
            f"{plan.duration_ns / 1e9:g} s, and not be negative"
        )
    if any(link.loss for link in plan.links):
        raise PredictionError("the plan has losses beside the blackout: its run is random")
    if any(link.delay_max_ns for link in plan.links):
        raise PredictionError("blackouts are computed for links without delay")
    places = places_of(plan, links)
    losses = Losses(plan, places, None)
    run = losses.run
    steps = plan.duration_ns // run.hyperperiod_ns
    if any(link.period_ns != run.hyperperiod_ns for link in (plan.links[at] for at in places)):
        raise PredictionError("blackouts are computed where the links have the period of the coordinator")
    channels = {plan.links[at].channel for at in places}
    whole = at_ns % run.hyperperiod_ns == duration_ns % run.hyperperiod_ns == 0
    if len(channels) > 1 and not whole and any(node.event_driven for node in plan.nodes):
        # a node that waits for what was lost acts at the end of its period, when the blackout may be over
        raise PredictionError(
            "a blackout of several channels is computed for event-driven nodes where it begins and ends at multiples of the "
            "coordinator's period"
        )
    x = registers_at_rest(losses, 0)[None, :, None]
    rows = block_rows(plan, losses)
    found = np.empty((steps + 1, len(rows)))
    dark, bright = (Chances.of(np.where(np.isin(np.arange(len(plan.links)), places), loss, 0.0)) for loss in (1.0, 0.0))
    for step in range(steps + 1):
        found[step] = rows @ x[0, :, 0]
        now_ns = step * run.hyperperiod_ns
        x = mean(run.steps, x, dark if at_ns <= now_ns < at_ns + duration_ns else bright)
    return tuple(
        effect(
            block.name,
            np.linalg.norm(found[:, block.offset : block.offset + block.size], axis=1),
            run.hyperperiod_ns,
            at_ns,
            at_ns + duration_ns,
        )
        for block in plan.blocks
        if block.size
    )


def effect(name: str, errors: Array, H_ns: int, begin_ns: int, end_ns: int) -> BlackoutEffect:
    """Returns the peak and the recovery of a block from its errors at multiples of the hyperperiod `H_ns`."""
    begin, end = (min(-(-each_ns // H_ns), len(errors) - 1) for each_ns in (begin_ns, end_ns))
    peak = begin + int(np.argmax(errors[begin:]))
    above = np.flatnonzero(errors[end:] > errors[begin])
    recovery: float | None = 0.0 if not len(above) else (above[-1] + 1) * H_ns * 1e-9
    if len(above) and end + above[-1] == len(errors) - 1:
        recovery = None
    return BlackoutEffect(name, float(errors[peak]), peak * H_ns * 1e-9, recovery, tuple(errors.tolist()))
