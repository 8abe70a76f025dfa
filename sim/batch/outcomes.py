"""From the scratch of runs to what was measured, in the terms of a summary (sim.results)."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import lcm
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from echelon.plan.plan import Plan
from echelon.sim.batch import records as r
from echelon.sim.results.settling import dwell_ns

Records = np.ndarray[Any, np.dtype[np.void]]
FRACTIONS: Final = (0.02, 0.05)
"""Of settling, as in a summary; the bands of claims follow them"""
TRACED: Final = ("x", "y", "theta", "v", "omega", "cos_theta", "sin_theta")
"""What a trace has of each robot: place [m], heading [rad], speed [m/s], yaw rate [rad/s], cos and sin of the heading"""

RUN_FIELDS: Final = np.dtype([
    ("seed", "i8"), ("diverged", "f8"), ("smallest", "f8"), ("closest_time", "f8"), ("pair", "i8", (2,)), ("violations", "i8"),
])  # fmt: skip
BLOCK_FIELDS: Final = np.dtype([
    (name, "f8")
    for name in (
        "start_error", "settling_2", "settling_5", "residual", "peak_error", "peak_time", "ise", "iae", "itae",
        "sooner", "earlier", "level",
    )
])  # fmt: skip
ROBOT_FIELDS: Final = np.dtype(
    [(name, "f8") for name in ("rms", "peak", "saturation_share", "saturated_after_first_second")]
)
LINK_FIELDS: Final = np.dtype(
    [(name, "i8") for name in ("sent", "delivered", "lost", "in_flight", "duplicates", "used", "held")]
    + [(name, "f8") for name in ("age_mean", "age_p50", "age_p95", "age_p99", "age_max")]
)


@dataclass(frozen=True, slots=True)
class BatchRuns:
    """What was measured of R runs of a plan.  Records have the names and units of a summary (docs/summary.schema.json); NaN
    stands for what is missing there: a block that did not settle, a number that is not finite."""

    plan: Plan
    runs: Records
    """(R,): `seed`; `diverged`, when a robot's state was not finite or beyond all bounds [s], NaN if never;
    `smallest` distance of two robots [m], their `pair` of indices and its `closest_time` [s]; number of `violations` of the
    avoidance radius"""
    blocks: Records
    """(R, blocks): as in `sim.results.records.BlockResult`; root mean squares of the amplitude in the last three sixths of the
    run [m]: `sooner`, `earlier` and `level` (`sim.results.ending.levels`)"""
    robots: Records
    """(R, robots): as in `sim.results.records.TorqueResult`"""
    links: Records
    """(R, links), in the order of `plan.links`: as in `sim.results.records.LinkResult`"""
    claims: NDArray[np.bool_]
    """(R, claims): whether each claim of the plan passed"""
    times: NDArray[np.float64]
    """(T,): instants of the traces [s]"""
    traces: NDArray[np.float64] | None
    """(R, T, robots, len(TRACED)): states at the instants that all robots share; None if they were not asked for"""
    mean_squares: NDArray[np.float64] | None
    """(T, blocks): E|e|², the mean over the runs of the squared error of each block [m²], infinite once a run has diverged;
    None if it was not asked for.  Where E|e|² grows though most runs settle, a few runs make most of the mean; then it takes
    many runs, and the standard error is too small with few"""
    mean_squares_error: NDArray[np.float64] | None
    """(T, blocks): standard error of this mean [m²]; NaN with one run, and where the mean is infinite"""


def fractions(plan: Plan) -> tuple[float, ...]:
    """Returns the fractions of the error at the start whose settling times are measured."""
    return (*FRACTIONS, *(claim.band for claim in plan.claims))


def late_sixths_ns(plan: Plan) -> tuple[int, int, int]:
    """Returns when each of the last three sixths of a run begins [ns]."""
    common_ns = lcm(*[robot.period_ns for robot in plan.robots])
    last_ns = plan.duration_ns // common_ns * common_ns
    return last_ns * 3 // 6, last_ns * 4 // 6, last_ns * 5 // 6


@dataclass(frozen=True, slots=True)
class Kept:
    """The places of results in a run's scratch: in `real` and in `whole`."""

    reals: NDArray[np.int64]
    wholes: NDArray[np.int64]

    @classmethod
    def of(cls, model: r.Model) -> "Kept":
        """Returns the places for a model, in the order in which `Outcomes` takes them."""
        run, marks = model.run[0], r.BLOCK_WHOLES + int(model.run["fractions"][0])
        reals = [at + number for at in model.blocks["measures_at"].tolist() for number in range(r.BLOCK_REALS)]
        reals += [at + number for at in model.robots["at"].tolist() for number in range(r.S_RIGHT, r.A_X)]
        wholes = [at + number for at in model.blocks["marks_at"].tolist() for number in range(marks)]
        wholes += [at + number for at in model.links["marks_at"].tolist() for number in r.COUNTS]
        wholes += [int(run["closest_at"]) + number for number in range(4)]
        return cls(np.array([*reals, int(run["distance_at"])]), np.array(wholes))


def outcomes(
    plan: Plan,
    model: r.Model,
    seeds: Sequence[int],
    lost_ns: NDArray[np.int64],
    reals: NDArray[np.float64],
    wholes: NDArray[np.int64],
    traces: NDArray[np.float64] | None,
    sums: NDArray[np.float64] | None,
) -> BatchRuns:
    """Returns what was measured, from the results `reals` and `wholes` of each run (`Kept`), and from the sums of |e|² and of
    |e|⁴ over the runs, (T, blocks, 2)."""
    count, common_ns = len(seeds), int(model.run["common_ns"][0])
    shapes = [(len(plan.blocks), r.BLOCK_REALS), (len(plan.robots), r.A_X - r.S_RIGHT)]
    of_blocks, of_robots, distance = _split(reals, shapes)
    shapes = [(len(plan.blocks), r.BLOCK_WHOLES + len(fractions(plan))), (len(plan.links), len(r.COUNTS))]
    marks, of_links, closest = _split(wholes, shapes)
    runs = np.zeros(count, dtype=RUN_FIELDS)
    runs["seed"], runs["violations"], runs["pair"] = seeds, closest[:, 3], closest[:, :2]
    runs["diverged"] = np.where(lost_ns < 0, np.nan, lost_ns / 1e9)
    several = len(plan.robots) > 1
    runs["smallest"] = np.sqrt(distance[:, 0]) if several else np.nan
    runs["closest_time"] = closest[:, 2] / 1e9 if several else np.nan
    end_ns = np.where(lost_ns < 0, plan.duration_ns, lost_ns) // common_ns * common_ns
    settling = _Settling(plan, of_blocks, marks, end_ns, common_ns)
    return BatchRuns(
        plan,
        runs,
        _blocks(of_blocks, marks, settling, _instants_of_sixths(plan, common_ns)),
        _robots(plan, of_robots),
        _links(plan, of_links),
        settling.claims(),
        np.arange(0, plan.duration_ns + 1, common_ns) / 1e9,
        traces,
        *((None, None) if sums is None else _means(sums, count)),
    )


def _means(sums: NDArray[np.float64], runs: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Returns mean and standard error, from the sums of a number of values and of their squares."""
    mean, square = np.moveaxis(sums, -1, 0) / runs
    with np.errstate(all="ignore"):
        return mean, _finite(np.sqrt(np.maximum(square - np.square(mean), 0.0) / (runs - 1)))


def _split(values: NDArray[Any], shapes: Sequence[tuple[int, int]]) -> Iterator[NDArray[Any]]:
    """Yields the parts of each run's results, (R, count, size), and then the rest."""
    at = 0
    for count, size in shapes:
        yield values[:, at : at + count * size].reshape(len(values), count, size)
        at += count * size
    yield values[:, at:]


def _finite(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.where(np.isfinite(values), values, np.nan)


@dataclass(frozen=True, slots=True)
class _Settling:
    """When blocks settled (sim.results.settling)."""

    plan: Plan
    of_blocks: NDArray[np.float64]
    marks: NDArray[np.int64]
    end_ns: NDArray[np.int64]
    """Last instant of each run, (R,)"""
    common_ns: int

    def settled_ns(self, block: int, fraction: int, dwell: float | None) -> NDArray[np.int64]:
        """Returns when a block settled to a fraction, (R,) [ns], or -1."""
        marks, start = self.marks[:, block], self.of_blocks[:, block, r.M_START]
        within_floor = ~(start > self.plan.health.floor)
        out_ns = np.where(within_floor, marks[:, r.M_OUT_FLOOR], marks[:, r.BLOCK_WHOLES + fraction])
        entered_ns = np.where(out_ns < 0, 0, out_ns + self.common_ns)
        wait_ns = dwell_ns(self.plan.blocks[block], self.plan.health.dwell if dwell is None else dwell)
        settled = (marks[:, r.M_FINITE] == 1) & (entered_ns <= self.end_ns) & (self.end_ns - entered_ns >= wait_ns)
        return np.where(settled, entered_ns, -1)

    def seconds(self, fraction: int) -> NDArray[np.float64]:
        """Returns when each block settled to a fraction, (R, blocks) [s], or NaN."""
        found = np.stack([self.settled_ns(block, fraction, None) for block in range(len(self.plan.blocks))], axis=1)
        return np.where(found < 0, np.nan, found / 1e9)

    def claims(self) -> NDArray[np.bool_]:
        """Returns whether each claim passed, (R, claims)."""
        plan = self.plan
        passed = np.ones((len(self.marks), len(plan.claims)), dtype=bool)
        # The last instant that all robots share may be one period before the end.
        end_ns = np.where(self.end_ns >= plan.duration_ns - plan.root.period_ns, plan.duration_ns, self.end_ns)
        for number, claim in enumerate(plan.claims):
            by_ns = round(claim.settled_by * 1e9)
            passed[:, number] = by_ns <= end_ns
            for at, block in enumerate(plan.blocks):
                if claim.block in ("*", block.name, block.layer):
                    found = self.settled_ns(at, len(FRACTIONS) + number, claim.dwell)
                    passed[:, number] &= (found >= 0) & (found <= by_ns)
        return passed


def _instants_of_sixths(plan: Plan, common_ns: int) -> dict[str, int]:
    """Returns the number of instants in each of the last three sixths of a run."""
    first = [-(-begin_ns // common_ns) for begin_ns in late_sixths_ns(plan)]
    counts = np.diff([*first, plan.duration_ns // common_ns + 1])
    return dict(zip(("sooner", "earlier", "level"), counts.tolist(), strict=True))


def _blocks(
    of_blocks: NDArray[np.float64], marks: NDArray[np.int64], settling: _Settling, sixths: dict[str, int]
) -> Records:
    blocks = np.zeros(of_blocks.shape[:2], dtype=BLOCK_FIELDS)
    places = {
        "start_error": r.M_START,
        "residual": r.M_LAST,
        "peak_error": r.M_PEAK,
        "ise": r.M_ISE,
        "iae": r.M_IAE,
        "itae": r.M_ITAE,
    }
    for name, place in places.items():
        blocks[name] = _finite(of_blocks[:, :, place])
    blocks["peak_time"] = marks[:, :, r.M_PEAK_NS] / 1e9
    for place, (name, instants) in enumerate(sixths.items(), r.M_SOONER):
        squares = np.where(marks[:, :, r.M_FINITE] == 1, of_blocks[:, :, place], np.nan)
        blocks[name] = _finite(np.sqrt(squares / max(1, instants)))
    blocks["settling_2"], blocks["settling_5"] = settling.seconds(0), settling.seconds(1)
    return blocks


def _robots(plan: Plan, of_robots: NDArray[np.float64]) -> Records:
    right, left, peak, saturated, late, periods = np.moveaxis(of_robots, 2, 0)
    inner = np.array([robot.period_ns // robot.torque_period_ns for robot in plan.robots])
    robots = np.zeros(peak.shape, dtype=ROBOT_FIELDS)
    with np.errstate(all="ignore"):
        robots["rms"] = _finite(np.sqrt((right + left) / 2 / np.maximum(periods, 1)))
        robots["saturation_share"] = _finite(saturated / np.maximum(periods, 1) / inner)
    robots["peak"], robots["saturated_after_first_second"] = _finite(peak), _finite(late)
    return robots


def _links(plan: Plan, of_links: NDArray[np.int64]) -> Records:
    sent, delivered, lost, duplicates, used, held, age_sum, age_max, *percentiles = np.moveaxis(of_links, 2, 0)
    prompt = np.array([link.prompt for link in plan.links], dtype=bool)
    links = np.zeros(sent.shape, dtype=LINK_FIELDS)
    links["sent"], links["lost"], links["used"], links["held"] = sent, lost, used, held
    links["duplicates"] = duplicates
    links["delivered"] = np.where(prompt, sent, delivered)
    links["in_flight"] = sent - lost - links["delivered"]
    links["age_mean"] = np.where(used > 0, age_sum / np.maximum(used, 1) / 1e9, np.nan)
    for name, age_ns in zip(("age_max", "age_p50", "age_p95", "age_p99"), (age_max, *percentiles), strict=True):
        links[name] = np.where(used > 0, age_ns / 1e9, np.nan)
    return links
