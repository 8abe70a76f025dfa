"""What a worker of a sweep does: some runs of one plan, with one of the engines."""

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import gcd
from pathlib import Path
from typing import Final, Literal

from echelon.errors import PartRunError
from echelon.plan.plan import Plan
from echelon.runtime.admission import rows_within
from echelon.scenario.tables import Scenario
from echelon.sim.engines.in_process import Engine
from echelon.sim.processes.ends_at import EndsAt
from echelon.sim.results.records import RunFacts
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import TraceBuilder
from echelon.sim.sweep.rows import Rows, row_of_run, rows_of_batch

EngineName = Literal["batch", "gpu", "inprocess", "processes"]
ENGINES: Final[tuple[EngineName, ...]] = ("batch", "gpu", "inprocess", "processes")
_COST_S: Final = {"batch": 0.25e-6, "gpu": 2e-9, "inprocess": 16e-6, "processes": 1.0}
"""Time that a robot takes for a period, of a processor or, with many runs at once, of the GPU, roughly [s]"""
_TASK_S: Final = {"batch": 0.5, "gpu": 4.0, "inprocess": 2.0, "processes": 0.0}
"""How long a task may take, roughly [s]: what is lost if the sweep is killed"""
MOST_RUNS: Final = {"batch": 256, "gpu": 65_536, "inprocess": 256, "processes": 256}
"""Largest number of runs in a task"""


@dataclass(frozen=True, slots=True)
class Task:
    """Runs of one plan with some seeds."""

    name: str
    """Tells the task from all other tasks of the sweep"""
    plan: Plan
    seeds: tuple[int, ...]
    engine: EngineName
    scenario: Scenario
    """The scenario of the plan"""


def runs_in_task(plan: Plan, engine: EngineName) -> int:
    """Returns how many runs a task of this plan has.  It depends on nothing else, so tasks are the same with any workers."""
    periods = plan.duration_ns // gcd(*[robot.period_ns for robot in plan.robots]) + 1
    cost_s = _COST_S[engine] * periods * len(plan.robots)
    return max(1, min(MOST_RUNS[engine], round(_TASK_S[engine] / cost_s)))


def work(task: Task) -> Rows:
    """Makes the runs of a task; returns their rows in the order of the seeds."""
    if task.engine in ("batch", "gpu"):
        from echelon.sim.batch.batch import Device, run_many

        device: Device = "gpu" if task.engine == "gpu" else "processor"
        return rows_of_batch(run_many(task.plan, task.seeds, device=device, threads=1, say=lambda text: None))
    run = _in_process if task.engine == "inprocess" else _as_processes
    return joined([run(task.scenario, replace(task.plan, seed=seed)) for seed in task.seeds])


def joined(parts: Sequence[Rows]) -> Rows:
    """Returns rows one after the other; all have the same columns."""
    return {name: [value for part in parts for value in part[name]] for name in parts[0]} if parts else {}


def _in_process(scenario: Scenario, plan: Plan) -> Rows:
    """Makes one run in this process, without a recording; it ends where one as processes does."""
    builder, failure, stopped = TraceBuilder(plan), None, None
    engine = Engine(plan, builder.add)
    try:
        for time_ns in engine.instants():
            last = builder.last()
            if last is not None and not rows_within(last[1]).all():
                stopped = f"stopped at t = {time_ns / 1e9:g} s: a state is not finite, or beyond all bounds"
                break
    except PartRunError as error:
        failure = str(error)
    trace = builder.build()
    facts = RunFacts("inprocess", "virtual", None, None, None, None, engine.messages, failure, stopped)
    return row_of_run(trace, summarise(trace, engine.link_counts(), None, facts))


def _as_processes(scenario: Scenario, plan: Plan) -> Rows:
    """Makes one run as processes, in a folder that is deleted afterwards.

    As with the other engines, an error that grows slowly does not end it, since the table tells how far it grows."""
    from echelon.sim.launch import Launch, launch  # takes long to import

    can = None if plan.can.closed else "none"
    with tempfile.TemporaryDirectory(prefix="echelon-sweep-") as folder:
        options = Launch(
            engine="processes", out=Path(folder), can=can, report=False, quiet=True, ends_at=EndsAt.UNBOUNDED
        )
        run = launch(scenario.model_copy(update={"seed": plan.seed}), plan, options)
        return row_of_run(run.trace, run.summary)
