"""The referee's report about a run, as frozen records.  Times are seconds of run time."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, slots=True)
class FindingReport:
    """A finding of the referee: something on a bus that breaks the plan or the protocol."""

    time: float
    """When it was found [s]"""
    bus: str
    """Name of the bus"""
    id: str
    """Identifier, three hexadecimal digits"""
    kind: str
    """Kind of the finding, for example `counter gap`"""
    text: str
    """The finding in words"""
    robot: str
    """Name of the robot; empty if the finding concerns no single robot"""


@dataclass(frozen=True, slots=True)
class TimingReport:
    """The periods between the frames of one identifier [s]; None if there were too few frames."""

    frames: int
    """Number of frames"""
    period_mean: float | None = None
    """Mean period [s]"""
    period_min: float | None = None
    """Shortest period [s]"""
    period_max: float | None = None
    """Longest period [s]"""
    jitter: float | None = None
    """Standard deviation of the periods"""


@dataclass(frozen=True, slots=True)
class RefereeReport:
    """The referee's report."""

    frames: int
    """Frames that were judged"""
    unknown: int
    """Frames with identifiers that no robot of the plan uses"""
    kinds: Mapping[str, int]
    """Findings by kind"""
    findings: tuple[FindingReport, ...]
    """The first findings, in full"""
    identifiers: Mapping[str, TimingReport]
    """By bus and identifier, for example `can0:101`"""
    source: str = "can.log"
    """Where the frames came from: `can.log`, or `bus` if the referee listened itself"""
    until: float | None = None
    """When the run was stopped, if it was [s]: only frames up to then are judged; None: all frames are"""
    later: int = 0
    """Frames after `until`, which are not judged: the processes of a run end one after the other"""
    left_out: Mapping[str, int] = field(default_factory=dict)
    """What of the log is not judged, by reason: for example frames of interfaces that are not buses of the scenario"""

    @property
    def up_to(self) -> str:
        """Up to when frames are judged, in words that follow their number; empty if all are."""
        return "" if self.until is None else f" up to {self.until:g} s, where the run was stopped"

    @property
    def after_stop(self) -> str:
        """A sentence about the frames after the stop, without a capital or a full stop; empty if there are none."""
        if self.until is None or not self.later:
            return ""
        where = "on the bus there were" if self.source == "bus" else "can.log and the numbers of the buses include"
        return f"the run was stopped at {self.until:g} s; {where} {self.later} later frames, which are not judged"
