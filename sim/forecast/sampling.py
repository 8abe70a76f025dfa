"""Warnings about the law and its periods: time scales near the period, and a control loop that does not settle."""

from typing import Final

from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_run import LinearRun
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.plan.plan import Plan

FEWEST: Final = 5
"""A time scale should be at least this number of periods; else the state changes too much between two accelerations"""

LARGE: Final = 2000
"""Largest size of the map of a hyperperiod whose spectral radius is computed; a larger one takes too long for a warning"""


def sampling_warnings(plan: Plan) -> list[str]:
    """Returns a line if time scales are near the period, and one if the control loop with its links does not settle.

    The second is computed only for linear laws, links without loss, and constant delays that are not very long."""
    found = _near_the_period(plan)
    try:
        run = LinearRun(plan)
    except PredictionError:
        return found
    if run.size <= LARGE and spectral_radius(run.map()) >= 1:
        found.append("law: with these periods and links the formation does not settle (`echelon analyse` says more)")
    return found


def _near_the_period(plan: Plan) -> list[str]:
    """Returns a line if time scales are near the period of their node; it names the one that is nearest."""
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
