"""The measures of a run as frozen records: of blocks, distances, torques and links.  `results.measures` makes them.

Instants are run time [s], lengths are in metres, torques in newton metres.  A number that is not finite is None, and so is the
settling time of a block that did not settle.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class BlockResult:
    """A block Z_b and its error e(t) over the run; integrals are computed by the trapezoidal rule."""

    name: str
    """Name of the block: path of its group, `inter` or `centroid`"""
    layer: str
    """`intra`, `middle`, `inter` or `centroid`"""
    sigma: float
    """Time scale σ [s]"""
    start_error: float | None
    """The error that the block starts with [m]: its largest |e| within its response time, 3 σ/√k1"""
    dwell: float
    """How long |e| must stay in a band until the end of the run to count as settled [s]"""
    settling_2: float | None
    """When |e| settled to `band_2` [s]: from then on it stays within; None if it does not, or for less than the dwell time"""
    band_2: float
    """2 % of the error that the block starts with [m]; `health.floor` if it starts with an error of at most that"""
    settling_5: float | None
    """When |e| settled to `band_5` [s]; None as for `settling_2`"""
    band_5: float
    """The same as `band_2` with 5 % [m]"""
    decay_rate: float | None
    """Decay rate of the error's amplitude, by a line fitted to its logarithm [1/s]; negative if the amplitude grows"""
    decay_fit: float | None
    """r² of this fit"""
    ending: str
    """How |e| ended: `at rest`, `falls`, `grows`, `oscillates`, `steady lag`, `steady error` or `not finite`; `too short` if
    the run is too short to judge it"""
    remark: str
    """The same as `ending` in words, with numbers"""
    residual: float | None
    """|e| at the end [m]"""
    peak_error: float | None
    """Largest |e| [m]"""
    peak_time: float | None
    """When |e| was largest [s]"""
    ise: float | None
    """∫|e|² dt [m² s]"""
    iae: float | None
    """∫|e| dt [m s]"""
    itae: float | None
    """∫ t |e| dt [m s²]"""


@dataclass(frozen=True, slots=True)
class SeparationResult:
    """A time scale σ compared with the next faster one."""

    faster: str
    """The layer, or the blocks, with the smaller σ"""
    slower: str
    """The layer, or the blocks, with the larger σ"""
    sigma_ratio: float
    """σ of the slower over σ of the faster"""
    rate_ratio: float | None
    """Decay rate of the faster over that of the slower, each that of its slowest block; None if a block does not decay, or the
    run is too short"""
    rate_fit: float | None
    """The smallest r² of the fits; None if there is none, or the run is too short"""
    settling_2_ratio: float | None
    """Settling time (2 %) of the slower over that of the faster.  Unlike `sigma_ratio` it depends on the errors at the
    start."""
    settling_5_ratio: float | None
    """The same with 5 %"""


@dataclass(frozen=True, slots=True)
class ViolationResult:
    """An unbroken interval in which two robots were not farther apart than the avoidance radius."""

    pair: tuple[str, str]
    """The two robots"""
    first: float
    """Its beginning [s]"""
    last: float
    """Its end [s]"""
    smallest: float
    """The smallest distance in it [m]"""


@dataclass(frozen=True, slots=True)
class DistanceResult:
    """Distances between robots, at the recorded instants and between them."""

    smallest: float | None
    """The smallest distance of the run [m]; this and the next two are None if no two robots had a finite distance"""
    pair: tuple[str, str] | None
    """The two robots with this distance"""
    time: float | None
    """When they had it [s]"""
    between_instants: str
    """The motion that is assumed between the recorded instants"""
    avoidance_enabled: bool
    """Whether robots avoid each other"""
    avoidance_radius: float
    """[m]"""
    sensing_radius: float
    """[m]"""
    violations: tuple[ViolationResult, ...]
    """All violations of the avoidance radius, in order of their beginning"""


@dataclass(frozen=True, slots=True)
class TorqueResult:
    """A robot's wheel torques over its whole run."""

    robot: str
    """Name of the robot"""
    torque_limit: float | None
    """[N m]; None: there is no limit"""
    rms: float | None
    """Root mean square over both wheels and the run [N m]"""
    rms_right: float | None
    """[N m]"""
    rms_left: float | None
    """[N m]"""
    peak: float | None
    """Largest absolute value [N m]"""
    peak_wheel: str | None
    """The wheel that had it, `right` or `left`; None if the run had no period"""
    peak_time: float | None
    """End of the period in which it was reached [s]"""
    saturation_share: float | None
    """Share of the torque periods in which a limit of the robot acted"""
    saturated_after_first_second: int | None
    """Number of torque periods after the first second in which a limit acted; within it, the errors at the start are the usual
    cause"""


@dataclass(frozen=True, slots=True)
class LinkResult:
    """The messages of a link: sent = delivered + lost + in_flight."""

    source: str
    """Name of the role that sends"""
    receiver: str
    """Name of the role that receives"""
    channel: str
    """Channel of the messages, for example `state`"""
    sent: int
    """Messages that were sent"""
    delivered: int
    """Messages that arrived, each counted once"""
    lost: int
    """Messages that were lost on the link"""
    in_flight: int
    """Messages on their way at the end of the run"""
    duplicates: int
    """Messages that arrived a second time"""
    used: int
    """Uses of messages; a message may be used several times"""
    held: int
    """Uses of a message that had been used before, after the instant it was sent in"""
    age_mean: float | None
    """Mean age of the messages at each use [s]; None if none was ever used"""
    age_p50: float | None
    """Age that half of the uses do not exceed [s]"""
    age_p95: float | None
    """Age that 95 % of the uses do not exceed [s]"""
    age_p99: float | None
    """Age that 99 % of the uses do not exceed [s]"""
    age_max: float | None
    """Largest age of a message at a use [s]; None if none was ever used"""
