"""The results of a run, as frozen records.  `summary.json` is their rendering (echelon.sim.results.rendering).

Times are in seconds of run time, lengths in metres, torques in newton metres.  A number that is not finite is None, and so is
the settling time of a block that did not settle.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

from echelon.bridge.reports import CanReport

FORMAT = 2
"""Of summary.json; one more whenever a key changes its meaning or goes"""


@dataclass(frozen=True, slots=True)
class Verdict:
    """Whether the run showed what it claims, and nothing went wrong."""

    holds: bool
    reasons: tuple[str, ...]
    """Why it does not hold"""


@dataclass(frozen=True, slots=True)
class ClaimResult:
    """A claim of the scenario, held against the slowest of its blocks."""

    block: str
    settled_by: float
    band: float
    measured: float | None
    """When the slowest of its blocks settled"""
    blocks: Mapping[str, float | None]
    """When each of its blocks settled"""
    holds: bool


@dataclass(frozen=True, slots=True)
class BlockResult:
    """A block Z_b and its error e(t); the integrals are by the trapezoidal rule."""

    name: str
    layer: str
    sigma: float
    """Time scale σ [s]"""
    settling_2: float | None
    """From when on |e| stays within 2 % of its largest value"""
    settling_5: float | None
    residual: float | None
    """|e| at the end [m]"""
    peak_error: float | None
    """Largest |e| [m]"""
    peak_time: float | None
    ise: float | None
    """∫|e|² dt [m² s]"""
    iae: float | None
    """∫|e| dt [m s]"""
    itae: float | None
    """∫ t |e| dt [m s²]"""


@dataclass(frozen=True, slots=True)
class SeparationResult:
    """Two neighbouring time scales compared."""

    faster: str
    slower: str
    sigma_ratio: float
    settling_2_ratio: float | None
    """Settling time of the slower over that of the faster"""
    settling_5_ratio: float | None


@dataclass(frozen=True, slots=True)
class ViolationResult:
    """An unbroken interval in which two robots were not farther apart than the avoidance radius."""

    pair: tuple[str, str]
    first: float
    last: float
    smallest: float
    """[m]"""


@dataclass(frozen=True, slots=True)
class DistanceResult:
    """Distances between robots, between the recorded instants too."""

    smallest: float | None
    """[m]"""
    pair: tuple[str, str] | None
    time: float | None
    between_instants: str
    """How the motion between recorded instants is taken"""
    avoidance_enabled: bool
    avoidance_radius: float
    sensing_radius: float
    violations: tuple[ViolationResult, ...]


@dataclass(frozen=True, slots=True)
class TorqueResult:
    """A robot's wheel torques over its whole run."""

    robot: str
    torque_limit: float | None
    """None: there is no limit"""
    rms: float | None
    """Of both wheels, from the mean squares of the periods [N m]"""
    rms_right: float | None
    rms_left: float | None
    peak: float | None
    peak_wheel: str | None
    peak_time: float | None
    saturation_share: float | None
    """Share of the inner torque periods in which a limit acted"""
    saturated_after_first_second: int | None
    """Torque periods; the step at the start is the usual cause in the first second"""


@dataclass(frozen=True, slots=True)
class LinkResult:
    """What became of a link's messages; sent = delivered + lost + in_flight."""

    source: str
    receiver: str
    channel: str
    sent: int
    delivered: int
    lost: int
    in_flight: int
    used: int
    """Uses of a message"""
    held: int
    """Uses of a message that had been used before, after the instant it was sent in"""
    age_mean: float
    """Of what was in use, at each use [s]"""
    age_max: float


@dataclass(frozen=True, slots=True)
class ProcessResult:
    """What a process of the run took."""

    cpu_time: float
    """[s]"""
    resident_bytes: int


@dataclass(frozen=True, slots=True)
class RunFacts:
    """How the run was run."""

    engine: str
    """`processes` or `inprocess`"""
    clock: str
    """`virtual` or `wall`"""
    wall_time: float | None
    """From run time 0 to the end [s]; None, here and below, where nobody knows: the run was killed and recovered"""
    startup_time: float | None
    real_time_factor: float | None
    """Run time over wall time"""
    ticks_per_second: float | None
    messages: int | None
    failure: str | None
    """Why it broke off"""
    date: str = ""
    """When it began, UTC, ISO 8601"""
    version: str = ""
    """Of echelon"""
    machine: str = ""
    """Operating system, processor, and how many of its cores there are"""
    python: str = ""
    command: str = ""
    """That started it"""
    late_stages: int = 0
    """Stages that ran at their deadline without something they wanted (wall clock)"""
    stages: int = 0
    latest: float = 0.0
    """Largest lateness of a stage [s] (wall clock)"""
    refused: int = 0
    """Payloads that were no messages for their receiver"""
    resident_bytes: int | None = None
    """Of the one process"""
    resident_bytes_robot_max: int | None = None
    processes: Mapping[str, ProcessResult] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Summary:
    """All results of a run."""

    format: int
    scenario: str
    seed: int
    robots: int
    duration: float
    """As the scenario asks for"""
    simulated: float | None
    """Up to the last instant that all robots reached"""
    instants: int
    """At which all robots have a state"""
    largest_gap: float | None
    """Between two of those instants [s]"""
    verdict: Verdict
    claims: tuple[ClaimResult, ...]
    blocks: tuple[BlockResult, ...]
    separation: tuple[SeparationResult, ...]
    distance: DistanceResult
    torque: tuple[TorqueResult, ...]
    links: tuple[LinkResult, ...]
    can: CanReport | None
    """None where the run had no bus"""
    run: RunFacts
    trace_digest: str
