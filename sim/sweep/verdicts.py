"""The verdicts of batch runs: those that a single run of the same plan and seed gets (sim.results.checks), from its measures.

A run as a sweep sees it has no bus, no recording and no wall clock, so the checks that remain are `whole` and `finite`, claims,
`growth`, `end`, `distance` or `avoidance`, `saturation` and `messages`.  Of a run whose states are not finite nothing else is
judged but its claims.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from echelon.plan.link_plan import LinkPlan
from echelon.runtime.link import LinkCounts
from echelon.sim.batch.outcomes import BatchRuns
from echelon.sim.results.desired import Desired
from echelon.sim.results.ending import Reference, floors_of, growth_of, is_too_short, reference_of, spared_because
from echelon.sim.results.settling import dwell_ns
from echelon.sim.results.verdict import CAUSES, CLAIM, CheckResult

OF_MOTION: Final = ("growth", "end")
"""Checks of blocks, which are not made of a run whose states are not finite"""


@dataclass(frozen=True, slots=True)
class Word:
    """The verdict of a run in a word, and short reasons: names of what failed, with the block where there is one."""

    word: str
    reason: str = ""


def word_of(checks: Sequence[CheckResult], claimed: bool) -> Word:
    """Returns the verdict of a single run from its checks."""
    lost = any(check.name == "finite" and check.outcome == "failed" for check in checks)
    failed = [
        check
        for check in checks
        if check.outcome == "failed" or (check.name == CLAIM and check.outcome != "passed")
        if not (lost and check.name in OF_MOTION)
    ]
    return _word(
        [(check.name, check.about[0] if check.name in (CLAIM, *OF_MOTION) else "") for check in failed], claimed
    )


def _word(failed: Sequence[tuple[str, str]], claimed: bool) -> Word:
    if not failed:
        return Word("HOLDS" if claimed else "HEALTHY")
    ordered = sorted(failed, key=lambda one: one[0] not in CAUSES)
    return Word("FAILS", "; ".join(dict.fromkeys(f"{name} {about}".rstrip() for name, about in ordered)))


def words_of(runs: BatchRuns) -> list[Word]:
    """Returns the verdict of each run of a batch."""
    return _Judge(runs).words()


class _Judge:
    def __init__(self, runs: BatchRuns) -> None:
        self.runs, self.plan = runs, runs.plan
        self.times_ns = np.round(runs.times * 1e9).astype(np.int64)
        self.judged = [
            bool(block.size) and not is_too_short(self.times_ns, dwell_ns(block, self.plan.health.dwell))
            for block in self.plan.blocks
        ]
        self._floors: dict[bytes, dict[str, float]] = {}
        self._reference: Reference | None = None

    def words(self) -> list[Word]:
        plan, runs = self.plan, self.runs
        lost = ~np.isnan(runs.runs["diverged"])
        failed: dict[str, NDArray[np.bool_]] = {
            "whole": lost,
            "finite": lost,
            "distance": (runs.runs["violations"] > 0) & (not plan.avoidance.enabled),
            "avoidance": (runs.runs["violations"] > 0) & plan.avoidance.enabled,
            "saturation": self._saturated(),
            "messages": (runs.links["used"] == 0).any(axis=1),
        }
        growth, end = self._growth() & ~lost[:, None], self._ends_higher() & ~lost[:, None]
        off = plan.health.off
        bad = ~runs.claims.all(axis=1) | np.any([value for name, value in failed.items() if name not in off], axis=0)
        bad |= growth.any(axis=1) & ("growth" not in off)
        bad |= end.any(axis=1) & ("end" not in off)
        words = [_word((), bool(plan.claims))] * len(lost)
        for row in np.flatnonzero(bad).tolist():
            names = [(CLAIM, claim.block) for claim, ok in zip(plan.claims, runs.claims[row], strict=True) if not ok]
            names += [(name, "") for name in CAUSES if failed[name][row]]
            for name, of_blocks in (("growth", growth[row]), ("end", end[row])):
                names += [(name, block.name) for block, each in zip(plan.blocks, of_blocks, strict=True) if each]
            names += [(name, "") for name, value in failed.items() if name not in CAUSES and value[row]]
            words[row] = _word([one for one in names if one[0] not in off], bool(plan.claims))
        return words

    def _saturated(self) -> NDArray[np.bool_]:
        robots = self.plan.robots
        limited = [min(one.torque_limit, one.torque_rate_limit, one.wheel_speed_limit) < np.inf for one in robots]
        return np.asarray(((self.runs.robots["saturation_share"] > self.plan.health.saturation) & limited).any(axis=1))

    def _growth(self) -> NDArray[np.bool_]:
        """Returns whether the error of each block grows, (R, blocks): see `sim.results.ending`."""
        blocks, bound = self.runs.blocks, self.plan.health.growth
        with np.errstate(all="ignore"):
            suspected = (blocks["level"] > bound * blocks["earlier"]) & (blocks["level"] > self.plan.health.floor)
        suspected &= np.array(self.judged)
        for row, block in np.argwhere(suspected).tolist():
            found = blocks[row, block]
            level, earlier, sooner = (float(found[name]) for name in ("level", "earlier", "sooner"))
            floor = self._floor(row, block)
            spared = spared_because(level, earlier, sooner, floor, float(found["start_error"]), bound)
            suspected[row, block] = growth_of(level, earlier) > bound and not spared
        return np.asarray(suspected)

    def _ends_higher(self) -> NDArray[np.bool_]:
        """Returns whether each block ends with a larger error than it started with, (R, blocks)."""
        blocks = self.runs.blocks
        with np.errstate(all="ignore"):
            higher = (blocks["residual"] > blocks["start_error"]) & (blocks["residual"] > self.plan.health.floor)
        higher &= np.array(self.judged)
        for row, block in np.argwhere(higher).tolist():
            higher[row, block] = blocks["residual"][row, block] > self._floor(row, block)
        return np.asarray(higher)

    def _floor(self, row: int, block: int) -> float:
        """Returns the amplitude up to which a block of a run is not judged [m]."""
        links = self.runs.links[row]
        if self._reference is None:
            velocity = Desired(self.plan).sample(self.times_ns / 1e9)[:, 1]
            self._reference = reference_of(velocity, self.times_ns)
        key = links["age_mean"].tobytes() + links["age_max"].tobytes()
        if key not in self._floors:
            counts = [_counts(link, found) for link, found in zip(self.plan.links, links, strict=True)]
            self._floors[key] = floors_of(self.plan, self._reference, counts)
        return self._floors[key][self.plan.blocks[block].name]


def _counts(link: LinkPlan, found: Any) -> LinkCounts:
    """Returns the counts of a link with its ages; judging needs no more."""
    mean_ns, most_ns = (0.0 if np.isnan(found[name]) else 1e9 * float(found[name]) for name in ("age_mean", "age_max"))
    sent, delivered, lost, in_flight, used, held = (
        int(found[name]) for name in ("sent", "delivered", "lost", "in_flight", "used", "held")
    )
    return LinkCounts(
        link.source, link.receiver, link.channel, sent, delivered, lost, in_flight, used, held, mean_ns, round(most_ns)
    )
