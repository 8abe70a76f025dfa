"""From the links of a plan to arrays (`records`): streams of messages, and the links that read them."""

from collections.abc import Mapping
from typing import Any

from echelon.controller.late_states import EXTRAPOLATE, PREDICT
from echelon.messages import Channel
from echelon.plan.layout import NodeLayout, acceleration_of, length
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import (
    NodePlan,
    Plan,
)
from echelon.runtime.ages import EXACT
from echelon.sim.batch import records as r
from echelon.sim.batch.links import fates_of
from echelon.sim.batch.pools import Pools


class LinkMaker:
    """Makes the arrays of the streams and links of a plan."""

    def __init__(self, plan: Plan, pools: Pools) -> None:
        self.plan, self.pools = plan, pools
        self.numbers = {(link.source, link.receiver, link.channel): at for at, link in enumerate(plan.links)}
        """The numbers of the links"""
        self._of: dict[tuple[int, Channel], list[LinkPlan]] = {}
        for link in plan.links:
            self._of.setdefault((link.source, link.channel), []).append(link)
        self.streams = {source: at for at, source in enumerate(self._of)}
        """The numbers of the streams: every source and channel that a link begins with, in the order of the links"""

    def make(self) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
        """Returns the records of the streams and of the links."""
        streams = [self._stream(source, channel) for source, channel in self.streams]
        links = [
            self._link(at, streams[self.streams[link.source, link.channel]]) for at, link in enumerate(self.plan.links)
        ]
        return streams, links

    def _depth(self, source: int, channel: Channel) -> int:
        """Returns how many messages of a stream are kept: a power of two, above those in flight at any time."""
        most = 1
        for link in self._of[source, channel]:
            if not link.prompt:
                # A message may be sent a period late, and is asked for a period of the receiver later.
                asked_ns = self.plan.formation[link.receiver].period_ns
                late_ns = min(link.delay_max_ns, self.plan.duration_ns) + asked_ns
                most = max(most, late_ns // link.period_ns + 4)
        return 1 << (most - 1).bit_length()

    def _stream(self, source: int, channel: Channel) -> dict[str, Any]:
        depth = self._depth(source, channel)
        length = self.state_length(source) if channel is Channel.STATE else self._of[source, channel][0].size or 0
        return {
            "length": length,
            "mask": depth - 1,
            "at": self.pools.real(depth * length),
            "marks_at": self.pools.whole(1 + 2 * depth),
        }

    def state_length(self, robot: int) -> int:
        """Returns how many values of a robot's STATE are used: position and velocity, and its acceleration if a node moves late
        states on with it."""
        extrapolated = (link.policy == EXTRAPOLATE for link in self.plan.links if link.source == robot)
        return 6 if any(extrapolated) else 4

    def _link(self, at: int, stream: Mapping[str, Any]) -> dict[str, Any]:
        plan, pools, link = self.plan, self.pools, self.plan.links[at]
        parts = self._parts(at)
        size = 0 if link.prompt else max(first + count for first, count in parts)
        shift = parts[0][0] if len(parts) == 1 and size else 0  # of one part only that part is kept
        record = {
            "length": stream["length"],
            "mask": stream["mask"],
            "stream_at": stream["at"],
            "stream_marks_at": stream["marks_at"],
            "prompt": link.prompt,
            "timeout_ns": link.timeout_ns,
            "end_ns": plan.duration_ns,
            "at": pools.real(size - shift) - shift,
            "brought": self._brought(link),
            "odd_clocks": not link.clocks_are_true,
            "of_robot": link.channel is Channel.STATE,
            "zeros_at": pools.real(stream["length"]) if link.policy == "zero" else -1,
            "marks_at": pools.whole(r.LINK_WHOLES + (0 if link.prompt else 2 * stream["mask"] + 2)),
        } | fates_of(link, pools)
        for number, (first, count) in enumerate(parts, start=1):
            record |= {f"first_{number}": first, f"size_{number}": count}
        return record

    def _brought(self, link: LinkPlan) -> int:
        """Returns how late states of a link are brought to the present."""
        if link.channel not in (Channel.STATE, Channel.GROUP_STATE):
            return r.AS_THEY_ARE
        otherwise = r.WITH_REFERENCE if self.plan.reference == "message" else r.AS_THEY_ARE
        return {EXTRAPOLATE: r.EXTRAPOLATED, PREDICT: r.PREDICTED}.get(link.policy, otherwise)

    def ages(self, link: LinkPlan) -> dict[str, int]:
        """Returns where the ages of a link's messages are counted."""
        pools, duration_ns, receiver = self.pools, self.plan.duration_ns, self.plan.formation[link.receiver]
        acts_late = receiver.event_driven and not all(each.prompt for each in self.plan.links_into(link.receiver))
        # A message is used once in each period of the receiver, and when it arrives or becomes too old.
        most = duration_ns // receiver.period_ns + 3 * (duration_ns // link.period_ns) + 4
        if link.prompt and not acts_late and receiver.period_ns % link.period_ns == 0:
            most = 0  # it is always new
        # Twice as many slots as can be needed: an age is found at once.
        slots = 1 << max(1, 2 * min(most, EXACT) - 1).bit_length()
        return {
            "ages_at": pools.whole(2 * slots),
            "ages_mask": slots - 1,
            "bins": duration_ns.bit_length() << 7 if most > EXACT else 0,
        }

    def _parts(self, at: int) -> list[tuple[int, int]]:
        """Returns what a receiver uses of the messages of a link: places and lengths."""
        link, plan = self.plan.links[at], self.plan
        receiver = plan.formation[link.receiver]
        if link.channel is Channel.STATE:
            return [(0, self.state_length(link.source))]
        if link.channel is Channel.GROUP_STATE:
            return [(0, link.size or 0)]
        slices = [acceleration_of(receiver)]
        if link.channel is Channel.REFERENCE and isinstance(receiver, NodePlan):
            mine = NodeLayout.of(plan, receiver).mine
            assert mine is not None
            slices += [part for part in (mine.rates, mine.forces) if length(part)]
        return [(part.start, length(part)) for part in slices]
