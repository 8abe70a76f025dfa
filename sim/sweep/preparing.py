"""Prepares a sweep: makes its points and checks everything that can be wrong, before any run begins."""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from echelon import __version__
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_run import LinearRun, untreated
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.errors import UsageError
from echelon.plan.delay_tables import DelayTrace
from echelon.plan.plan import Plan
from echelon.sim.batch.refusals import gpu_refusal, refusal
from echelon.sim.forecast.motion import asked_of, torque_loop_diverges
from echelon.sim.forecast.verdict import verdict_warnings
from echelon.sim.results.statistics import runs_needed, wilson
from echelon.sim.sweep.design import Kind, design
from echelon.sim.sweep.origin import Origin, Point
from echelon.sim.sweep.search import Search
from echelon.sim.sweep.study import FORMAT
from echelon.sim.sweep.tables import values_text
from echelon.sim.sweep.values import Vary
from echelon.sim.sweep.work import ENGINES, EngineName

SHARE: Final = 0.9
"""Share of runs that must hold for a point to hold, unless another one is asked for"""
FIND_SEEDS: Final = 64
"""Number of seeds at each point of a search over links that draw random numbers"""


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """What is asked for; see `echelon sweep --help`."""

    origin: Origin
    varied: tuple[Vary, ...] = ()
    kind: Kind = "grid"
    samples: int = 0
    """Number of points of a random or Sobol' design"""
    search: Search | None = None
    share: float = SHARE
    seeds: int | None = None
    """None: one, or `FIND_SEEDS` for a search over random links"""
    engine: EngineName | None = None
    """None: `batch` where it can, otherwise `inprocess`"""
    allow_unstable: bool = False


@dataclass(slots=True)
class Prepared:
    """A sweep that can begin: everything that can be checked has been checked."""

    request: Request
    nominal: Point
    points: list[Point]
    """The points of the design; of a search, what varies beside it"""
    engine: EngineName
    seeds: tuple[int, ...]
    notes: list[str] = field(default_factory=list)
    """What the user should know before the runs begin, a line each"""

    @property
    def keys(self) -> tuple[str, ...]:
        """All keys that vary, in the order of the columns."""
        search = self.request.search
        return (*(each.key for each in self.request.varied), *(() if search is None else (search.key,)))

    def spec(self) -> dict[str, Any]:
        """Returns what must be the same for runs to belong to the same sweep."""
        search = self.request.search
        return {
            "format": FORMAT,
            "version": __version__,
            "scenario": self.nominal.scenario.name,
            "hash": self.nominal.hash,
            "engine": self.engine,
            "design": self.request.kind,
            "keys": [each.key for each in self.request.varied],
            "points": [json.loads(values_text(point.values)) for point in self.points],
            "hashes": [point.hash for point in self.points],
            "seeds": [self.seeds[0], len(self.seeds)],
            "find": None
            if search is None
            else {
                "key": search.key,
                "low": str(search.span.low),
                "high": str(search.span.high),
                "step": str(search.span.step),
                "share": self.request.share,
            },
        }


def prepare(request: Request) -> Prepared:
    """Checks a request and makes its points.  Raises UserError for any mistake."""
    if request.seeds is not None and not 0 < request.seeds <= 100_000_000:
        raise UsageError(f"--seeds {request.seeds}: must be a number of runs at each point, at least 1")
    if not 0 < request.share <= 1:
        raise UsageError(f"--share {request.share:g}: must be more than 0 and at most 1")
    search, keys = request.search, [each.key for each in request.varied]
    if search is not None and search.key in keys:
        raise UsageError(f"--find {search.key}: is varied, too")
    nominal = request.origin.point()
    points = [
        request.origin.point(keys, values)
        for values in design(request.kind, request.varied, request.samples, nominal.plan.seed)
    ]
    tried = points
    if search is not None:
        ends = (0, search.span.steps // 2, search.span.steps)
        tried = [beside(request.origin, keys, point, search, number) for point in points for number in ends]
    if not request.allow_unstable and (why := unstable(nominal.plan)):
        raise UsageError(
            f"{request.origin.name}: {why}, before any value is varied; --allow-unstable sweeps all the same"
        )
    engine, why_not = _engine(request.engine, [point.plan for point in tried])
    random = any(draws(point.plan) for point in tried)
    count = request.seeds or (FIND_SEEDS if search is not None and random else 1)
    notes = [f"engine inprocess: {why_not}"] if why_not else []
    if not random and count > 1:
        notes.append("no link draws random numbers: all seeds give the same run")
        count = 1 if search is not None else count
    if search is not None and random and (needed := runs_needed(request.share)) > count:
        best = 100 * wilson(count, count)[0]
        notes.append(
            f"--seeds {count}: even if all runs hold, the share is sure to be {best:.3g} % only; "
            f"--share {request.share:g} can be shown with {needed} seeds or more"
            if request.share < 1
            else "--share 1: no number of runs shows that all runs hold"
        )
    if engine == "batch":
        from echelon.sim.batch.compiled import is_kept  # the compiler, which takes long to import

        if not is_kept():
            notes.append("the batch engine is compiled now: once on this machine, for about half a minute")
    if engine == "gpu":
        from echelon.sim.batch.gpu import is_kept as is_kept_for_gpu

        if not is_kept_for_gpu():
            notes.append("the batch engine is compiled for the GPU now: once on this machine, for about a minute")
    notes += [note for note in verdict_warnings(nominal.plan) if "claims" not in note or search is None]
    seeds = tuple(range(nominal.plan.seed, nominal.plan.seed + count))
    return Prepared(request, nominal, points, engine, seeds, notes)


def unstable(plan: Plan) -> str | None:
    """Returns why a plan cannot settle; None if it does, or if nothing exact can be said."""
    asked = asked_of(plan)
    if torque_loop_diverges(plan, asked):
        return "the torque loop of a robot diverges (echelon validate says which)"
    if asked.diverges_s is not None:
        return f"its motion diverges within {asked.diverges_s:.3g} s (echelon validate)"
    try:
        if untreated(plan) or (radius := spectral_radius(LinearRun(plan).map())) < 1:
            return None
    except PredictionError:
        return None
    return f"is unstable (spectral radius {radius:.6g}, echelon analyse)"


def draws(plan: Plan) -> bool:
    """Returns whether random numbers decide anything in a run of a plan."""
    return plan.can.closed or any(
        link.loss > 0 or link.duplicates > 0 or not (link.steady or isinstance(link.delays, DelayTrace))
        for link in plan.links
    )


def _engine(asked: EngineName | None, plans: Iterable[Plan]) -> tuple[EngineName, str]:
    """Returns the engine, and why it is not the batch engine if nobody asked for another one.  Raises UsageError."""
    if asked is not None and asked not in ENGINES:
        raise UsageError(f"engine = {asked!r}: must be {', '.join(ENGINES)}")
    if asked in ("inprocess", "processes"):
        return asked, ""
    why = next((why for plan in plans if (why := refusal(plan))), None)
    if why is None and asked == "gpu":
        why = gpu_refusal()
    if why is None:
        return asked or "batch", ""
    if asked is not None:
        raise UsageError(why)
    return "inprocess", why.partition("; use ")[0]


def beside(origin: Origin, keys: Sequence[str], point: Point, search: Search, number: int) -> Point:
    return origin.point([*keys, search.key], [*point.values, search.value(number)], "--find")
