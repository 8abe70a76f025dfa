"""Warnings about the law and its periods: time scales near the period, and a loop that does not settle as it is sampled."""

from typing import Final

from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_run import LinearRun
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.plan.plan import Plan

FEWEST: Final = 5
"""Periods that a time scale should last: with fewer the law acts on what has long changed"""

LARGE: Final = 2000
"""Size of the run's map up to which it is computed: a warning must not take long"""


def sampling_warnings(plan: Plan) -> list[str]:
    """Returns a line if time scales are near the period, and one if the loop with its links does not settle.

    Of laws that are not linear, of links that lose messages or have delays that vary, and of very long delays, only the first
    is said."""
    found = _near_the_period(plan)
    try:
        run = LinearRun(plan)
    except PredictionError:
        return found
    if run.size <= LARGE and spectral_radius(run.map()) >= 1:
        found.append("law: with these periods and links the formation does not settle (`echelon analyse` says more)")
    return found


def _near_the_period(plan: Plan) -> list[str]:
    """Returns a line if time scales are near the period of their node: about the one that is nearest."""
    periods = {
        block.name: (plan.root if block.node is None else plan.formation[block.node]).period_ns / 1e9
        for block in plan.blocks
    }
    near = [block for block in plan.blocks if block.size and block.sigma < FEWEST * periods[block.name] * (1 - 1e-9)]
    if not near:
        return []
    worst = min(near, key=lambda block: block.sigma / periods[block.name])
    period_s, of = periods[worst.name], f" (the shortest of {len(near)})" if len(near) > 1 else ""
    times = f"{worst.sigma / period_s:.2g} × the period of {period_s:g} s"
    return [f"law.epsilon: σ of {worst.name}{of} is {worst.sigma:g} s, {times}; it should be {FEWEST} × that at least"]
