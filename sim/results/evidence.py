"""What checks look at: all that was recorded of a run, and all that was computed from it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from echelon.bridge.reports import CanReport
from echelon.plan.plan import Plan
from echelon.sim.results.block_series import Blocks
from echelon.sim.results.distances import Distances
from echelon.sim.results.ending import Ending
from echelon.sim.results.measure_records import LinkResult, TorqueResult
from echelon.sim.results.records import RunFacts
from echelon.sim.results.trace import Trace
from echelon.sim.results.verdict import CheckResult


@dataclass(frozen=True, slots=True)
class Evidence:
    """What checks look at.  `endings` are in the order of the plan's blocks, `torque` in the order of its robots."""

    trace: Trace
    blocks: Blocks
    endings: tuple[Ending, ...]
    near: Distances
    torque: tuple[TorqueResult, ...]
    links: tuple[LinkResult, ...]
    can: CanReport | None
    """None if the run had no bus"""
    run: RunFacts

    @property
    def plan(self) -> Plan:
        """The plan that was run."""
        return self.trace.plan

    @property
    def end_ns(self) -> int | None:
        """The last instant at which all robots have a state [ns]; None if there is none."""
        return int(self.blocks.times_ns[-1]) if len(self.blocks.times_ns) else None


Check = Callable[[Evidence], Iterator[CheckResult]]
"""A health check: yields one result, several (one for each block, for example), or none if it does not apply to the run"""
