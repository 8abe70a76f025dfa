"""One robot alone, and how fast errors grow: in runs, and as predicted."""

import numpy as np

from echelon.controller.prediction.largest_delay import largest_extra_delay
from echelon.controller.prediction.linear_run import LinearRun, later
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.messages import Channel
from echelon.plan.plan import Array, Plan
from support.trees import plan_of, scenario


def single(T: float, lead: float = 0.0, k1: float = 1.0, k2: float = 1.0) -> Plan:
    """Returns one robot alone: all there is is the centroid, with σ = 1."""
    law = {"epsilon": [1.0], "lead": lead, "gains": [{"k1": k1, "k2": k2}]}
    return plan_of(
        scenario((None,), np.random.default_rng(1), duration=T, law=law, periods={"acceleration": T, "torque": T})
    )


def growth(norms: Array) -> float:
    """Returns the logarithm of the growth per tick over the second half of a run, by its largest values."""
    part = len(norms) // 8
    early, late = norms[4 * part : 5 * part].max(), norms[-part:].max()
    return float(np.log(late / early) / (len(norms) - 5 * part))


def radius_of(plan: Plan, delay_ticks: int = 0, channel: Channel = Channel.STATE) -> float:
    """Returns the predicted growth per period of the root, with all messages of a channel some of its periods later."""
    return spectral_radius(LinearRun(later(plan, channel, delay_ticks * plan.root.period_ns)).map())


def largest_delay_of(plan: Plan, channel: Channel = Channel.STATE) -> int | None:
    """Returns how many ticks later all messages of a channel may be."""
    return largest_extra_delay(plan, channel).ticks
