"""Comparisons as text and as JSON."""

from collections.abc import Sequence
from math import isfinite
from typing import Any, Final

from echelon.messages import Channel
from echelon.sim.replay.comparison import ChannelComparison, Difference
from echelon.sim.replay.value_names import unit_of

Words = tuple[str, str]
"""What the first and the second series are called"""
NOTHING: Final = "–"
MOST_LINES: Final = 40
"""How many lines a table may have before members without a difference share a line"""


def difference_text(difference: Difference, words: Words) -> str:
    """Returns in words where two series differ, with both values in full."""
    first, second = words
    member, channel = difference.member, difference.channel.name.lower()
    where = f"at t = {difference.time:.9g} s: {member}, {channel} number {difference.sequence}"
    if difference.lacking:
        there, lacks = (second, first) if difference.lacking == "first" else (first, second)
        return f"{where}: {there} only, none {lacks}"
    return f"{where}, {difference.value}: {first} {difference.first!r}, {second} {difference.second!r}"


def comparison_text(channels: Sequence[ChannelComparison], words: Words) -> list[str]:
    """Returns a table with a line for each member and channel.  If it would have more than `MOST_LINES`, members of whose
    channel everything is the same share a line."""
    lone = any(channel.only_first or channel.only_second for channel in channels)
    counts = ["messages", "equal", *((f"{words[0]} only", f"{words[1]} only") if lone else ())]
    rows = [["member", "channel", *counts, f"first difference ({words[0]}, {words[1]})", "largest difference"]]
    shared = {channel: [each for each in channels if each.channel is channel and _is_same(each)] for channel in Channel}
    for each in channels:
        same = shared[each.channel] if len(channels) > MOST_LINES and _is_same(each) else [each]
        if same[0] is each:
            name = each.member if len(same) == 1 else f"{len(same)} members"
            sums = [sum(numbers) for numbers in zip(*map(_counts, same), strict=True)][: len(counts)]
            row = [name, each.channel.name.lower(), *map(str, sums), _first(each, words), _largest(each)]
            rows.append(row)
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    right = range(2, 2 + len(counts))
    return [
        "  "
        + "  ".join(
            text.rjust(width) if column in right else text.ljust(width)
            for column, (text, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in rows
    ]


def _counts(channel: ChannelComparison) -> tuple[int, ...]:
    return channel.compared, channel.equal, channel.only_first, channel.only_second


def _is_same(channel: ChannelComparison) -> bool:
    """Returns whether all messages are the same and in both series."""
    return channel.is_equal and channel.largest is None and not (channel.only_first or channel.only_second)


def _first(channel: ChannelComparison, words: Words) -> str:
    first = channel.first_difference
    if first is None and not channel.unshared:
        return NOTHING
    if first is None:
        return f"{len(channel.unshared)} values in one alone: {channel.unshared[0]} …"
    where = f"t = {first.time:.9g} s, #{first.sequence}"
    if first.lacking:
        return f"{where}: {words[1] if first.lacking == 'first' else words[0]} only"
    return f"{where}, {first.value}: {', '.join(_apart(first))}"


def _apart(difference: Difference) -> tuple[str, str]:
    """Returns both values with as many digits as it takes to tell them apart, six at least."""
    assert difference.first is not None
    assert difference.second is not None
    for digits in range(6, 18):
        texts = f"{difference.first:.{digits}g}", f"{difference.second:.{digits}g}"
        if texts[0] != texts[1]:
            break
    return texts


def _largest(channel: ChannelComparison) -> str:
    largest = channel.largest
    if largest is None:
        return NOTHING
    size = _distance(largest)
    words = "not finite" if size is None else f"{size:.3g} {unit_of(largest.value)}".rstrip()
    return f"{words}, {largest.value}, t = {largest.time:.9g} s"


def _distance(difference: Difference) -> float | None:
    """Returns |first - second|; None if it is not finite."""
    assert difference.first is not None
    assert difference.second is not None
    size = abs(difference.first - difference.second)
    return size if isfinite(size) else None


def difference_json(difference: Difference | None, words: Words) -> dict[str, Any] | None:
    """Returns a difference as JSON has it, None for None; a value that is not finite is a string."""
    if difference is None:
        return None
    first, second = words
    return {
        "time": difference.time,
        "sequence": difference.sequence,
        "member": difference.member,
        "channel": difference.channel.name.lower(),
        "value": difference.value or None,
        first: _value(difference.first),
        second: _value(difference.second),
        "lacking": {"": None, "first": first, "second": second}[difference.lacking],
    }


def comparison_json(channel: ChannelComparison, words: Words) -> dict[str, Any]:
    """Returns the comparison of a channel as JSON has it."""
    first, second = words
    largest = difference_json(channel.largest, words)
    if largest is not None and channel.largest is not None:
        largest["difference"] = _distance(channel.largest)
    return {
        "member": channel.member,
        "channel": channel.channel.name.lower(),
        "compared": channel.compared,
        "equal": channel.equal,
        f"only_{first}": channel.only_first,
        f"only_{second}": channel.only_second,
        "first_difference": difference_json(channel.first_difference, words),
        "largest": largest,
        "unshared": list(channel.unshared),
    }


def _value(value: float | None) -> float | str | None:
    return value if value is None or isfinite(value) else str(value)
