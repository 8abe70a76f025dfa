"""What `echelon analyse` predicts about the links of a scenario, as frozen records, part of those in `results.analysis`.

Times are in seconds.  A number that is infinite or does not exist is None; the key beside it says which.
"""

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
class EstimateResult:
    """A boundary that was searched for with random runs: a delay [s], or a share of lost messages.

    Near the boundary of losses rare runs carry E|e|², and these runs may hold none of them: then links bear less."""

    value: float | None
    """The largest value tried up to which E|e|² shrinks; None: it grows even at the smallest one"""
    low: float | None
    """Up to this value it shrinks by the 95 % intervals of all points tried; None: nowhere"""
    high: float | None
    """The smallest value at which it grows by the 95 % interval; None: at none that was tried"""
    runs: int
    """Runs for each value"""


@dataclass(frozen=True, slots=True)
class BurstsResult:
    """How many messages may be lost if losses come in bursts as long as those in the scenario."""

    length: float
    """Mean length of a burst [messages]; within it all are lost, between bursts none"""
    loss: LossResult
    """The boundary in the mean square, computed"""
    by_runs: EstimateResult | None
    """The boundary by runs; None: `loss` is exact, or not computed"""


@dataclass(frozen=True, slots=True)
class PolicyResult:
    """What the links of a channel bear with a policy, time-driven, without other losses and delays than the scenario has."""

    channel: str
    """The channel of the links whose policy it is"""
    policy: str
    """The policy"""
    own: bool
    """True if the scenario's links of this channel have this policy"""
    delay: float | None
    """Largest constant delay more that was found stable [s]; None: none is, or not computed"""
    delay_ends: str
    """`unstable`: one period more is unstable; `limit`: longer ones are not tried; `not computed`"""
    loss: LossResult
    """How many messages may be lost in the mean square, each by itself"""
    why: str
    """Why nothing is computed; empty if it is"""


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
    delay_by_runs: EstimateResult | None
    """How much later their messages may be with the links as they are, by runs; None: `delay` is that, since nothing is random,
    or not computed"""
    loss_by_runs: EstimateResult | None
    """How many of their messages may be lost, by runs; None: `loss` is exact, or not computed"""
    bursts: BurstsResult | None = None
    """How many of their messages may be lost in bursts; None: only for classes of which all links lose messages in bursts of
    one length"""


@dataclass(frozen=True, slots=True)
class ScaledDelays:
    """What link classes bear when all ε are multiplied by a number."""

    by: float
    rows: tuple[LinksResult, ...]
    """The classes; empty if the scenario is not stable then"""
    alone: float
    """The smallest delay margin of a block alone, in continuous time [s]"""
