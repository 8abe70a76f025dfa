"""How much loss a run bears in the mean square (docs/architecture.md, 2.11).

The second moment X = E[x xᵀ] of the linear run with losses follows a linear map L.  Errors vanish in the mean square if and
only if the spectral radius of L is below 1 (Costa, Fragoso and Marques, *Discrete-Time Markov Jump Linear Systems*, 2005).

A run that holds says nothing about the mean square: near the boundary E|x|² grows while most runs decay.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from math import inf, log
from typing import Final, Literal

import numpy as np

from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_run import ruled_links
from echelon.controller.prediction.random_branches import moment
from echelon.controller.prediction.random_delays import of_delays, varies
from echelon.controller.prediction.random_run import Part, RandomRun
from echelon.controller.prediction.random_steps import Chances
from echelon.controller.prediction.second_moment import SecondMoment
from echelon.messages import Channel
from echelon.plan.delay_tables import Bursts
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, Plan

TRIED: Final = (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99)
"""Losses that are tried one after the other; between the last stable one and the first that is not, a finer search follows"""
NEARLY: Final = 0.999
"""The last loss that is tried, as a share of the one that cannot be reached"""
FINE: Final = 1e-5
"""How closely the boundary is found"""
ALIKE: Final = 1e-9
"""Relative difference up to which numbers of two parts count as equal"""
ALIKE_AT: Final = 0.3
"""Loss at which parts are compared"""
LARGEST: Final = 700
"""Number of registers of the largest part; a larger one is refused"""


@dataclass(frozen=True, slots=True)
class LossBoundary:
    """How many of their messages links may lose in the mean square."""

    loss: float | None
    """Every loss that was tried up to this one is stable; None: even without loss on these links the run is unstable"""
    ends: Literal["unstable", "limit"]
    """Why it is not more: more is unstable, or more has not been tried"""
    burst: float | None
    """Mean length of the bursts of losses [messages]; None: each message is lost by itself"""
    radius: float
    """Spectral radius of L with the largest loss of these links in the plan: E|x|² is multiplied by it in each hyperperiod"""


def mean_square(
    plan: Plan, links: Sequence[LinkPlan] | Channel, *, burst: float | None = None, largest: int = LARGEST
) -> LossBoundary:
    """Returns how many messages links of a plan may lose; other links are as in the plan.  `links` are some of `plan.links`, or
    the channel of all that rules apply to.

    With `burst` they lose messages in bursts of this mean length, none between bursts and all within them (Gilbert).  The time
    that it takes grows with the third power of the numbers that act on each other; `largest` is how many there may be.

    Raises PredictionError if nothing exact can be said of the plan, ValueError if there are no such links."""
    losses = Losses(plan, places_of(plan, links), burst, largest)
    at_own = losses.radius(losses.own)
    if losses.gain(0.0) >= 1:
        return LossBoundary(None, "unstable", burst, at_own)
    low = 0.0
    for high in (*(each for each in TRIED if each < NEARLY * losses.most), NEARLY * losses.most):
        if losses.gain(high) >= 1:
            return LossBoundary(_edge(losses.gain, low, high), "unstable", burst, at_own)
        low = high
    return LossBoundary(low, "limit", burst, at_own)


class Losses:
    """The linear run of a plan, with the loss of some links as a variable."""

    def __init__(self, plan: Plan, varied: Iterable[int], burst: float | None, largest: int = LARGEST) -> None:
        """`varied` are places in `plan.links`; with `burst` all of them lose the same messages, in bursts.  `largest` is how
        many numbers may act on each other.

        Raises PredictionError if nothing exact can be said."""
        self._varied, self._burst = sorted(varied), burst
        self._others = np.array([link.loss for link in plan.links])
        self.own = float(self._others[self._varied].max(initial=0.0))
        """The largest loss of these links in the plan"""
        self.most = 1.0 if burst is None else most_lost(burst)
        """The loss that they cannot reach"""
        lossy, chained = {*np.flatnonzero(self._others).tolist(), *self._varied}, list[int]()
        if burst is not None:
            lossy, chained = lossy - {*self._varied}, self._varied
        in_bursts = [at for at in lossy - {*self._varied} if plan.links[at].bursts]
        varying = [at for at, link in enumerate(plan.links) if varies(link)]
        if varying and (len(varying) > 1 or in_bursts or chained or varying[0] in self._varied):
            raise PredictionError(
                "delays that vary are computed on one link, without losses in bursts and with its own loss"
            )
        check_together(plan, [*in_bursts, *chained])
        check_broadcasts(plan, frozenset(self._varied))
        self._chain = None
        if varying:
            self._chain = of_delays(plan.links[varying[0]])
            lossy, chained = lossy - {*varying}, varying
        if in_bursts:
            self._chain = of_bursts(plan.links[in_bursts[0]])
            lossy, chained = lossy - {*in_bursts}, in_bursts
        self.run = RandomRun(plan, lossy, chained)
        self.parts = self.run.parts()
        if (count := max(len(part.registers) for part in self.parts)) > largest:
            raise PredictionError(
                f"{count} numbers act on each other, among them those under way on late links; losses are computed with up "
                f"to {largest}"
            )
        self._different = different(self.parts, self.chances(ALIKE_AT))

    def gain(self, loss: float) -> float:
        """Returns a number that is below 1 if and only if errors vanish in the mean square."""
        return max(SecondMoment(part, self.chances(loss)).gain() for part in self._different)

    def radius(self, loss: float) -> float:
        """Returns the spectral radius of L."""
        return max(SecondMoment(part, self.chances(loss)).radius() for part in self._different)

    def chances(self, loss: float) -> Chances:
        """Returns the chances with this loss on the links that are varied."""
        if self._burst is not None:
            return Chances.of(self._others, gilbert(loss, self._burst))
        losses = self._others.copy()
        losses[self._varied] = loss
        return Chances.of(losses, self._chain)


def check_broadcasts(plan: Plan, varied: frozenset[int]) -> None:
    """Raises PredictionError if a message that is lost for all receivers at once would be lost with different probabilities."""
    losses: dict[tuple[int, Channel], set[float | None]] = {}
    for at, link in enumerate(plan.links):
        if link.loss_of_message:
            losses.setdefault((link.source, link.channel), set()).add(None if at in varied else link.loss)
    for (_, channel), found in losses.items():
        if len(found) > 1:
            raise PredictionError(
                f"{channel.name.lower()} messages are lost for all receivers at once: all their links must have the same loss"
            )


def check_together(plan: Plan, chained: Sequence[int]) -> None:
    """Raises PredictionError if links with bursts do not lose the same messages: each would have modes of its own."""
    links = [plan.links[at] for at in chained]
    if len(links) > 1 and (
        len({(link.source, link.channel, link.bursts) for link in links}) > 1
        or not all(link.loss_of_message for link in links)
    ):
        raise PredictionError(
            "several links have bursts of their own: their boundary is exact for one link, or for one broadcast that is "
            "lost for all receivers at once"
        )


def most_lost(burst: float) -> float:
    """Returns the share of messages that is lost if a burst of this mean length [messages] follows each message that comes."""
    return burst / (1 + burst)


def bursts_of(loss: float, burst: float) -> Bursts:
    """Returns the chain of a link that loses all messages in bad times and none in good ones (Gilbert).

    `burst` is the mean length of a bad time [messages], `loss` the share of messages that are lost, up to `most_lost`."""
    to_good = 1 / burst
    return Bursts(to_bad=min(1.0, to_good * loss / (1 - loss)), to_good=to_good, loss_good=0.0, loss_bad=1.0)


def gilbert(loss: float, burst: float) -> Array:
    """Returns the chain (`Chances.chain`) of a link with `bursts_of` this loss and mean length."""
    return _chain(bursts_of(loss, burst))


def of_bursts(link: LinkPlan) -> Array:
    """Returns the chain of a link with bursts: its modes are good and bad; with outcome 0 a message comes."""
    assert link.bursts is not None
    return _chain(link.bursts)


def _chain(bursts: Bursts) -> Array:
    step = np.array([[1 - bursts.to_bad, bursts.to_bad], [bursts.to_good, 1 - bursts.to_good]])
    lost = np.array([[bursts.loss_good], [bursts.loss_bad]])
    return np.stack([(1 - lost) * step, lost * step])


def different(parts: Sequence[Part], chances: Chances) -> list[Part]:
    """Returns parts, each of those that are alike once: parts that take an X of random numbers to the same X."""
    found: list[tuple[Part, Array]] = []
    for part in parts:
        size = len(part.registers)
        X = np.random.default_rng(size).normal(size=(chances.modes, size, size))
        after = moment(part.steps, X, chances)
        if not any(other.shape == after.shape and np.allclose(other, after, rtol=ALIKE, atol=0) for _, other in found):
            found.append((part, after))
    return [part for part, _ in found]


def _edge(gain: Callable[[float], float], low: float, high: float) -> float:
    """Returns where a gain passes 1 between a loss where it is below 1 and one where it is not."""
    at_low, at_high = gain(low), gain(high)
    while high - low > FINE:
        share = 0.5
        if at_low > 0 and at_high < inf:
            share = min(max(log(at_low) / (log(at_low) - log(at_high)), 0.05), 0.95)
        middle = low + share * (high - low)
        at = gain(middle)
        if at < 1:
            low, at_low = middle, at
        else:
            high, at_high = middle, at
    return low


def places_of(plan: Plan, links: Sequence[LinkPlan] | Channel) -> list[int]:
    """Returns the places of links in `plan.links`."""
    some = ruled_links(plan, links) if isinstance(links, Channel) else links
    found = [at for at, link in enumerate(plan.links) if any(link is each for each in some)]
    if not found:
        raise ValueError("there are no such links in the plan")
    return found
