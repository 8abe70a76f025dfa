"""The messages of a process to the supervisor, over its control pipe."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from echelon.bridge.referee_reports import RefereeReport
from echelon.bridge.reports import BridgeProgress, CanReport, DrivesReport
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.runtime.runner import RunnerCounts
from echelon.sim.results.trace import Array, Trace


@dataclass(frozen=True, slots=True)
class Ready:
    """The process is connected to all its peers."""


@dataclass(frozen=True, slots=True)
class Failed:
    """The process cannot go on; the text says why, for the user."""

    text: str


@dataclass(frozen=True, slots=True)
class PartFailed:
    """A user's part failed in the process; the text names file and class."""

    text: str


@dataclass(frozen=True, slots=True)
class Waiting:
    """In lockstep: the process has waited for a while for messages of this instant from the members `sources` (indices)."""

    time_ns: int
    sources: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class LinksProgress:
    """The counts of the links into a process up to now."""

    links: tuple[LinkCounts, ...]


@dataclass(frozen=True, slots=True)
class Lost:
    """The first state that is not finite, or beyond all bounds, or of a robot beyond its reach: of which robot (its index), and
    when."""

    robot: int
    time_ns: int
    finite: bool = False
    far: float | None = None
    """How far the robot is from where the trajectory begins, if that is beyond its reach (`sim.parts.reach`) [m]"""

    def text(self, plan: Plan) -> str:
        """Returns it in words."""
        if self.far is not None:
            from echelon.sim.parts.reach import DIVERGED  # most processes never say it

            who, when = plan.robots[self.robot].name, f"{self.time_ns / 1e9:g} s"
            return f"{who} has diverged: at {when} it is {self.far:.3g} m from where the trajectory begins, {DIVERGED}"
        what = "beyond all bounds" if self.finite else "not finite"
        return f"the state of {plan.robots[self.robot].name} is {what} from {self.time_ns / 1e9:g} s on"


@dataclass(frozen=True, slots=True)
class RecorderProgress:
    """Progress of the recorder; `states` are the last states of the robots, at `states_ns`."""

    time_ns: int
    messages: int
    states_ns: int
    states: Array | None
    failure: str | None
    lost: Lost | None = None
    """Why the run is to stop"""


@dataclass(frozen=True, slots=True)
class RecorderReport:
    """The recorder's report."""

    trace: Trace
    messages: int
    late: int
    """Number of messages that came too late for their place in the recording, and of states beyond the end"""
    failure: str | None
    lost: Lost | None = None
    """Where the recording ends; None if it goes on to the end"""
    thinned: int = 0
    """Messages that it left out by rule"""

    def stopped(self, plan: Plan) -> str | None:
        """Returns why the run was stopped before its end though nothing failed; None if it was not."""
        if self.lost is None or self.lost.time_ns >= plan.duration_ns:
            return None
        return self.lost.text(plan)


Report = CanReport | DrivesReport | RefereeReport | RecorderReport
"""The reports of bridge, drives, referee and recorder."""


@dataclass(frozen=True, slots=True)
class Done:
    """The process is done, with its counts."""

    name: str
    cpu_s: float
    memory_bytes: int
    runner: RunnerCounts | None = None
    links: tuple[LinkCounts, ...] = ()
    report: Report | None = None
    refused: Mapping[str, Mapping[str, int]] = field(default_factory=dict)
    """Messages that it refused, by source and reason (`echelon.runtime.admission`)"""


Said = Ready | Failed | PartFailed | Waiting | LinksProgress | BridgeProgress | RecorderProgress | Done
"""Any message of a process."""
