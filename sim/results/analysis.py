"""What `echelon analyse` predicts about a scenario, as frozen records; `results.rendering` writes them as JSON.

Times are in seconds, lengths in metres.  A number that is infinite or does not exist is None; the key beside it says which.
"""

from collections.abc import Mapping
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DelayResult:
    """How much later the messages of some links may be, beyond the delays that the scenario gives them."""

    seconds: float | None
    """Every additional delay up to this is stable [s]; None: none is (`ends` is `unstable`), or all are (`ends` is `never`)"""
    ticks: int | None
    """The largest number of whole ticks up to which all are stable; None as for `seconds`"""
    tick: float
    """Length of a tick, what divides the periods concerned [s]"""
    ends: str
    """Why it is not more: `unstable`: one tick more is unstable; `timeout`: messages are older than their timeout allows;
    `never`: no delay is unstable; `limit`: longer delays have not been tried out"""
    tried: bool
    """True: found by trying delays, which may miss an unstable delay below a stable one"""
    limits: tuple[str, ...]
    """The blocks that move in the motion at the edge of stability"""


@dataclass(frozen=True, slots=True)
class LossResult:
    """How many of the messages of some links may be lost, each by itself, so that the mean square of the errors vanishes."""

    share: float | None
    """Largest share of lost messages; None: unstable even without loss, or not computed"""
    ends: str
    """`unstable`: with a larger share the mean square grows; `limit`: larger shares were not tried; `not computed`"""
    why: str
    """Why it is not computed; empty if it is"""


@dataclass(frozen=True, slots=True)
class LinksResult:
    """What some links bear together, a row of the table layer × channel."""

    kind: str
    """`class` (a layer and a channel), `channel`, `layer`, `all`, `group` or `robot`"""
    name: str
    """Which links they are, in words"""
    layer: str | None
    """Their layer: `intra`, `middle`, `inter`; `robot` for torques on their way to the drives; None: several"""
    channel: str | None
    """Their channel; None: several"""
    links: int
    """How many links they are"""
    like: tuple[str, ...]
    """For a robot or a group: all robots or groups for which the answer is the same"""
    delay: DelayResult
    """How much later their messages may be"""
    loss: LossResult | None
    """How many of their messages may be lost; None: only computed for classes"""


@dataclass(frozen=True, slots=True)
class ScaledDelays:
    """What link classes bear when all ε are multiplied by a number."""

    by: float
    rows: tuple[LinksResult, ...]
    """The classes; empty if the scenario is not stable then"""
    alone: float
    """The smallest delay margin of a block alone, in continuous time [s]"""


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
    """For each channel the delays of its links in the scenario [s], each once"""
    settles: bool
    """True if errors decay in the long run with the scenario's periods and delays"""
    torque_loop_diverges: bool
    """True if the torque loop of a robot is unstable"""
    hyperperiod: float
    """Period of the coordinator [s]; all other periods divide it"""
    spectral_radius: float
    """By how much errors are multiplied in a hyperperiod in the long run"""
    time_constant: float | None
    """Time in which errors decay, or grow, by the factor e [s]; None: never"""
    centroid_age: float
    """Mean age of the robots' positions at the coordinator [s], with `law.reference = "now"`: the steady error of a moving
    formation is its velocity times this.  0 with `"message"`"""
    blocks: tuple[ModesResult, ...]
    """Modes of the blocks"""
    settling: tuple[SettlingResult, ...]
    """Predicted settling; empty for more than 200 robots, and where `law.reference = "now"` and states are late"""
    table: tuple[LinksResult, ...]
    """What links bear; empty if the scenario does not settle"""
    epsilon: tuple[EpsilonResult, ...]
    """How large each of `law.epsilon` may be; empty if it is not computed"""
    coupling: CouplingResult | None
    """How large couplings may be; None if there are none, or if it is not computed"""
    torque_loops: tuple[TorqueLoopResult, ...]
    """Torque loops of the robots"""
    not_computed: tuple[str, ...]
    """What is not computed, and why"""
