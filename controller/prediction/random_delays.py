"""One link whose delays vary: the age of the message in use as a Markov chain (docs/architecture.md, 2.11).

All messages have independent delays d, and the link may lose some.  Let S_j = P(not there after j periods).  If the message in
use has the age a, none of those sent after it is there.  A period later that of age j <= a comes with the probability

    h_j = 1 - S_j/S_{j-1},   S_{-1} = 1

whatever happened before.  The newest one that comes is used, so the age is j with the probability h_j Π_{i<j} (1 - h_i), and
a + 1 if none comes.  Ages above the longest delay are one mode.
"""

from typing import Final

import numpy as np

from echelon.controller.prediction.gains import PredictionError
from echelon.messages import Channel
from echelon.plan.delay_tables import BITS, LOST, Z_BITS, DelayTrace, looked_up, looked_up_z
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, Plan

LONGEST: Final = 12
"""Longest delay that is treated [periods]"""
DRAWS: Final = 1 << 16
"""Draws of which the distribution of a delay is made"""


def varies(link: LinkPlan) -> bool:
    """Returns whether the delays of a link vary."""
    return link.delay_min_ns != link.delay_max_ns or link.delays is not None


def oldest(link: LinkPlan) -> int:
    """Returns the longest delay of a link in periods, rounded up."""
    return -(-link.delay_max_ns // link.period_ns)


def check_delays(plan: Plan, link: LinkPlan) -> None:
    """Raises PredictionError if the varying delays of a link cannot be treated exactly."""
    if any(node.event_driven for node in plan.nodes) or len({each.period_ns for each in plan.formation}) > 1:
        raise PredictionError("delays that vary are computed for time-driven nodes with equal periods")
    if link.channel is Channel.COMMAND and plan.robots[link.receiver].event_driven:
        raise PredictionError("commands whose delays vary are computed for time-driven robots")
    if isinstance(link.delays, DelayTrace) or link.fifo or link.duplicates or link.bursts or link.policy != "hold":
        raise PredictionError(
            "delays that vary are computed for independent delays, policy hold, without order and duplicates"
        )
    if link.delays is not None and link.delays.correlation:
        raise PredictionError("delays that vary are computed without correlation")
    if oldest(link) > LONGEST:
        raise PredictionError(f"delays that vary are computed up to {LONGEST} periods, and these take {oldest(link)}")


def of_delays(link: LinkPlan) -> Array:
    """Returns the chain (`Chances.chain`) of the age in use; with outcome k the message of age k is taken."""
    count = oldest(link)
    gone = np.array([_missing(link, age) for age in range(count + 1)])
    hazard = 1 - np.divide(gone, np.r_[1.0, gone[:-1]], out=np.zeros(count + 1), where=np.r_[1.0, gone[:-1]] > 0)
    modes = count + 2
    chain = np.zeros((count + 2, modes, modes))
    for age in range(modes):
        left = 1.0
        for newer in range(min(age, count) + 1):
            chain[newer, age, newer] = left * hazard[newer]
            left *= 1 - hazard[newer]
        chain[-1, age, min(age + 1, modes - 1)] += left
    return chain


def _missing(link: LinkPlan, periods: int) -> float:
    """Returns the probability that a message is not there so many periods after it was sent."""
    after_ns = periods * link.period_ns
    if link.delays is None:
        late = np.clip((link.delay_max_ns - after_ns) / (link.delay_max_ns - link.delay_min_ns), 0.0, 1.0)
    else:
        assert not isinstance(link.delays, DelayTrace)
        draws = (2 * np.arange(DRAWS, dtype=np.int64) + 1) << (BITS - 17)
        late = np.mean(looked_up(np.array(link.delays.delays_ns), draws) > after_ns)
    return float(link.loss + (1 - link.loss) * late)


def mean_delay_ns(link: LinkPlan) -> int:
    """Returns the mean delay of the messages of a link that are not lost [ns]."""
    if link.delays is None:
        return (link.delay_min_ns + link.delay_max_ns) // 2
    if isinstance(link.delays, DelayTrace):
        there = [each for each in link.delays.delays_ns if each != LOST]
        return round(float(np.mean(there))) if there else 0
    draws = (2 * np.arange(DRAWS, dtype=np.int64) + 1) << (BITS - 17)
    if link.delays.correlation:
        from scipy.special import ndtri  # takes long to import

        z = np.rint(ndtri((np.arange(DRAWS) + 0.5) / DRAWS) * (1 << Z_BITS)).astype(np.int64)
        return round(float(np.mean(looked_up_z(np.array(link.delays.delays_ns), z))))
    return round(float(np.mean(looked_up(np.array(link.delays.delays_ns), draws))))
