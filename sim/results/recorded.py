"""The messages between roles that a run recorded, as arrays: what each role sent on each channel.

Frames are recorded one by one, not as messages; so the messages between bridge and drives are not among them.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from math import gcd

import numpy as np
from numpy.typing import NDArray

from echelon.messages import NULL, Channel, Message
from echelon.plan.plan import Plan
from echelon.sim.results.arrivals import Arrivals
from echelon.sim.results.trace import Array


@dataclass(frozen=True, slots=True)
class Series:
    """The messages with values of one source on one channel, in the order of their sequence numbers."""

    source: int
    channel: Channel
    sequences: NDArray[np.int64]
    """Sequence numbers, (n,), without those of null messages"""
    times_ns: NDArray[np.int64]
    """Times of the messages [ns], (n,)"""
    values: Array
    """Values, (n, size)"""

    def before(self, until_ns: int) -> "Series":
        """Returns the messages of times before `until_ns`."""
        inside = self.times_ns < until_ns
        return replace(
            self, sequences=self.sequences[inside], times_ns=self.times_ns[inside], values=self.values[inside]
        )


@dataclass(frozen=True, slots=True)
class Recorded:
    """The messages of a run."""

    plan: Plan
    series: Mapping[tuple[int, Channel], Series]
    """By source and channel; channels without a message with values are absent"""
    nulls: Mapping[tuple[int, Channel], Mapping[int, int]]
    """By source and channel, the numbers of null messages, with their times [ns]"""
    metadata: Mapping[str, str]
    """What the recorder wrote about the run: engine, clock, versions"""
    scenario: str
    """The effective scenario as TOML, as the recording has it"""
    cut: bool
    """True if the file is cut off, so that its end is missing"""
    arrivals: Arrivals | None = None
    """On a wall clock when messages arrived; None in virtual time, and if it was not noted"""

    @property
    def by_arrival(self) -> bool:
        """True if the arrival of messages decided which of them were used: roles as processes on a wall clock."""
        return self.metadata.get("clock") == "wall" and self.metadata.get("engine") != "inprocess"

    @property
    def last_ns(self) -> int:
        """Time of the last message [ns]; -1 if there is none."""
        return max((int(series.times_ns[-1]) for series in self.series.values()), default=-1)

    def message(self, source: int, channel: Channel, number: int) -> Message | None:
        """Returns a message, if it was recorded."""
        series = self.series.get((source, channel))
        if series is not None:
            row = int(np.searchsorted(series.sequences, number))
            if row < len(series.sequences) and series.sequences[row] == number:
                return Message(channel, source, number, int(series.times_ns[row]), series.values[row])
        if (time_ns := self.nulls.get((source, channel), {}).get(number)) is not None:
            return Message(channel, source, number, time_ns, NULL)
        return None

    def heard_until_ns(self, member: int) -> int:
        """Returns the instant before which all is known that a member heard [ns]; on a wall clock when it arrived, too.

        It is the instant of `whole_until_ns`, or an earlier one."""
        until_ns, arrivals = self.whole_until_ns(), self.arrivals
        if arrivals is None:
            return until_ns
        until_ns = min(until_ns, arrivals.known_until_ns(member))
        for number, one in arrivals.links.items():
            link = self.plan.links[number]
            if link.receiver == member:
                missing = ~np.isin(one.numbers, self._numbers((link.source, link.channel)))
                until_ns = min(until_ns, int(one.counted_ns[missing].min(initial=until_ns)))
        return until_ns

    def whole_until_ns(self) -> int:
        """Returns the instant before which nothing is missing [ns]: one after the duration if the recording is whole.

        In virtual time robots and nodes send a message in every period, so a number that is missing shows that something was
        not recorded.  On a wall clock a recorder may miss messages, and a robot may fall silent; so there this is the end of
        the recording."""
        if self.by_arrival:
            return min(self.plan.duration_ns, self.last_ns) + 1
        formation = len(self.plan.formation)
        periods_ns = {
            (link.source, link.channel): link.period_ns for link in self.plan.links if link.source < formation
        }
        ends_ns = [self._first_missing(key) * period_ns for key, period_ns in periods_ns.items()]
        return min(self.plan.duration_ns + 1, *ends_ns)

    def _first_missing(self, key: tuple[int, Channel]) -> int:
        """Returns the first number of a message that was not recorded."""
        numbers = self._numbers(key)
        missing = np.flatnonzero(numbers != np.arange(len(numbers)))
        return int(missing[0]) if len(missing) else len(numbers)

    def _numbers(self, key: tuple[int, Channel]) -> NDArray[np.int64]:
        """Returns the numbers of the messages that were recorded, ascending."""
        series = self.series.get(key)
        numbers = np.array(sorted(self.nulls.get(key, ())), np.int64)
        return numbers if series is None else np.union1d(numbers, series.sequences)


def last_instant_ns(plan: Plan, until_ns: int) -> int:
    """Returns the last instant of a plan's robots and nodes before `until_ns` [ns]."""
    tick_ns = gcd(*[one.period_ns for one in plan.formation])
    return (until_ns - 1) // tick_ns * tick_ns
