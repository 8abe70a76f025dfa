"""Files of arrivals for tests, and plans whose links have the delays of such a file."""

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

from echelon.plan.delay_tables import LOST
from echelon.plan.plan import Plan
from echelon.plan.punctuality import with_punctuality
from echelon.runtime.arrivals import END, FILE, pack_arrival
from echelon.sim.replay.feeding import without_delays
from echelon.sim.results.arrivals import Arrivals

Row = tuple[int, int, int, int]
"""Number of the link, number of the message, instants of sending and arrival [ns]"""


def write_arrivals(folder: Path, rows: Iterable[Row], ended: Iterable[tuple[int, int]] = ()) -> Path:
    """Writes a file of arrivals; `ended` are indices of members with the ends of their runs [ns].  Returns the file."""
    path = folder / FILE
    records = [pack_arrival(*row) for row in rows] + [pack_arrival(END, index, end, end) for index, end in ended]
    path.write_bytes(b"".join(records))
    return path


def with_traces(plan: Plan, arrivals: Arrivals) -> Plan:
    """Returns a plan whose links deliver each message after the delay that it had."""
    links = list(without_delays(plan).links)
    for number in arrivals.links:
        trace = arrivals.trace(number)
        came = [delay_ns for delay_ns in trace.delays_ns if delay_ns != LOST] or [0]
        links[number] = replace(links[number], delays=trace, delay_min_ns=min(came), delay_max_ns=max(came))
    return replace(plan, links=tuple(with_punctuality(links, plan.nodes)))
