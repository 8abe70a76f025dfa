"""A link of a plan: which messages it carries, and what it does to them."""

from dataclasses import dataclass, field

from echelon.messages import Channel
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.delay_tables import LOST, TRUE_CLOCK, Bursts, ClockPlan, DelayTable, DelayTrace, Windows


@dataclass(frozen=True, slots=True)
class LinkPlan:
    """A directed link, applied at its receiver (docs/architecture.md, 4): numbers that tell the fate of its messages
    (`echelon.runtime.fates`), and what the receiver does without them."""

    source: int
    receiver: int
    channel: Channel
    period_ns: int
    delay_min_ns: int = 0
    """Smallest delay of a message [ns]"""
    delay_max_ns: int = 0
    """Largest delay of a message [ns]"""
    loss: float = 0.0
    """Share of messages that are lost in the mean; without `bursts` each is lost with this probability, by itself"""
    timeout_ns: int = NEVER_NS
    """Age above which a message is not used any more [ns] (policies `hold_then_stop` and `zero`); `NEVER_NS` with the others"""
    first_ns: int = 0
    """Run time of message number 0; negative between bridge and drives, which bring the drives up before run time 0"""
    size: int | None = None
    """Number of values of a message that is not null (echelon.plan.layout); None: any number"""
    punctual: bool = True
    """True if its source always sends at the nominal instants (docs/architecture.md, 4.6)"""
    name: str = ""
    """Name of the scenario's rule that holds for the link; empty if it has none"""
    policy: str = "hold"
    """What the receiver uses when nothing newer has come (echelon.scenario.link_tables.Policy)"""
    delays: DelayTable | DelayTrace | None = field(default=None, repr=False)
    """The delays; None: constant, or uniform between the smallest and the largest"""
    bursts: Bursts | None = None
    """Loss in bursts; None: each message is lost by itself"""
    loss_of_message: bool = False
    """True: a message that is lost is lost for all receivers at once"""
    duplicates: float = 0.0
    """Probability that a message that is not lost comes a second time, after a delay of its own"""
    fifo: bool = False
    """True: no message arrives before those that were sent before it"""
    blackouts: Windows = ()
    """Windows of time [ns]; what is sent in them is lost"""
    source_clock: ClockPlan = TRUE_CLOCK
    """The clock by which messages are stamped"""
    receiver_clock: ClockPlan = TRUE_CLOCK
    """The clock by which the receiver reads their age"""

    def read_age_ns(self, time_ns: int, sent_ns: int) -> int:
        """Returns the age [ns] that a receiver reads at `time_ns` off a message sent at `sent_ns`: the true age if both clocks
        show the run time."""
        if self.clocks_are_true:
            return time_ns - sent_ns
        return self.receiver_clock.reading_ns(time_ns) - self.source_clock.reading_ns(sent_ns)

    @property
    def clocks_are_true(self) -> bool:
        """True if the clocks of sender and receiver both show the run time."""
        return self.source_clock.is_true and self.receiver_clock.is_true

    def expires_ns(self, sent_ns: int) -> int:
        """Returns the first instant at which a receiver finds a message too old that was sent at `sent_ns` [ns]."""
        if self.timeout_ns >= NEVER_NS:
            return NEVER_NS
        expires_ns = sent_ns + self.timeout_ns + 1
        while (lacking_ns := self.timeout_ns + 1 - self.read_age_ns(expires_ns, sent_ns)) > 0:
            expires_ns += lacking_ns
        while self.read_age_ns(expires_ns - 1, sent_ns) > self.timeout_ns:
            expires_ns -= max(1, self.read_age_ns(expires_ns - 1, sent_ns) - self.timeout_ns)
        return expires_ns

    @property
    def ideal(self) -> bool:
        """True if the link has no delay and no loss: a message is in use from the instant at which it is sent."""
        return (
            self.delay_max_ns == 0
            and self.loss == 0.0
            and not self.duplicates
            and not self.blackouts
            and not self.delays
        )

    @property
    def steady(self) -> bool:
        """True if the link loses nothing, blackouts aside, and all of its messages take the same time."""
        return self.loss == 0.0 and self.delay_min_ns == self.delay_max_ns and not self.delays

    @property
    def share_lost(self) -> float:
        """The share of messages that the link loses, blackouts aside; of a trace it is the share of its entries."""
        in_trace = 0.0
        if isinstance(self.delays, DelayTrace):
            in_trace = self.delays.delays_ns.count(LOST) / len(self.delays.delays_ns)
        return 1 - (1 - self.loss) * (1 - in_trace) if in_trace else self.loss

    @property
    def prompt(self) -> bool:
        """True if each message is in use from its nominal instant on: the link is ideal, and its source is punctual."""
        return self.punctual and self.ideal
