"""Makes a sweep: the runs that are not in its journal yet, the search for boundaries, and the tables at the end."""

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from itertools import islice
from math import inf
from pathlib import Path

from echelon import __version__
from echelon.sim.results.statistics import MomentGrowth, wilson
from echelon.sim.sweep.folder import open_folder, write
from echelon.sim.sweep.journal import Journal
from echelon.sim.sweep.origin import Point
from echelon.sim.sweep.preparing import Prepared, beside, draws
from echelon.sim.sweep.rows import Rows, blocks_of, channels_of
from echelon.sim.sweep.search import ALL, By, Found, Judged, Judgements, Search, judgements
from echelon.sim.sweep.study import Sweep
from echelon.sim.sweep.tables import Layout, PointFacts, growth_of_point, points_table, runs_table, values_text
from echelon.sim.sweep.work import Task, joined, runs_in_task
from echelon.sim.sweep.workers import Workers, make_workers

Show = Callable[[int, int, int], None]
"""Is told the numbers of finished runs, of all runs as far as they are known, and of those that were finished before"""


def run(
    prepared: Prepared,
    out: Path | None = None,
    workers: int | str | None = None,
    show: Show = lambda done, total, before: None,
) -> Sweep:
    """Makes the runs of a sweep that are not in its folder yet, and writes its tables; without a folder nothing is written.

    If it is interrupted (KeyboardInterrupt), the tables of what is finished are written.  Raises UserError, and OSError."""
    with ExitStack() as stack:
        if out is not None:
            stack.callback(os.close, open_folder(prepared, out))
        kept = Journal(out)
        stack.callback(kept.close)
        team = make_workers(prepared.engine, workers)
        stack.callback(team.close)
        made = _Run(prepared, kept, team, show)
        try:
            made.work()
        except BaseException:
            if out is not None and made.facts():
                write(made.result(out), out)
            raise
        result = made.result(out)
        if out is not None:
            write(result, out)
        return result


class _Run:
    """A sweep that goes on."""

    def __init__(self, prepared: Prepared, kept: Journal, workers: Workers, show: Show) -> None:
        self.prepared, self.kept, self.workers, self.show = prepared, kept, workers, show
        self.done = self.total = self.before = 0
        self.found: list[Found] = []
        self.points: dict[str, Point] = {}
        """All points that were tried, by the texts of their values"""

    def work(self) -> None:
        """Makes all runs that are not in the journal."""
        search = self.prepared.request.search
        if search is None:
            self._try(self.prepared.points)
        else:
            self._find(search)

    def _find(self, search: Search) -> None:
        """Searches at each point of the design; all searches go on together, so that all workers have work."""
        prepared, keys = self.prepared, [each.key for each in self.prepared.request.varied]
        runs = [search.run() for _ in prepared.points]
        known: list[dict[int, Judgements]] = [{} for _ in runs]
        asked = {at: next(each) for at, each in enumerate(runs)}
        bounds: dict[int, dict[By, tuple[int | None, int | None]]] = {}
        while asked:
            tried = {
                (at, number): beside(prepared.request.origin, keys, prepared.points[at], search, number)
                for at, numbers in asked.items()
                for number in numbers
            }
            self._try(list(tried.values()))
            for (at, number), point in tried.items():
                known[at][number] = self._judged(point)
            answers, asked = asked, {}
            for at, numbers in answers.items():
                try:
                    asked[at] = runs[at].send({number: known[at][number] for number in numbers})
                except StopIteration as end:
                    bounds[at] = end.value
        for at, point in enumerate(prepared.points):
            others = dict(zip(keys, point.values, strict=True))
            self.found += [search.found(by, known[at], bounds[at][by], others) for by in ALL]

    def _try(self, points: Sequence[Point]) -> None:
        """Makes the runs of some points."""
        self.points |= {values_text(point.values): point for point in points}
        tasks = {task.name: task for point in points for task in self._tasks(point)}
        there = sum(len(task.seeds) for name, task in tasks.items() if name in self.kept.done)
        self.total += sum(len(task.seeds) for task in tasks.values())
        self.done += there
        self.before += there
        self.show(self.done, self.total, self.before)
        for task, rows in self.workers.perform(task for name, task in tasks.items() if name not in self.kept.done):
            self.kept.add(task.name, rows)
            self.done += len(task.seeds)
            self.show(self.done, self.total, self.before)

    def _tasks(self, point: Point) -> Iterator[Task]:
        seeds, size = iter(self.prepared.seeds), runs_in_task(point.plan, self.prepared.engine)
        values = values_text(point.values)
        while some := tuple(islice(seeds, size)):
            name = f"{values} {some[0]}+{len(some)}"
            yield Task(name, point.plan, some, self.prepared.engine, point.scenario)

    def _facts(self, number: int, point: Point) -> PointFacts | None:
        """Returns a point with its finished runs; None if there are none."""
        tasks = [task for task in self._tasks(point) if task.name in self.kept.done]
        rows: list[Rows] = [self.kept.done[task.name] for task in tasks]
        seeds = tuple(seed for task in tasks for seed in task.seeds)
        return PointFacts(number, point.values, point.hash, joined(rows), seeds) if seeds else None

    def _judged(self, point: Point) -> Judgements:
        facts, plan, wanted = self._facts(0, point), point.plan, self.prepared.request.share
        assert facts is not None
        runs, holds = len(facts.seeds), sum(facts.rows["holds"])
        low, high = wilson(holds, runs) if draws(plan) else (holds / runs, holds / runs)
        good = holds >= wanted * runs
        share = Judged(good, low >= wanted if good else high < wanted)
        bound, judges = plan.health.growth**2, list[MomentGrowth]()
        for block in blocks_of(plan):
            growth = growth_of_point(facts, block)
            level = _rms(facts.rows.get(f"amplitude_last.{block}", []))
            if growth.ratio == inf or (growth.ratio == growth.ratio and level > plan.health.floor):
                judges.append(growth)
        if any(growth.ratio > bound for growth in judges):
            return judgements(share, Judged(False, any(growth.low > bound for growth in judges)))
        return judgements(share, Judged(True, all(growth.high <= bound for growth in judges)))

    def facts(self) -> list[PointFacts]:
        """Returns all points of which runs are finished, in the order of the tables."""
        points = self.prepared.points
        if self.prepared.request.search is not None:
            order = {values_text(point.values): at for at, point in enumerate(points)}
            points = sorted(
                self.points.values(), key=lambda point: (order[values_text(point.values[:-1])], point.values[-1])
            )
        found = (self._facts(number, point) for number, point in enumerate(points))
        return [each for each in found if each is not None]

    def result(self, out: Path | None) -> Sweep:
        """Returns the sweep as far as it is finished."""
        prepared = self.prepared
        plans = [point.plan for point in (*prepared.points, *self.points.values())]
        blocks, channels = (
            tuple(dict.fromkeys(name for plan in plans for name in names(plan))) for names in (blocks_of, channels_of)
        )
        layout = Layout(prepared.keys, blocks, channels, __version__, prepared.engine)
        facts = self.facts()
        return Sweep(
            scenario=prepared.nominal.scenario.name,
            layout=layout,
            seeds=prepared.seeds,
            design=prepared.request.kind if prepared.request.search is None else "find",
            runs=runs_table(layout, facts),
            points=points_table(layout, facts),
            find=tuple(self.found),
            folder=out,
        )


def _rms(values: Sequence[float]) -> float:
    return float((sum(value * value for value in values) / max(1, len(values))) ** 0.5)
