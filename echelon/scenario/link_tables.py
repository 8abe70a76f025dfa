"""The tables of a scenario that concern links: their delays, losses and policies, clocks, and events of links."""

from pathlib import Path
from typing import Annotated, Any, Final, Literal

from pydantic import (
    BaseModel,
    Discriminator,
    Field,
    PlainSerializer,
    PlainValidator,
    SerializationInfo,
    Tag,
    ValidationInfo,
    WithJsonSchema,
    model_validator,
)

from echelon.parameters import Finite, NonNegative, Positive
from echelon.part_groups import read_source
from echelon.plugins import Source
from echelon.scenario.part_fields import PartContext
from echelon.scenario.values import (
    Fraction,
    Name,
    Seconds,
    SecondsOrZero,
    Table,
    number_or_table,
)

ChannelName = Literal["state", "group_state", "reference", "command", "torque", "*"]
Policy = Literal["hold", "hold_then_stop", "zero", "extrapolate", "predict"]
Correlation = Annotated[float, Field(strict=True, ge=0, lt=1, allow_inf_nan=False)]
_SHAPE: Final = 0.1
Shape = Annotated[float, Field(strict=True, ge=_SHAPE, le=1e4, allow_inf_nan=False)]


class Uniform(Table):
    """A random delay, uniform between two bounds."""

    kind: Literal["uniform"] = "uniform"
    """Kind of this delay; a table without a kind is uniform"""
    min: NonNegative
    """Shortest delay [s]"""
    max: NonNegative
    """Longest delay [s]"""
    correlation: Correlation = 0.0
    """ρ of the Gaussian sequence from which the delays of successive messages come (docs/architecture.md, 4.1); 0: delays are
    independent"""

    @model_validator(mode="after")
    def _bounds(self) -> "Uniform":
        if self.max < self.min:
            raise ValueError(f"max = {self.max} must be at least min = {self.min}")
        return self


class Normal(Table):
    """A random delay with a truncated normal distribution: no delay is below `min`, and those above have the density of the
    normal distribution, scaled so that all probabilities add up to 1."""

    kind: Literal["normal"]
    """Kind of this delay"""
    mean: Finite
    """Mean before the cut [s]"""
    std: Positive
    """Standard deviation before the cut [s]"""
    min: NonNegative = 0.0
    """Shortest delay [s]"""
    correlation: Correlation = 0.0
    """As for `uniform`"""


class Gamma(Table):
    """A random delay, gamma distributed above a smallest one: its mean is min + shape · scale, its variance shape · scale²."""

    kind: Literal["gamma"]
    """Kind of this delay"""
    shape: Shape
    """Shape k of the distribution; with 1 it is exponential"""
    scale: Positive
    """Scale θ of the distribution [s]"""
    min: NonNegative = 0.0
    """Shortest delay [s]"""
    correlation: Correlation = 0.0
    """As for `uniform`"""


class Pareto(Table):
    """A random delay with a heavy tail: P(delay > x) = (min/x)^shape."""

    kind: Literal["pareto"]
    """Kind of this delay"""
    min: Positive
    """Shortest delay [s]"""
    shape: Shape
    """Shape α.  The mean min · α/(α - 1) exists above 1, the variance above 2"""
    correlation: Correlation = 0.0
    """As for `uniform`"""


def _read(value: Any, info: ValidationInfo) -> Source:
    """Returns the file that a scenario names, with its text.  Raises PartError or ValueError."""
    if isinstance(value, Source):
        return value
    if not isinstance(value, str):
        raise ValueError("must be the name of a file, relative to the scenario")
    context: PartContext | None = info.context
    return read_source(value, context.folder if context else Path())


def _written(source: Source, info: SerializationInfo) -> str:
    """Returns the name of a file for a scenario that is written out; the context may map files to other names."""
    return str((info.context or {}).get(source, source.name))


FileField = Annotated[Source, PlainValidator(_read), PlainSerializer(_written), WithJsonSchema({"type": "string"})]


class Trace(Table):
    """Measured delays from a file, one-way and in seconds.

    The file is text: a delay on each line, or comma-separated columns; `lost` stands for a message that was lost.  Two columns
    are time and delay; a first line may name the columns.  Empty lines and what follows `#` are left out"""

    kind: Literal["trace"]
    """Kind of this delay"""
    file: FileField
    """The file, relative to the scenario; its text is kept in the run's folder"""
    by: Literal["message", "time"] = "message"
    """`message`: each message takes the next line, and after the last line the first one follows.  `time`: a message takes the
    last line whose time is not after the instant of sending [s of run time]; before the first line, the first one"""


def _kind(value: Any) -> str:
    """Returns the tag of the delay that a table is meant for."""
    if isinstance(value, BaseModel):
        return str(getattr(value, "kind", ""))
    kind = value.get("kind", "uniform")
    return kind if isinstance(kind, str) else ""


RandomDelay = Annotated[
    Annotated[Uniform, Tag("uniform")]
    | Annotated[Normal, Tag("normal")]
    | Annotated[Gamma, Tag("gamma")]
    | Annotated[Pareto, Tag("pareto")]
    | Annotated[Trace, Tag("trace")],
    Discriminator(_kind),
]
Delay = Annotated[
    Annotated[NonNegative, Tag("a number")] | Annotated[RandomDelay, Tag("a table")], Discriminator(number_or_table)
]


class BurstLoss(Table):
    """Loss in bursts (Gilbert and Elliott): the link is good or bad, and changes with given probabilities at each message.  The
    lengths of both times, in messages, are geometrically distributed."""

    mean: Annotated[float, Field(strict=True, ge=0, lt=1, allow_inf_nan=False)]
    """Share of messages that are lost in the mean"""
    burst: Annotated[float, Field(strict=True, ge=1, le=1e6, allow_inf_nan=False)]
    """Mean length of a bad time, in messages.  With 1/(1 - mean) losses are independent"""
    good: Fraction = 0.0
    """Probability that a message is lost while the link is good"""
    bad: Fraction = 1.0
    """Probability that a message is lost while the link is bad"""

    @model_validator(mode="after")
    def _feasible(self) -> "BurstLoss":
        if not self.good <= self.mean < self.bad:
            raise ValueError(
                f"mean = {self.mean} must be at least good = {self.good} and less than bad = {self.bad}, the losses between "
                "which the link changes"
            )
        least = (self.mean - self.good) / (self.bad - self.mean)
        if self.burst < least:
            raise ValueError(
                f"burst = {self.burst}: with so short bursts the mean loss cannot be {self.mean}; must be at least {least:.6g}"
            )
        return self


Loss = Annotated[
    Annotated[Fraction, Tag("a number")] | Annotated[BurstLoss, Tag("a table")], Discriminator(number_or_table)
]


class LinkRule(Table):
    """Delay and loss of links.  For each link the last rule that fits it holds, and only that one."""

    name: Name | None = None
    """Name of the rule, by which it can be addressed: `--set links.uplink.delay=0.05` instead of `links.0.delay=0.05`"""
    source: str = "**"
    """The sender: a path in the tree (`g1/r2`) or `coordinator`; `*` stands for one chunk of a path, `**` for any number"""
    receiver: str = "**"
    """The receiver, written as `source`"""
    channel: ChannelName = "*"
    """The channel; `*` stands for all channels"""
    delay: Delay = 0.0
    """How long a message takes [s]: a number, or a table of the kind `uniform`, `normal`, `gamma`, `pareto` or `trace`.  A
    receiver uses the message at its first instant at or after the arrival"""
    loss: Loss = 0.0
    """Probability that a message is lost, independent of all other messages; or a table of losses in bursts"""
    loss_of: Literal["receiver", "message"] = "receiver"
    """What is lost at once, where a source has several receivers: a message for one `receiver`, or the `message` for all"""
    duplicates: Fraction = 0.0
    """Probability that a message that is not lost comes twice; the second copy has a delay of its own, except with a trace"""
    order: Literal["any", "fifo"] = "any"
    """`any`: a message may overtake another one.  `fifo`: it arrives no earlier than those before it"""
    policy: Policy | None = None
    """What a receiver uses when nothing newer has come: the last message that came, for ever (`hold`) or until it is older
    than `timeout` (`hold_then_stop`); after that zero accelerations (`zero`: for `command` and `reference`); for `state` and
    `group_state`, the last states moved on with their last accelerations (`extrapolate`) or with those commanded since
    (`predict`).  Unless given: `hold` if torque is mirrored, `hold_then_stop` if the torque path is closed"""
    timeout: Seconds | None = None
    """Age above which a message is not used any more, for `hold_then_stop` and `zero` [s].  Unless given: for `hold_then_stop`
    `can.watchdog`, or two periods of the link if that is longer; for `zero` the largest delay of the link, and less than a
    period more"""

    @model_validator(mode="after")
    def _sense(self) -> "LinkRule":
        if self.name in type(self).model_fields:
            raise ValueError(f"name = {self.name!r}: is the name of a key")
        if self.timeout is not None and self.policy in ("hold", "extrapolate", "predict"):
            raise ValueError(f"timeout = {self.timeout}: policy = {self.policy!r} has none; leave it out")
        return self


class Clock(Table):
    """The clock of a process, from which it reads the ages of messages.  When a process acts does not depend on it."""

    offset: Annotated[float, Field(strict=True, ge=-1e6, le=1e6, allow_inf_nan=False)] | None = None
    """By how much it is ahead of the run time at the start [s]; 0 unless given"""
    drift: Annotated[float, Field(strict=True, ge=-0.1, le=0.1, allow_inf_nan=False)] | None = None
    """By how much it runs too fast [s/s]; 0 unless given.  A quartz has some 1e-5"""


class Blackout(Table):
    """Links that lose everything for some time."""

    kind: Literal["blackout"]
    """Kind of this event"""
    at: SecondsOrZero
    """When it begins [s of run time]; what is sent from now on is lost"""
    duration: Seconds | None = None
    """How long it lasts [s]; for ever unless given"""
    link: Name | None = None
    """Name of the rule in `links` whose links are meant; unless given, all links that `source`, `receiver` and `channel` fit"""
    source: str = "**"
    """The sender, written as in `links`"""
    receiver: str = "**"
    """The receiver, written as in `links`"""
    channel: ChannelName = "*"
    """The channel; `*` stands for all channels"""


class CutOff(Table):
    """Members that nobody hears and that hear nobody for some time.  They go on running."""

    kind: Literal["cut_off"]
    """Kind of this event"""
    at: SecondsOrZero
    """When it begins [s of run time]; what is sent from now on is lost"""
    duration: Seconds | None = None
    """How long it lasts [s]; for ever unless given"""
    member: str
    """The members: a path in the tree, which may hold `*` and `**`, or `coordinator`"""
