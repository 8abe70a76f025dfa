"""When the error of each block settles, predicted without a run: from the scenario's start, by the linear run
(docs/architecture.md, 2.7), judged as errors of a run are (6.4)."""

from dataclasses import dataclass

import numpy as np

from echelon.controller.prediction.linear_run import lags
from echelon.controller.prediction.modes import MOST, linear_errors
from echelon.plan.plan import Plan
from echelon.sim.results.block_series import BlockSeries
from echelon.sim.results.settling import settle

FRACTION = 0.02
"""The band, as a share of the error that a block starts with"""


@dataclass(frozen=True, slots=True)
class PredictedSettling:
    """When the error of a block settles."""

    block: str
    band: float
    """[m]"""
    settled: float | None
    """[s]; None if it does not settle within the scenario's duration"""


def predicted_settling(plan: Plan) -> tuple[PredictedSettling, ...]:
    """Returns when the error of each block settles; empty for more than `MOST` robots, and where a moving formation lags
    (`linear_run.lags`).

    Raises PredictionError as `LinearRun` does."""
    if len(plan.robots) > MOST or lags(plan):
        return ()
    times_ns, errors = linear_errors(plan)
    found = []
    for block in plan.blocks:
        if not block.size:
            continue
        e = errors[:, block.offset : block.offset + block.size]
        with np.errstate(all="ignore"):
            series = BlockSeries(block, e, e, e, e, e, np.sqrt(np.square(e).sum(axis=1)))
        settling = settle(plan, series, times_ns, FRACTION)
        settled_ns = settling.settled_ns
        found.append(PredictedSettling(block.name, settling.band, None if settled_ns is None else settled_ns / 1e9))
    return tuple(found)
