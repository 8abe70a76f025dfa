"""What a process of a run says to its supervisor, over its control pipe."""

from dataclasses import dataclass

from echelon.bridge.reports import BridgeProgress, CanReport, DrivesReport, RefereeReport
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.runtime.runner import RunnerCounts
from echelon.sim.results.trace import Array, Trace


@dataclass(frozen=True, slots=True)
class Ready:
    """It is connected to all it will talk to."""


@dataclass(frozen=True, slots=True)
class Failed:
    """It cannot go on; the text is for the user."""

    text: str


@dataclass(frozen=True, slots=True)
class PartFailed:
    """A part that others wrote failed in it; the text names file and class."""

    text: str


@dataclass(frozen=True, slots=True)
class Waiting:
    """In a lockstep, it has waited for a while for messages of these members (their indices) of this instant."""

    time_ns: int
    sources: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Lost:
    """The first state that is not finite: of which robot (its index), and when."""

    robot: int
    time_ns: int

    def text(self, plan: Plan) -> str:
        """Returns it in words."""
        return f"the state of {plan.robots[self.robot].name} is not finite from {self.time_ns / 1e9:g} s on"


@dataclass(frozen=True, slots=True)
class RecorderProgress:
    """How far the recording is; `states` are the robots' last ones, at `states_ns`."""

    time_ns: int
    messages: int
    states_ns: int
    states: Array | None
    failure: str | None
    lost: Lost | None = None
    """Why the run is to stop"""


@dataclass(frozen=True, slots=True)
class RecorderReport:
    """What the recorder leaves behind."""

    trace: Trace
    messages: int
    refused: int
    """Batches that were no messages, and messages of unknown sources or out of their source's order"""
    failure: str | None
    lost: Lost | None = None
    """Where the recording ends; None if it goes on to the end"""

    def stopped(self, plan: Plan) -> str | None:
        """Returns why the run was stopped before its end though nothing failed; None if it was not."""
        if self.lost is None or self.lost.time_ns >= plan.duration_ns:
            return None
        return self.lost.text(plan)


Report = CanReport | DrivesReport | RefereeReport | RecorderReport
"""What bridge, drives, referee and recorder leave behind."""


@dataclass(frozen=True, slots=True)
class Done:
    """It has done its part; what it counted."""

    name: str
    cpu_s: float
    resident_bytes: int
    runner: RunnerCounts | None = None
    links: tuple[LinkCounts, ...] = ()
    report: Report | None = None


Said = Ready | Failed | PartFailed | Waiting | BridgeProgress | RecorderProgress | Done
"""All that a process may say."""
