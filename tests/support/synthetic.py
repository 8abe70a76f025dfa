"""A run with known numbers: the paper's plan with errors that decay exponentially, each layer with its own time constant."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echelon import shipped
from echelon.bridge.reports import BusReport, CanReport
from echelon.controller.trajectory import make_trajectory, sample
from echelon.controller.transformation import Transformation
from echelon.messages import STATE_FIELDS
from echelon.plan.plan import BlockPlan, Plan
from echelon.runtime.link import LinkCounts
from echelon.scenario.tables import Scenario
from echelon.sim.parts.loading import load
from echelon.sim.results.records import ClaimResult, RunFacts
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import Trace

PAPER = shipped.FOLDER / "paper.toml"
DECAY = {"intra": 0.02, "inter": 0.2, "centroid": 2.0}
"""Time constants of the errors by layer [s]"""
PINNED = (
    "duration=12.0",
    "periods={acceleration=0.001, torque=0.0001}",
    "avoidance={enabled=false, avoidance_radius=0.5, sensing_radius=3.0}",
    "can.bitrate=1_000_000",
    'claims=[{block="intra", settled_by=0.1}, {block="inter", settled_by=1.0}, {block="centroid", settled_by=10.0}]',
)
"""Values that the tests rely on; they replace those of the shipped scenario"""
FIELD = {name: at for at, name in enumerate(STATE_FIELDS)}
PERIOD_NS = 1_000_000


@dataclass(frozen=True, slots=True)
class Run:
    """A synthetic run and the errors e(0) of its blocks, by name."""

    scenario: Scenario
    trace: Trace
    start: dict[str, NDArray[np.float64]]

    @property
    def plan(self) -> Plan:
        """The plan of the run."""
        return self.trace.plan


Motion = Callable[[BlockPlan, NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]]
"""Returns the error of a block and its rate, (T, size) each, at instants [s]"""


def decaying(overrides: Sequence[str] = (), times_ns: NDArray[np.int64] | None = None) -> Run:
    """Returns a run with e_b(t) = e_b(0) exp(-t/decay) in positions, velocities and headings; all torques are zero."""
    start = {}

    def motion(block: BlockPlan, seconds: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        number = len(start) + 1
        start[block.name] = np.linspace(0.3 * number, 0.5 * number, block.size)
        error = start[block.name] * np.exp(-seconds / DECAY[block.layer])[:, None]
        return error, -error / DECAY[block.layer]

    scenario, plan = load(PAPER, [*PINNED, *overrides])
    return Run(scenario, of_errors(plan, motion, times_ns), start)


def of_errors(plan: Plan, motion: Motion, times_ns: NDArray[np.int64] | None = None) -> Trace:
    """Returns the trace of a run whose blocks have given errors; headings differ, all torques are zero."""
    if times_ns is None:
        times_ns = np.arange(0, plan.duration_ns + 1, plan.root.period_ns)
    seconds = times_ns / 1e9
    transformation = Transformation(plan)
    reference = sample(make_trajectory(plan.trajectory), seconds)
    z = transformation.desired(reference[:, 0]).reshape(len(seconds), -1)
    rate = np.zeros_like(z)
    rate[:, -2:] = reference[:, 1]
    for block in plan.blocks:
        at = slice(block.offset, block.offset + block.size)
        error, error_rate = motion(block, seconds)
        z[:, at] += error
        rate[:, at] += error_rate
    shape = (len(seconds), len(plan.robots), 2)
    states = np.zeros((*shape[:2], len(STATE_FIELDS)))
    states[:, :, [FIELD["x"], FIELD["y"]]] = transformation.backward(z.reshape(shape))
    states[:, :, [FIELD["vx"], FIELD["vy"]]] = transformation.backward(rate.reshape(shape))
    states[:, :, FIELD["theta"]] = np.linspace(0, 1, shape[1])
    return of_states(plan, times_ns, states)


def at_places(places: NDArray[np.float64], overrides: Sequence[str] = (), period_ns: int = PERIOD_NS) -> Trace:
    """Returns a trace in which the first K robots are at `places`, (T, K, 2), and all others are far from them and from each
    other."""
    _, plan = load(PAPER, [*PINNED, *overrides])
    states = np.zeros((len(places), len(plan.robots), len(STATE_FIELDS)))
    states[:, :, FIELD["x"]] = 1e4 * (1 + np.arange(len(plan.robots)))
    states[:, : places.shape[1], [FIELD["x"], FIELD["y"]]] = places
    return of_states(plan, np.arange(len(places)) * period_ns, states)


def of_states(plan: Plan, times_ns: NDArray[np.int64], states: NDArray[np.float64]) -> Trace:
    """Returns the trace of states, (T, robots, fields), at instants that all robots share."""
    robots = range(states.shape[1])
    return Trace(plan, tuple(times_ns for _ in robots), tuple(np.ascontiguousarray(states[:, r]) for r in robots))


def with_states(trace: Trace, states: Sequence[NDArray[np.float64]]) -> Trace:
    """Returns a trace with other states at the same instants."""
    return Trace(trace.plan, trace.times_ns, tuple(states))


def link_counts(plan: Plan) -> list[LinkCounts]:
    """Returns counts for all links of a plan: the first has loss and delay, the others are ideal."""
    ideal = [LinkCounts(link.source, link.receiver, link.channel, 10, 10, 0, 0, 10, 0, 0.0, 0) for link in plan.links]
    first = plan.links[0]
    ages_ns = 2_500_000.25, 6_000_000, 2_000_000, 4_000_000, 5_000_000
    ideal[0] = LinkCounts(first.source, first.receiver, first.channel, 10, 7, 2, 1, 9, 3, *ages_ns, duplicates=4)
    return ideal


def run_facts(**given: Any) -> RunFacts:
    """Returns the facts of a run; `given` replaces some of them."""
    facts = RunFacts("inprocess", "virtual", 6.0, 0.0, 2.0, 200.0, 0, None)
    return replace(facts, **given)


def claims_of(trace: Trace) -> tuple[ClaimResult, ...]:
    """Returns the results of the claims of a run."""
    return summarise(trace, (), None, run_facts()).claims


def can_report(**given: Any) -> CanReport:
    """Returns the report of a bus on which nothing happened; `given` replaces some of its values."""
    bus = BusReport("can0", 500_000, 0.25)
    report = CanReport(
        path="mirror", timing=None, url="virtual", listen="", torque_scale=0.001, log_start=0.0, frames=12, load_mean=0.25,
        fit=("can0 fits",), advice=(), buses=(bus,), scheduled=(), sent=12, failed=0, dropped=0, log_lost=0, log_error=None,
        robots={},
    )  # fmt: skip
    return replace(report, **given)
