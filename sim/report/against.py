"""What several runs measured, as rows below what differs between their scenarios."""

from collections.abc import Callable, Sequence

from echelon.sim.results.measure_records import BlockResult
from echelon.sim.results.records import Summary
from echelon.sim.results.summary import number

ABSENT = "–"
"""Shown for what a run does not have"""


def measured(summaries: Sequence[Summary]) -> list[list[str]]:
    """Returns a row for each thing that was measured: its name, then its value in each run."""
    rows = [["verdict", *(one.verdict.word for one in summaries)]]
    for title, unit, value in _OF_BLOCKS:
        names = dict.fromkeys(block.name for one in summaries for block in one.blocks)
        for name in names:
            rows.append([f"{title} of {name}", *(_of_block(one, name, value, unit) for one in summaries)])
    for channel in dict.fromkeys(link.channel for one in summaries for link in one.links):
        rows.append([f"age of {channel} messages, p95, worst link", *(_age(one, channel) for one in summaries)])
        rows.append([f"lost {channel} messages", *(_lost(one, channel) for one in summaries)])
    rows.append(["smallest distance of two robots", *(_text(one.distance.smallest, "m") for one in summaries)])
    return [row for row in rows if set(row[1:]) != {ABSENT}]


_OF_BLOCKS: tuple[tuple[str, str, Callable[[BlockResult], float | None]], ...] = (
    ("settling to 2 %", "s", lambda block: block.settling_2),
    ("∫|e|² dt", "m² s", lambda block: block.ise),
    ("largest error", "m", lambda block: block.peak_error),
)


def _of_block(summary: Summary, name: str, value: Callable[[BlockResult], float | None], unit: str) -> str:
    found = next((block for block in summary.blocks if block.name == name), None)
    return ABSENT if found is None else _text(value(found), unit)


def _age(summary: Summary, channel: str) -> str:
    ages = [link.age_p95 for link in summary.links if link.channel == channel and link.age_p95 is not None]
    return _text(max(ages), "s") if ages else ABSENT


def _lost(summary: Summary, channel: str) -> str:
    links = [link for link in summary.links if link.channel == channel]
    sent, lost = sum(link.sent for link in links), sum(link.lost for link in links)
    return f"{100 * lost / sent:.3g} %" if sent else ABSENT


def _text(value: float | None, unit: str) -> str:
    return ABSENT if value is None else number(value, unit)
