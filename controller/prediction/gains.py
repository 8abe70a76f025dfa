"""The gains of a plan's law, if it is linear, and the poles of a block alone with these gains."""

import numpy as np
from numpy.typing import NDArray

from echelon.controller.laws.law import Law, LinearGains, law_block
from echelon.plan.plan import BlockPlan, Plan


class PredictionError(ValueError):
    """No exact prediction is possible for a run; the text says why."""


def linear_gains(plan: Plan, block: BlockPlan, lead: float | None = None) -> LinearGains:
    """Returns the gains of a block as they act, with the plan's `lead`, or with the given one [periods].

    Raises PredictionError if the plan's law is not linear."""
    law: Law = plan.law.made
    gains = law.linear(law_block(plan, block, lead))
    if gains is None:
        raise PredictionError(
            f"law.use = {plan.law.use!r}: is not linear, and what is computed here holds for linear laws"
        )
    return gains


def poles(gains: LinearGains) -> NDArray[np.complex128]:
    """Returns the poles [1/s] of a block alone, in continuous time and without delay: ë = -K_1 e - K_2 ė - K_i ∫e dt."""
    n = len(gains.K_1)
    zero, unit = np.zeros((n, n)), np.eye(n)
    if not gains.K_i.any():
        return np.linalg.eigvals(np.block([[zero, unit], [-gains.K_1, -gains.K_2]])).astype(complex)
    rows = [[zero, unit, zero], [-gains.K_1, -gains.K_2, -gains.K_i], [unit, zero, zero]]
    return np.linalg.eigvals(np.block(rows)).astype(complex)
