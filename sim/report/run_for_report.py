"""A run as a report takes it, and the figures that a report makes of each run."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

from echelon.sim.report.drawing import Picture
from echelon.sim.report.figures import errors, smallest_distance, transformed_state, wheel_torques
from echelon.sim.report.trajectory_map import trajectories
from echelon.sim.results.block_series import Blocks
from echelon.sim.results.distances import Distances
from echelon.sim.results.records import Summary
from echelon.sim.results.trace import Trace


@dataclass(frozen=True, slots=True)
class RunForReport:
    """A run as a report takes it."""

    name: str
    """The name that tells this run from others in the report"""
    trace: Trace
    summary: Summary
    scenario: str
    """The effective scenario as TOML"""
    frames: tuple[Mapping[str, object], ...] = ()
    """The first frames on the buses, decoded: one mapping for each frame, all with the same keys"""


@dataclass(frozen=True, slots=True)
class ShownRun:
    """A run in a report, with all that is computed once for its figures."""

    run: RunForReport
    blocks: Blocks
    near: Distances
    width: float
    """Width of the figures [inches]"""
    several: bool
    """True if the report is about several runs"""


FIGURES: Final[Mapping[str, Callable[[ShownRun], Picture]]] = {
    "trajectories": lambda one: trajectories(one.run.trace, one.width),
    "blocks": lambda one: transformed_state(one.blocks, one.run.trace.plan, one.width),
    "errors": lambda one: errors(one.blocks, one.run.trace.plan, one.width),
    "distance": lambda one: smallest_distance(one.near, one.run.trace.plan, one.width),
    "torques": lambda one: wheel_torques(one.run.trace, one.width),
}
"""The figures of one run by name"""
