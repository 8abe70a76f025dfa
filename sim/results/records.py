"""The results of a run, as frozen records.  `summary.json` is their rendering (echelon.sim.results.rendering).

Times are in seconds of run time, lengths in metres, torques in newton metres.  A number that is not finite is None, and so is
the settling time of a block that did not settle.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final, Literal

from echelon.bridge.reports import CanReport

FORMAT: Final = 3
"""Of summary.json; one more whenever a key changes its meaning or goes"""
Outcome = Literal["passed", "failed", "not tested"]
CLAIM: Final = "claim"
"""Name of the checks that are claims of the scenario"""
CAUSES: Final = ("whole", "finite")
"""Names of the checks whose failure is why others fail, or cannot be tested"""


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One thing that was looked at, with its outcome."""

    name: str
    """`claim`, or one of the health checks of docs/scenario.md"""
    outcome: Outcome
    text: str
    """One sentence"""
    measured: float | None = None
    """What was measured; None where it is no number, or there is none"""
    unit: str = ""
    """Of what was measured and of its bound"""
    bound: float | None = None
    about: tuple[str, ...] = ()
    """Blocks, robots or links that it is about; empty: the whole run"""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What a run showed.  HOLDS: it claimed something, all claims passed, and no check failed.  HEALTHY: it claimed nothing,
    and no check failed.  FAILS: everything else."""

    word: Literal["HOLDS", "HEALTHY", "FAILS"]
    checks: tuple[CheckResult, ...]

    @property
    def fails(self) -> bool:
        """True if the word is FAILS."""
        return self.word == "FAILS"

    @property
    def claims(self) -> tuple[CheckResult, ...]:
        """The checks that are claims of the scenario."""
        return tuple(check for check in self.checks if check.name == CLAIM)

    @property
    def reasons(self) -> tuple[str, ...]:
        """Why the run fails: the sentences of what failed, and then of claims that were not tested.  First comes what is the
        cause of others: the run broke off, or a state was not finite."""
        failed = [check for check in self.checks if check.outcome == "failed"]
        failed.sort(key=lambda check: check.name not in CAUSES)
        untested = [check for check in self.checks if check.outcome == "not tested" and check.name == CLAIM]
        return tuple(f"{check.name}: {check.text}" for check in (*failed, *untested))

    @property
    def not_tested(self) -> tuple[str, ...]:
        """The sentences of what could not be tested, claims left out."""
        return tuple(
            f"{check.name}: {check.text}"
            for check in self.checks
            if check.outcome == "not tested" and check.name != CLAIM
        )

    @property
    def sentence(self) -> str:
        """The word, and what it stands on."""
        claims, others = len(self.claims), [check.outcome for check in self.checks if check.name != CLAIM]
        passed = f"{count(others.count('passed'), 'check')} passed"
        passed += f", {len(self.not_tested)} not tested" if self.not_tested else ""
        match self.word:
            case "HOLDS":
                return f"HOLDS: {count(claims, 'claim')} and {passed}"
            case "HEALTHY":
                return f"HEALTHY: nothing was claimed; {passed}"
        failed = f"{count(len(self.reasons), 'reason')}; {passed}"
        return f"FAILS: {failed}" if claims else f"FAILS: nothing was claimed; {failed}"

    def __str__(self) -> str:
        return "\n".join([self.sentence, *self.reasons, *(f"not tested: {text}" for text in self.not_tested)])


def count(number: int, what: str) -> str:
    """Returns a number of things in words: `1 claim`, `3 claims`."""
    return f"{number} {what}{'s' * (number != 1)}"


@dataclass(frozen=True, slots=True)
class ClaimResult:
    """A claim of the scenario, held against the slowest of its blocks."""

    block: str
    settled_by: float
    band: float
    """Share of the error that a block starts with"""
    measured: float | None
    """When the slowest of its blocks settled"""
    blocks: Mapping[str, float | None]
    """When each of its blocks settled"""
    bands: Mapping[str, float]
    """The band of each of its blocks [m]"""
    outcome: Outcome
    """`not tested`: the run ended before it could be told"""


@dataclass(frozen=True, slots=True)
class BlockResult:
    """A block Z_b and its error e(t); the integrals are by the trapezoidal rule."""

    name: str
    layer: str
    sigma: float
    """Time scale σ [s]"""
    start_error: float | None
    """The error that it starts with [m]: its largest |e| within the first response time, 3 σ/√k1"""
    dwell: float
    """How long |e| must stay in a band until the end of the run to be settled [s]"""
    settling_2: float | None
    """From when on |e| stays within `band_2`; None if it does not, or not for the dwell time"""
    band_2: float
    """2 % of the error that it starts with, or `health.floor` where it starts within that [m]"""
    settling_5: float | None
    band_5: float
    """The same with 5 %"""
    decay_rate: float | None
    """Of the error's amplitude, by a line fitted to its logarithm [1/s]; negative where it grows"""
    decay_fit: float | None
    """r² of that fit"""
    ending: str
    """How |e| ended: `at rest`, `falls`, `grows`, `oscillates`, `steady lag`, `steady error`, `not finite`; or the run is `too
    short` to tell"""
    remark: str
    """The same in words, with numbers"""
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
    rate_ratio: float | None
    """Decay rate of the faster over that of the slower, of each the slowest of its blocks; None if one does not decay, or the
    run is too short to tell"""
    rate_fit: float | None
    """The smallest r² of the fits; None where there is no ratio for lack of time"""
    settling_2_ratio: float | None
    """Settling time of the slower over that of the faster; other than a ratio of time scales, it depends on where they start"""
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
    """What became of a link's messages; sent = delivered + lost + in_flight.

    The ages are those of what was in use, at each use [s]; None if nothing was ever used."""

    source: str
    receiver: str
    channel: str
    sent: int
    delivered: int
    """Messages of which a first copy has arrived"""
    lost: int
    in_flight: int
    duplicates: int
    """Second copies of messages that have arrived"""
    used: int
    """Uses of a message"""
    held: int
    """Uses of a message that had been used before, after the instant it was sent in"""
    age_mean: float | None
    age_p50: float | None
    """Not exceeded in half of the uses"""
    age_p95: float | None
    """Not exceeded in 95 % of the uses"""
    age_p99: float | None
    """Not exceeded in 99 % of the uses"""
    age_max: float | None


@dataclass(frozen=True, slots=True)
class PartResult:
    """A law, plant or trajectory that is not built in."""

    use: str
    """As scenario.toml beside summary.json names it"""
    file: str | None
    """Its Python file there; None if it is installed"""
    sha256: str | None
    """Of the file, hexadecimal"""


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
    stopped: str | None = None
    """Why it was stopped before its end though nothing failed: a state that is not finite"""
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
    """Payloads that were no messages for their receiver, or for the recording"""
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
    parts: tuple[PartResult, ...] = ()
    """That are not built in"""
