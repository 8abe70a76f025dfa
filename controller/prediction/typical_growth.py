"""How a typical run with losses grows, beside its second moment (docs/architecture.md, 2.11).

    γ = lim (1/n) ln |x_n|        the same for almost all runs (Furstenberg and Kesten)

Where γ < 0 almost every run decays.  E|x|² may grow nevertheless, carried by rare runs.  γ is estimated: random states are
followed through random hyperperiods.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from echelon.controller.prediction.mean_square import Losses, places_of
from echelon.controller.prediction.random_branches import sample
from echelon.messages import Channel
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan

RUNS: Final = 64
"""Runs that are followed"""
SETTLED: Final = 0.2
"""Share of the hyperperiods that are left out at the beginning"""


@dataclass(frozen=True, slots=True)
class TypicalGrowth:
    """The growth of a typical run, an estimate."""

    rate: float
    """γ [1/hyperperiod]"""
    error: float
    """Its standard error"""


def typical_growth(
    plan: Plan, links: Sequence[LinkPlan] | Channel, loss: float, *, hyperperiods: int = 1000, seed: int = 0
) -> TypicalGrowth:
    """Returns how a typical run of a plan grows if links lose this share of their messages, each by itself.

    Raises PredictionError if the plan's losses cannot be treated, ValueError if there are no such links."""
    losses = Losses(plan, places_of(plan, links), None)
    chances, random = losses.chances(loss), np.random.default_rng(seed)
    first = round(SETTLED * hyperperiods)
    found = []
    for part in losses.parts:
        x = random.normal(size=(len(part.registers), RUNS))
        modes = random.choice(chances.modes, RUNS, p=chances.stationary())
        grown = np.zeros(RUNS)
        for step in range(hyperperiods):
            x, modes, _ = sample(part.steps, x, modes, chances, random)
            size = np.linalg.norm(x, axis=0)
            x /= size
            if step >= first:
                grown += np.log(size)
        rates = grown / (hyperperiods - first)
        found.append(TypicalGrowth(float(rates.mean()), float(rates.std(ddof=1) / np.sqrt(RUNS))))
    return max(found, key=lambda each: each.rate)
