"""The latencies of a run on a wall clock: how long the messages of each link took, and how many were lost."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Final

import numpy as np

from echelon.sim.results.arrivals import Arrivals, LinkArrivals
from echelon.sim.results.tables import LINK_KEYS, Table

PERCENTILES: Final = (0.5, 0.95, 0.99)
MOST_LINES: Final = 60
"""How many links a table in a terminal has at most; if there are more, it has a line for each channel"""
LATENCY_KEYS: Final = ("latency_mean", "latency_p50", "latency_p95", "latency_p99", "latency_max", "jitter")


@dataclass(frozen=True, slots=True)
class LinkLatency:
    """The latencies of a link; sent = delivered + lost + in_flight.

    A latency is the time from the instant of sending, which a message has in its header, to its arrival at the receiver [s].
    It contains what the sender computes from its inputs, and the delay that the scenario gives the link.
    All latencies are None if no message arrived."""

    source: str
    receiver: str
    channel: str
    sent: int
    delivered: int
    lost: int
    """Messages that had not come when a later one came"""
    in_flight: int
    """The last messages, if they had not come when the run ended"""
    latency_mean: float | None
    latency_p50: float | None
    """The latency that half of the messages do not exceed"""
    latency_p95: float | None
    latency_p99: float | None
    latency_max: float | None
    jitter: float | None
    """Mean of the absolute differences between latencies of successive messages that arrived [s]"""


@dataclass(frozen=True, slots=True)
class Latencies:
    """The latencies of a run.  `str(latencies)` is the table that `echelon latencies` prints.

    latencies.links                  what is told of each link
    latencies.table                  the same as a table, with `to_pandas()`
    latencies.messages               each message that arrived, with its latency: a table, too
    """

    run: str
    """The run"""
    arrivals: Arrivals
    links: tuple[LinkLatency, ...]

    @classmethod
    def of(cls, run: str, arrivals: Arrivals) -> "Latencies":
        """Returns the latencies from the arrivals of a run."""
        return cls(run, arrivals, tuple(_of_link(arrivals, number) for number in arrivals.links))

    @property
    def table(self) -> Table:
        """A row for each link: the fields of `LinkLatency`."""
        kinds = dict.fromkeys(LINK_KEYS, object) | dict.fromkeys(LATENCY_KEYS, float)
        columns = {
            field.name: np.array([getattr(link, field.name) for link in self.links], kinds.get(field.name, int))
            for field in fields(LinkLatency)
        }
        return Table("latencies", LINK_KEYS, columns)

    @property
    def messages(self) -> Table:
        """A row for each message that arrived: its link, its number, when it was sent and how long it took [s]."""
        counts = [len(one.numbers) for one in self.arrivals.links.values()]
        columns = {
            key: np.repeat(np.array([getattr(link, key) for link in self.links], object), counts) for key in LINK_KEYS
        }
        each = list(self.arrivals.links.values())
        columns["number"] = np.concatenate([one.numbers for one in each])
        columns["t"] = np.concatenate([one.sent_ns for one in each]) / 1e9
        columns["latency"] = np.concatenate([one.latencies_ns for one in each]) / 1e9
        return Table("arrivals", (*LINK_KEYS, "number"), columns)

    def to_json(self) -> dict[str, Any]:
        """Returns the result as JSON has it."""
        return {"run": self.run, "damaged": self.arrivals.damaged, "links": [asdict(link) for link in self.links]}

    def __str__(self) -> str:
        links = self.links
        lines = [f"{self.run}: one-way latencies of {len(links)} links [ms]"]
        if self.arrivals.damaged:
            lines.append("  the file of arrivals is damaged: what stands behind the damage is left out")
        rows = [(f"{link.source} → {link.receiver}", link.channel, link) for link in links]
        together = {
            channel: [
                number for number, link in zip(self.arrivals.links, links, strict=True) if link.channel == channel
            ]
            for channel in dict.fromkeys(link.channel for link in links)
        }
        sums = [(f"{len(numbers)} links", channel, self._sum(numbers)) for channel, numbers in together.items()]
        if len(rows) > MOST_LINES:
            lines += ["  a line for each channel; --json has all links", *_lines(sums)]
        else:
            lines += _lines([*rows, *(each for each in sums if len(together[each[1]]) > 1)])
        return "\n".join(lines)

    def _sum(self, numbers: Sequence[int]) -> LinkLatency:
        """Returns the latencies of several links as if they were one."""
        ones = [self.arrivals.links[number] for number in numbers]
        told = [link for number, link in zip(self.arrivals.links, self.links, strict=True) if number in set(numbers)]
        counts = (sum(getattr(link, name) for link in told) for name in ("sent", "delivered", "lost", "in_flight"))
        return LinkLatency("", "", "", *counts, *_told(ones))


def _of_link(arrivals: Arrivals, number: int) -> LinkLatency:
    """Returns the latencies of a link, by its number in the plan."""
    plan, one = arrivals.plan, arrivals.links[number]
    link, members = plan.links[number], plan.all_roles
    sent, delivered = arrivals.sent(number), len(one.numbers)
    reached = int(one.numbers[-1]) + 1 if delivered else 0
    return LinkLatency(
        members[link.source].name,
        members[link.receiver].name,
        link.channel.name.lower(),
        sent,
        delivered,
        reached - delivered,
        sent - reached,
        *_told([one]),
    )


def _told(ones: Sequence[LinkArrivals]) -> list[float | None]:
    """Returns mean, percentiles, largest latency, and jitter of the messages of some links [s]."""
    latencies = np.concatenate([one.latencies_ns for one in ones])
    if not latencies.size:
        return [None] * 6
    steps = np.concatenate([np.abs(np.diff(one.latencies_ns)) for one in ones])
    shares = np.quantile(latencies, PERCENTILES, method="inverted_cdf")
    found = (latencies.mean(), *shares, latencies.max(), steps.mean() if steps.size else 0.0)
    return [float(each) / 1e9 for each in found]


def _lines(rows: Sequence[tuple[str, str, LinkLatency]]) -> list[str]:
    """Returns the lines of a table of links."""
    head = ["link", "channel", "sent", "lost", "in flight", "p50", "p95", "p99", "largest", "jitter"]
    texts = [head]
    for name, channel, link in rows:
        told = link.latency_p50, link.latency_p95, link.latency_p99, link.latency_max, link.jitter
        times = ["–" if each is None else f"{each * 1e3:.3f}" for each in told]
        texts.append([name, channel, *map(str, (link.sent, link.lost, link.in_flight)), *times])
    widths = [max(len(row[column]) for row in texts) for column in range(len(head))]
    return [
        "  "
        + "  ".join(
            text.ljust(width) if column < 2 else text.rjust(width)
            for column, (text, width) in enumerate(zip(row, widths, strict=True))
        ).rstrip()
        for row in texts
    ]
