"""A replay: a recording's messages fed to today's roles, and what they send compared with what was recorded."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np

from echelon.errors import UsageError
from echelon.messages import Channel
from echelon.plan.layout import message_sizes_of
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Plan
from echelon.sim.replay.comparison import ChannelComparison, Difference, compare, earliest
from echelon.sim.replay.feeding import Feeding
from echelon.sim.replay.rendering import comparison_json, comparison_text, difference_json, difference_text
from echelon.sim.replay.value_names import value_names
from echelon.sim.results.recorded import Recorded, Series, last_instant_ns

WORDS = "recorded", "computed"
"""What the two sides of the comparison are called"""


@dataclass(frozen=True, slots=True)
class Replay:
    """The result of a replay: per role and channel, how many messages are equal, and where they first differ.

    In each comparison the recorded messages come first, the computed ones second.  `str(replay)` is the table that
    `echelon replay` prints."""

    run: str
    """The run that was replayed"""
    roles: tuple[str, ...]
    """The roles that were fed"""
    until: float
    """Run time up to which outputs are compared [s]"""
    tolerance: float
    channels: tuple[ChannelComparison, ...]
    first_difference: Difference | None
    """The first difference of all; None if all outputs are equal"""
    remarks: tuple[str, ...]
    """What limits the replay"""

    @property
    def equal(self) -> bool:
        """True if all outputs are equal."""
        return all(channel.is_equal for channel in self.channels)

    def to_json(self) -> dict[str, Any]:
        """Returns the result as JSON has it."""
        return {
            "run": self.run,
            "roles": list(self.roles),
            "until": self.until,
            "tolerance": self.tolerance,
            "equal": self.equal,
            "first_difference": difference_json(self.first_difference, WORDS),
            "channels": [comparison_json(channel, WORDS) for channel in self.channels],
            "remarks": list(self.remarks),
        }

    def __str__(self) -> str:
        how = f"within {self.tolerance:g}" if self.tolerance else "exactly"
        roles = f"{len(self.roles)} roles fed" if len(self.roles) > 1 else f"{self.roles[0]} fed"
        lines = [f"{self.run}: {roles}; what they say compared {how} with the recording, up to t = {self.until:g} s"]
        lines += [f"  {remark}" for remark in self.remarks]
        lines += comparison_text(self.channels, WORDS)
        if self.first_difference is None:
            lines.append("equal: these roles say what was recorded")
        else:
            lines.append(f"outputs differ first {difference_text(self.first_difference, WORDS)}")
        return "\n".join(lines)


def chosen(plan: Plan, only: Sequence[str]) -> list[int]:
    """Returns the indices of the robots and nodes that `only` names, all if it is empty.  A group's path stands for the group
    with all below it.

    Raises UsageError for a name that stands for no robot and no node."""
    if not only:
        return [one.index for one in plan.formation]
    found: set[int] = set()
    for name in only:
        members = [one.index for one in plan.formation if one.name == name or one.name.startswith(f"{name}/")]
        if not members:
            if name in ("bridge", "drives"):
                raise UsageError(
                    f"{name}: cannot be replayed: frames are recorded one by one, not as what {name} heard"
                )
            known = [one.name for one in plan.formation]
            close = get_close_matches(name, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"nodes are {', '.join(one.name for one in plan.nodes)}"
            raise UsageError(f"{name}: no robot and no node of this run; {hint}")
        found.update(members)
    return sorted(found)


def check_fit(recorded: Plan, plan: Plan, indices: Sequence[int]) -> None:
    """Raises UsageError, in one line, unless the roles of `plan` hear and send what was recorded with `recorded`: the same
    members, and for each role the same channels, periods and numbers of values."""
    theirs, ours = ([one.name for one in each.formation] for each in (recorded, plan))
    if theirs != ours:
        odd = [f"has {name}, the recording does not" for name in ours if name not in theirs]
        odd += [f"lacks {name}, which the recording has" for name in theirs if name not in ours]
        what = odd[0] if odd else "has the members in another order"
        raise UsageError(f"the scenario {what}: replay needs the same tree")
    links = {(link.source, link.channel): link for link in recorded.links}
    for index in indices:
        name = plan.formation[index].name
        heard = [
            (link, f"{name} hears {link.channel.name.lower()} of {plan.all_roles[link.source].name}")
            for link in plan.links_into(index)
        ]
        sent = {link.channel: link for link in plan.links if link.source == index}
        for link, what in [*heard, *((link, f"{name} sends {link.channel.name.lower()}") for link in sent.values())]:
            _check_link(links.get((link.source, link.channel)), link, what)
        lacking = [channel for channel in message_sizes_of(recorded, recorded.formation[index]) if channel not in sent]
        if lacking:
            raise UsageError(
                f"{name} sends no {lacking[0].name.lower()}, which was recorded: replay needs the same channels"
            )


def _check_link(recorded: LinkPlan | None, link: LinkPlan, what: str) -> None:
    if recorded is None:
        raise UsageError(f"{what}, which was not recorded: replay needs the same channels")
    if recorded.period_ns != link.period_ns:
        periods = f"every {link.period_ns / 1e6:g} ms, recorded every {recorded.period_ns / 1e6:g} ms"
        raise UsageError(f"{what} {periods}: replay needs the same periods")
    if recorded.size != link.size:
        raise UsageError(
            f"{what} with {link.size} values, recorded with {recorded.size}: coupling and avoidance must be on or off as then"
        )


class Replaying:
    """A replay in progress: of `recorded`, with the roles of `plan` that have these indices.

    Raises UsageError if they do not fit the recording, or if there is nothing to compare."""

    def __init__(self, recorded: Recorded, plan: Plan, indices: Sequence[int], tolerance: float) -> None:
        check_fit(recorded.plan, plan, indices)
        self._recorded, self._plan, self._indices, self._tolerance = recorded, plan, indices, tolerance
        self._until_ns = min(recorded.whole_until_ns(), plan.duration_ns + 1)
        if self._until_ns <= 0:
            raise UsageError("the recording lacks messages from the start: nothing can be replayed")
        self._until_s = last_instant_ns(plan, self._until_ns) / 1e9
        self._heard_until_ns = {index: min(recorded.heard_until_ns(index), self._until_ns) for index in indices}
        self._feeding = Feeding(plan, recorded, self._heard_until_ns)

    def instants(self) -> Iterator[int]:
        """Feeds all roles; yields an instant [ns] when a role is done with it.  Raises PartRunError if a part fails."""
        return self._feeding.instants()

    def result(self, run: str, remarks: Sequence[str] = ()) -> Replay:
        """Returns the result, after all instants; `run` names the run."""
        plan, computed = self._plan, self._feeding.series
        channels = []
        for index in self._indices:
            for channel in message_sizes_of(plan, plan.formation[index]):
                key, names = (index, channel), value_names(plan, index, channel)
                until_ns = self._heard_until_ns[index]
                said = self._recorded.series.get(key, _nothing(*key, len(names))).before(until_ns)
                now = computed.get(key, _nothing(*key, len(names))).before(until_ns)
                channels.append(
                    compare(
                        plan,
                        (said, names),
                        (now, names),
                        tolerance=self._tolerance,
                        complete=not self._recorded.by_arrival,
                    )
                )
        return Replay(
            run,
            tuple(plan.formation[index].name for index in self._indices),
            self._until_s,
            self._tolerance,
            tuple(channels),
            earliest(plan, channels),
            (*remarks, *self._remarks()),
        )

    def _remarks(self) -> Iterator[str]:
        recorded, until_ns = self._recorded, self._until_ns
        if until_ns <= self._plan.duration_ns:
            why = "is cut off" if recorded.cut else "lacks messages"
            until = f"{self._until_s:.9g} s of {self._plan.duration_ns / 1e9:g} s"
            yield f"the recording {why}: it is whole up to t = {until}, and nothing is compared from there on"
        short = {index: end_ns for index, end_ns in self._heard_until_ns.items() if end_ns < until_ns}
        if short:
            index, end_ns = min(short.items(), key=lambda each: each[1])
            others = f", and of {len(short) - 1} more not to the end either" if len(short) > 1 else ""
            yield (
                f"not all that roles heard is known: of {self._plan.formation[index].name} outputs are compared up to "
                f"t = {max(end_ns, 0) / 1e9:.9g} s{others}"
            )
        if self._plan.bus_roles:
            yield "bridge and drives are not replayed: robots get the wheel torques that the bridge reported then"


def _nothing(source: int, channel: Channel, size: int) -> Series:
    return Series(source, channel, np.empty(0, np.int64), np.empty(0, np.int64), np.empty((0, size)))
