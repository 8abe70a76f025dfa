"""The results of a run as frozen records, apart from the verdict (`results.verdict`).  `results.rendering` writes them as
`summary.json`.

Instants are run time [s], lengths are in metres, torques in newton metres.  A number that is not finite is None, and so is the
settling time of a block that did not settle.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

from echelon.bridge.reports import CanReport
from echelon.sim.results.measure_records import BlockResult, DistanceResult, LinkResult, SeparationResult, TorqueResult
from echelon.sim.results.verdict import Outcome, Verdict

FORMAT: Final = 3
"""Format of summary.json; it increases by one whenever a key changes its meaning or is removed"""


@dataclass(frozen=True, slots=True)
class ClaimResult:
    """A claim of the scenario and its outcome, which the slowest of its blocks decides."""

    block: str
    """The blocks that the claim is about, as the scenario gives them: the name of a block or of a layer, or `*` for all"""
    settled_by: float
    """When all of these blocks must have settled [s]"""
    band: float
    """The band to settle to, as a share of the error that a block starts with"""
    measured: float | None
    """When the slowest of these blocks settled [s]; None if one did not settle"""
    blocks: Mapping[str, float | None]
    """When each of these blocks settled [s]; None if it did not settle"""
    bands: Mapping[str, float]
    """The band of each of these blocks [m]"""
    outcome: Outcome
    """`not tested`: the run ended before the claim could be decided"""


@dataclass(frozen=True, slots=True)
class PartResult:
    """A law, plant, trajectory or drive protocol that is not built in."""

    use: str
    """Its name in the scenario.toml of the run's folder"""
    file: str | None
    """Its Python file in the run's folder; None if it is installed"""
    sha256: str | None
    """SHA-256 of the file, hexadecimal; None if it is installed"""


@dataclass(frozen=True, slots=True)
class ProcessResult:
    """What a process of the run used."""

    cpu_time: float
    """Processor time [s]"""
    memory_bytes: int
    """Memory at the end: its own, and its share of what it has in common with other processes (PSS) [bytes]"""


@dataclass(frozen=True, slots=True)
class StandstillResult:
    """The longest time for which a process stood still: it was at work later than it had said."""

    lasted: float
    """How long [s]"""
    since: float
    """When it began [s]"""


@dataclass(frozen=True, slots=True)
class RefusalResult:
    """Messages that a process refused, of one source and for one reason (echelon.runtime.admission)."""

    receiver: str
    """Name of the process that refused them"""
    source: str
    """Name of the role that sent them"""
    reason: str
    """Why"""
    messages: int
    """How many"""


@dataclass(frozen=True, slots=True)
class RunFacts:
    """How the run was run."""

    engine: str
    """`processes` or `inprocess`"""
    clock: str
    """`virtual` or `wall`"""
    wall_time: float | None
    """Wall time from run time 0 to the end [s].  This and other numbers are None if they are not known: the run was killed and
    recovered."""
    startup_time: float | None
    """Wall time before run time 0 [s]"""
    real_time_factor: float | None
    """Run time over wall time"""
    ticks_per_second: float | None
    """Acceleration periods of the first robot per second of wall time"""
    messages: int | None
    """Messages that the recorder accepted"""
    failure: str | None
    """Why the run broke off; None if it did not"""
    stopped: str | None = None
    """Why the run was stopped before its end though nothing failed: a state that is not finite"""
    date: str = ""
    """When the run began, UTC, ISO 8601"""
    version: str = ""
    """Version of echelon"""
    machine: str = ""
    """Operating system, processor, and number of its cores"""
    python: str = ""
    """Version of Python"""
    command: str = ""
    """The command that started the run"""
    late_stages: int = 0
    """Stages that ran at their deadline without all of their inputs (wall clock)"""
    stages: int = 0
    """All stages that ran (wall clock)"""
    latest: float = 0.0
    """Largest lateness of a stage [s] (wall clock)"""
    refused: int = 0
    """Messages that processes refused"""
    refusals: tuple[RefusalResult, ...] = ()
    """By receiver, source and reason, the most frequent first"""
    resident_bytes: int | None = None
    """Largest resident memory of a run in one process [bytes]"""
    memory_bytes_robot_max: int | None = None
    """Largest memory of a robot's process [bytes]"""
    processes: Mapping[str, ProcessResult] = field(default_factory=dict)
    """By name of the process; empty for a run in one process"""
    recorded_every: float | None = None
    """Time from one recorded instant to the next where the recording is thinned by rule [s]; None: every instant is recorded"""
    thinned: int = 0
    """Messages that were not recorded by this rule"""
    standstills: Mapping[str, StandstillResult] = field(default_factory=dict)
    """By name of the process, also of those that were lost; empty in virtual time"""


@dataclass(frozen=True, slots=True)
class Summary:
    """All results of a run."""

    format: int
    """Format of the file; it increases by one whenever a key changes its meaning or is removed"""
    scenario: str
    """Name of the scenario"""
    seed: int
    """Seed of all random numbers of the run"""
    robots: int
    """Number of robots"""
    duration: float
    """Duration in the scenario [s]"""
    simulated: float | None
    """The last instant at which all robots have a state [s]; None if there is none"""
    instants: int
    """Number of instants at which all robots have a state"""
    largest_gap: float | None
    """Longest time between two of these instants [s]"""
    verdict: Verdict
    """What the run showed, with all checks"""
    claims: tuple[ClaimResult, ...]
    """The claims of the scenario, in its order"""
    blocks: tuple[BlockResult, ...]
    """The blocks, in the order of the plan"""
    separation: tuple[SeparationResult, ...]
    """Neighbouring time scales compared, the fastest first"""
    distance: DistanceResult
    """Distances between robots"""
    torque: tuple[TorqueResult, ...]
    """Wheel torques, by robot"""
    links: tuple[LinkResult, ...]
    """Messages, by link; empty if they were not counted"""
    can: CanReport | None
    """None if the run had no bus"""
    run: RunFacts
    """How the run was run"""
    trace_digest: str
    """SHA-256 over all states of all robots (`results.trace.Digest`)"""
    parts: tuple[PartResult, ...] = ()
    """The laws, plants, trajectories and drive protocols that are not built in"""
