"""What `echelon analyse` predicts about a scenario, as frozen records; `results.rendering` writes them as JSON.

Times are in seconds, lengths in metres.  A number that is infinite or does not exist is None; the key beside it says which.
"""

from collections.abc import Mapping
from dataclasses import dataclass

from echelon.sim.results.links_analysis import LinksResult, PolicyResult


@dataclass(frozen=True, slots=True)
class VerdictResult:
    """Whether errors vanish with the links as the scenario has them: in the mean square where chance is at work."""

    method: str
    """`exact`, or `estimated` from random runs without limits and avoidance"""
    settles: bool
    """True if E|e|² vanishes; estimated: if its growth in the last sixth of the runs is below 1"""
    rate: float | None
    """Rate at which the root mean square of the errors shrinks in the long run [1/s], negative if it grows; None: infinite"""
    rate_low: float | None
    """Lower end of its 95 % interval; equal to `rate` if it is exact"""
    rate_high: float | None
    """Upper end"""
    typical_rate: float | None
    """Rate at which almost every single run shrinks [1/s], estimated (docs/architecture.md, 2.11); None: nothing is random, or
    not computed"""
    typical_error: float | None
    """Its standard error"""
    runs: int
    """Number of runs of the estimate; 0 if it is exact"""
    why: str
    """Why it is not exact; empty if it is"""


@dataclass(frozen=True, slots=True)
class BlockCostResult:
    """The expected integral of the squared error of one block."""

    block: str
    """Name of the block"""
    value: float
    """[m² s]"""
    error: float
    """Standard error of an estimate; 0 if it is exact"""
    share: float
    """Its share of the sum over all blocks"""


@dataclass(frozen=True, slots=True)
class CostResult:
    """The expected integral of the squared errors, from the scenario's start, with its links as they are."""

    method: str
    """`exact`: until all errors have vanished; `estimated`: the mean over random runs of the scenario's duration; `not
    computed`"""
    total: float | None
    """Sum over the blocks [m² s]; None: not computed"""
    error: float
    """Standard error of an estimate of the sum; 0 if it is exact"""
    blocks: tuple[BlockCostResult, ...]
    """By block; empty if it is not computed"""
    runs: int
    """Number of runs of the estimate"""
    why: str
    """Why it is not exact, or not computed"""


@dataclass(frozen=True, slots=True)
class BlackoutBlockResult:
    """The error of a block in and after a blackout."""

    block: str
    """Name of the block"""
    peak: float
    """Largest |e| from the beginning of the blackout on [m]; estimated: largest root mean square over the runs"""
    peak_time: float
    """When it is so large [s of run time]"""
    recovery: float | None
    """How long after the end |e| comes to stay below what it was at the beginning [s]; None: not within the run"""


@dataclass(frozen=True, slots=True)
class BlackoutResult:
    """A window of time in which some links of the scenario lose all messages."""

    channels: tuple[str, ...]
    """Their channels"""
    links: int
    """How many links they are"""
    at: float
    """Begin [s of run time]"""
    duration: float
    """[s]"""
    method: str
    """`exact`, `estimated` or `not computed`"""
    blocks: tuple[BlackoutBlockResult, ...]
    """Errors by block; empty if they are not computed"""
    why: str
    """Why it is not exact, or not computed"""


@dataclass(frozen=True, slots=True)
class ModesResult:
    """A block, or several that are alike, alone and in the sampled run."""

    names: tuple[str, ...]
    """The blocks"""
    layer: str
    """`intra`, `middle`, `inter` or `centroid`"""
    size: int
    """Number of values of e"""
    sigma: float
    """Time scale σ [s]"""
    delay_margin: float | None
    """Largest delay of the block alone, in continuous time [s]; None if it is unstable even without delay"""
    poles: tuple[tuple[float, float], ...]
    """Poles of the block alone in continuous time [1/s], real and imaginary part, each once, the slowest first"""
    eigenvalues: tuple[tuple[float, float], ...]
    """Eigenvalues of the sampled run over a hyperperiod in which the block moves most, each once, the largest first"""
    decay_rate: float | None
    """Rate at which its slowest sampled mode decays [1/s]; negative if it grows"""
    frequency: float | None
    """Angular frequency of this mode [rad/s]"""
    cost_share: float | None
    """Share of these blocks in the integral of the expected squared errors, from the scenario's start (docs/architecture.md,
    2.11); None: not computed"""


@dataclass(frozen=True, slots=True)
class SettlingResult:
    """When the error of a block settles from the scenario's start, without limits, avoidance and disturbances."""

    block: str
    """Name of the block"""
    band: float
    """2 % of the error that the block starts with, or `health.floor` [m]"""
    settled: float | None
    """When |e| settles to the band [s]; None if it does not within the duration"""


@dataclass(frozen=True, slots=True)
class EpsilonResult:
    """How large one of `law.epsilon` may be, the others as they are.  None: infinite; 0: none is stable, or none is proved."""

    value: float
    """ε in the scenario"""
    exact: float | None
    """Every ε up to this is stable in continuous time: the whole loop"""
    exact_of_layers: float | None
    """The same if faster layers have settled: what the bounds are about"""
    bound: float | None
    """Lyapunov bound of Theorem 1, corrected (docs/architecture.md, 2.12)"""
    bound_by_norms: float | None
    """The bound by norms of the paper's appendix"""
    paper_formula: float | None
    """The paper's formula (label be1) as it is printed, for ε_1 where blocks are coupled: it proves nothing.  None: there is no
    such number"""
    sampled_low: float | None
    """Smallest ε with which the run is stable with its periods and links; None if it is down to a thousandth of the present
    one, or if the run does not settle as it is"""
    sampled_high: float | None
    """Largest ε with which it is; None if it is up to 1000 times the present one, or if the run does not settle as it is"""


@dataclass(frozen=True, slots=True)
class CouplingResult:
    """By how much all couplings may be multiplied.  None: by any number up to the largest that is tried."""

    exact: float | None
    """In continuous time"""
    sampled: float | None
    """With the periods and links of the scenario; None also if it does not settle"""


@dataclass(frozen=True, slots=True)
class TorqueLoopResult:
    """The torque loop of a robot at the largest speed that is asked of it."""

    robot: str
    """Path of the robot"""
    speed: float | None
    """[m/s]; None: not finite"""
    period: float
    """Torque period [s]"""
    factor: float | None
    """By how much a small yaw rate is multiplied in a torque period; stable if it is below 1.  None: not finite"""
    longest_period: float | None
    """Longest torque period for which it is stable at this speed [s]; None if the robot does not move"""
    stable: bool
    """True if a small yaw rate dies away"""


@dataclass(frozen=True, slots=True)
class AnalysisResult:
    """What `echelon analyse` predicts about a scenario."""

    scenario: str
    """Name of the scenario"""
    assumptions: tuple[str, ...]
    """What is assumed"""
    acceleration_periods: tuple[float, ...]
    """Acceleration periods of the nodes [s], each once"""
    torque_periods: tuple[float, ...]
    """Torque periods of the robots [s], each once"""
    delays: Mapping[str, tuple[float, ...]]
    """For each channel the delays of its links in the scenario [s], each once; of those that vary the smallest and the
    largest"""
    losses: Mapping[str, tuple[float, ...]]
    """For each channel of which messages are lost the shares, each once"""
    policies: Mapping[str, tuple[str, ...]]
    """For each channel the policies of its links that are not `hold`, each once"""
    random: bool
    """True if random numbers decide anything on the links: losses, or delays that vary"""
    verdict: VerdictResult
    """Whether errors vanish with the links as they are"""
    calm: str
    """What is left out in what follows, where exact numbers are for constant delays alone; empty: nothing, the links have
    constant delays and lose nothing"""
    settles: bool
    """True if errors decay in the long run with the scenario's periods and links: that of `verdict`"""
    torque_loop_diverges: bool
    """True if the torque loop of a robot is unstable"""
    hyperperiod: float
    """Period of the coordinator [s]; all other periods divide it"""
    spectral_radius: float | None
    """By how much errors are multiplied in a hyperperiod in the long run: their root mean square; None: estimated only"""
    time_constant: float | None
    """Time in which errors decay, or grow, by the factor e [s]; None: never"""
    centroid_age: float
    """Mean age of the robots' positions at the coordinator [s], with `law.reference = "now"`: the steady error of a moving
    formation is its velocity times this.  0 with `"message"`"""
    blocks: tuple[ModesResult, ...]
    """Modes of the blocks"""
    settling: tuple[SettlingResult, ...]
    """Predicted settling; empty for more than 200 robots, and where `law.reference = "now"` and states are late"""
    cost: CostResult
    """Expected cost with the links as they are"""
    table: tuple[LinksResult, ...]
    """What links bear; empty if the scenario does not settle"""
    effects: tuple[PolicyResult, ...]
    """What each policy buys on each channel; empty if it is not computed"""
    blackouts: tuple[BlackoutResult, ...]
    """Blackouts of the scenario's links"""
    epsilon: tuple[EpsilonResult, ...]
    """How large each of `law.epsilon` may be; empty if it is not computed"""
    coupling: CouplingResult | None
    """How large couplings may be; None if there are none, or if it is not computed"""
    torque_loops: tuple[TorqueLoopResult, ...]
    """Torque loops of the robots"""
    not_computed: tuple[str, ...]
    """What is not computed, and why"""
