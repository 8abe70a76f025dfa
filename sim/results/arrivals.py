"""The arrivals of a run on a wall clock: for each link, when its messages were sent, and when they arrived."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echelon.plan.delay_tables import LOST, DelayTrace
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan

Whole = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class LinkArrivals:
    """The messages of one link that arrived, in the order of their numbers."""

    numbers: Whole
    """Numbers of the messages, (n,)"""
    sent_ns: Whole
    """Instants of sending, as the messages' headers have them [ns], (n,)"""
    arrived_ns: Whole
    """Instants of arrival [ns], (n,); not before those of sending"""
    counted_ns: Whole
    """Instants from which on the receiver counted them as arrived [ns], (n,): earlier where it was late itself"""

    @property
    def latencies_ns(self) -> Whole:
        """Times from sending to arrival [ns], (n,)."""
        found: Whole = self.arrived_ns - self.sent_ns
        return found


@dataclass(frozen=True, slots=True)
class Arrivals:
    """The arrivals of a run."""

    plan: Plan
    links: Mapping[int, LinkArrivals]
    """By the link's number in the plan: all links into robots and nodes"""
    ends_ns: Mapping[int, int]
    """For each member that ended in order, by its index, the first instant for which it did nothing more [ns]"""
    damaged: bool
    """True if the file is damaged; what stands behind the damage is left out"""

    def known_until_ns(self, member: int) -> int:
        """Returns the instant up to which all arrivals at a member are known [ns]: -1 if none is, one after the duration if all
        are."""
        if member in self.ends_ns:
            return self.plan.duration_ns + 1
        last = [
            int(one.counted_ns.max())
            for number, one in self.links.items()
            if self.plan.links[number].receiver == member and len(one.counted_ns)
        ]
        return max(last, default=-1)

    def sent(self, number: int) -> int:
        """Returns how many messages were sent on a link, by number.

        A source that ended in order has sent all that were due until then; of others those count that have arrived anywhere."""
        link, links = self.plan.links[number], self.plan.links
        numbers = [
            int(one.numbers[-1]) + 1
            for other, one in self.links.items()
            if len(one.numbers) and (links[other].source, links[other].channel) == (link.source, link.channel)
        ]
        if (end_ns := self.ends_ns.get(link.source)) is not None:
            numbers.append((min(end_ns - 1, self.plan.duration_ns) - link.first_ns) // link.period_ns + 1)
        return max(numbers, default=0)

    def trace(self, number: int) -> DelayTrace:
        """Returns the delays with which a link in virtual time does the same, by number: of all messages that are due in the
        run; lost where none arrived."""
        link, one = self.plan.links[number], self.links[number]
        delays = np.full(due_in(self.plan, link), LOST, np.int64)
        inside = one.numbers < len(delays)
        delays[one.numbers[inside]] = (one.counted_ns - one.sent_ns)[inside]
        return DelayTrace(tuple(delays.tolist()))


def due_in(plan: Plan, link: LinkPlan) -> int:
    """Returns how many messages of a link are due in a run."""
    return (plan.duration_ns - link.first_ns) // link.period_ns + 1
