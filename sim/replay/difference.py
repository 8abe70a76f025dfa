"""Two runs compared: the first instant, message and value at which they part."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from echelon.errors import UsageError
from echelon.messages import Channel
from echelon.plan.plan import Plan
from echelon.sim.replay.comparison import ChannelComparison, Difference, compare, earliest
from echelon.sim.replay.rendering import comparison_json, comparison_text, difference_json, difference_text
from echelon.sim.replay.value_names import value_names
from echelon.sim.results.recorded import Recorded, last_instant_ns

_COARSE: Final = "where periods differ, messages of the same time are compared, and those in between are left out"


@dataclass(frozen=True, slots=True)
class RunDifference:
    """The result of comparing two runs: per member and channel, how many messages are equal, and where they first differ.

    `str(difference)` is the table that `echelon diff` prints."""

    runs: tuple[str, str]
    until: float
    """Run time up to which they are compared [s]"""
    tolerance: float
    channels: tuple[ChannelComparison, ...]
    """Of the members and channels that both runs have"""
    first_difference: Difference | None
    """The first difference of all; None if there is none"""
    only_first: tuple[str, ...]
    """What only the first run has: member and channel"""
    only_second: tuple[str, ...]
    scenario: Mapping[str, tuple[str, str]]
    """What differs between the scenarios, and in how the runs were made: by key, both values as TOML writes them"""
    remarks: tuple[str, ...]
    """What limits the comparison"""

    @property
    def equal(self) -> bool:
        """True if both runs have the same members and channels, and say the same over the time that both recorded."""
        return not (self.only_first or self.only_second) and all(channel.is_equal for channel in self.channels)

    def to_json(self) -> dict[str, Any]:
        """Returns the result as JSON has it."""
        words = "first_run", "second_run"
        return {
            "runs": list(self.runs),
            "until": self.until,
            "tolerance": self.tolerance,
            "equal": self.equal,
            "first_difference": difference_json(self.first_difference, words),
            "channels": [comparison_json(channel, words) for channel in self.channels],
            "only_first_run": list(self.only_first),
            "only_second_run": list(self.only_second),
            "scenario": {key: list(values) for key, values in self.scenario.items()},
            "remarks": list(self.remarks),
        }

    def __str__(self) -> str:
        how = f"within {self.tolerance:g}" if self.tolerance else "exactly"
        lines = [f"A {self.runs[0]}, B {self.runs[1]}: compared {how}, up to t = {self.until:g} s"]
        lines += [f"  {remark}" for remark in self.remarks]
        lines += [f"  {key}: A {values[0]}, B {values[1]}" for key, values in self.scenario.items()]
        for name, lone in (("A", self.only_first), ("B", self.only_second)):
            lines += [f"  only {name} has {', '.join(lone)}"] if lone else []
        lines += comparison_text(self.channels, ("A", "B"))
        if self.first_difference is not None:
            lines.append(f"the runs part {difference_text(self.first_difference, ('A', 'B'))}")
        elif self.equal:
            lines.append("equal: over this time both runs say the same")
        else:
            lines.append("what both runs have is equal; but one has more than the other")
        return "\n".join(lines)


def difference(
    first: Recorded,
    second: Recorded,
    names: tuple[str, str],
    scenario: Mapping[str, tuple[str, str]],
    tolerance: float,
) -> RunDifference:
    """Compares two runs, member by member and channel by channel; members belong together by their paths.

    Messages belong together by their sequence numbers; where the periods differ, by their times, and the messages in between
    are left out.  Runs of different lengths are compared up to the end of the shorter one.  Raises UsageError if that leaves
    nothing to compare."""
    ends_ns = first.whole_until_ns(), second.whole_until_ns()
    until_ns = min(ends_ns)
    if until_ns <= 0:
        lacks = names[ends_ns.index(until_ns)]
        raise UsageError(f"{lacks}: the recording lacks messages from the start: nothing can be compared")
    kinds = [_kinds(run) for run in (first, second)]
    periods = [{(link.source, link.channel): link.period_ns for link in run.plan.links} for run in (first, second)]
    channels, coarse = [], False
    for kind, key in kinds[0].items():
        if (other := kinds[1].get(kind)) is None:
            continue
        by_time = periods[0].get(key) != periods[1].get(other)
        coarse = coarse or by_time
        channels.append(
            compare(
                first.plan,
                (first.series[key].before(until_ns), value_names(first.plan, *key)),
                (second.series[other].before(until_ns), value_names(second.plan, *other)),
                tolerance=tolerance,
                by_time=by_time,
                complete=not (by_time or first.by_arrival or second.by_arrival),
            )
        )
    if not channels:
        raise UsageError(f"{names[0]}, {names[1]}: have no member of the same path: nothing can be compared")
    return RunDifference(
        names,
        last_instant_ns(first.plan, until_ns) / 1e9,
        tolerance,
        tuple(channels),
        earliest(first.plan, channels),
        _lone(kinds[0], kinds[1]),
        _lone(kinds[1], kinds[0]),
        scenario,
        (*_remarks((first, second), names, ends_ns), *([_COARSE] if coarse else [])),
    )


def _kinds(run: Recorded) -> dict[tuple[str, Channel], tuple[int, Channel]]:
    """Returns source and channel of each recorded series by the member's path and channel."""
    return {(run.plan.all_roles[source].path, channel): (source, channel) for source, channel in run.series}


def _lone(kinds: Mapping[tuple[str, Channel], Any], others: Mapping[tuple[str, Channel], Any]) -> tuple[str, ...]:
    return tuple(
        f"{path or 'coordinator'} {channel.name.lower()}" for path, channel in kinds if (path, channel) not in others
    )


def _remarks(runs: Sequence[Recorded], names: Sequence[str], ends_ns: Sequence[int]) -> list[str]:
    remarks = []
    for run, name, end_ns in zip(runs, names, ends_ns, strict=True):
        if end_ns <= run.plan.duration_ns:
            why = "is cut off, and whole" if run.cut else "is whole"
            remarks.append(f"the recording of {name} {why} up to t = {_seconds(run.plan, end_ns)} s only")
    if ends_ns[0] != ends_ns[1]:
        shorter = ends_ns.index(min(ends_ns))
        ends = [_seconds(run.plan, end_ns) for run, end_ns in zip(runs, ends_ns, strict=True)]
        remarks.append(f"{names[shorter]} ends at t = {ends[shorter]} s, {names[1 - shorter]} at {ends[1 - shorter]} s")
    if any(run.by_arrival for run in runs):
        remarks.append("on a wall clock a recorder may miss messages: those that one run lacks count as no difference")
    return remarks


def _seconds(plan: Plan, until_ns: int) -> str:
    return f"{last_instant_ns(plan, until_ns) / 1e9:.9g}"
