"""Reading the file of arrivals (echelon.runtime.arrivals)."""

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.plan.plan import Plan
from echelon.runtime.arrivals import END, RECORD
from echelon.sim.results.arrivals import Arrivals, LinkArrivals, Whole

_RECORD: Final = np.dtype([("link", "<u4"), ("number", "<u4"), ("sent", "<i8"), ("arrived", "<i8")])


def read_arrivals(path: Path, plan: Plan) -> Arrivals:
    """Returns the arrivals in a file.  A record at the end that is cut off is left out; so is all from the first record on that
    is none of this plan.  Raises OSError."""
    data = path.read_bytes()
    records = np.frombuffer(data[: len(data) // RECORD.size * RECORD.size], _RECORD)
    fit = _fit(records, plan)
    good = len(records) if fit.all() else int(np.argmin(fit))
    records = records[:good]
    is_end = records["link"] == END
    ends_ns = {int(one["number"]): int(one["arrived"]) for one in records[is_end]}
    arrivals = records[~is_end]
    arrivals = arrivals[
        np.lexsort((arrivals["number"], arrivals["link"]))
    ]  # stable: records of a message stay in order
    bounds = np.searchsorted(arrivals["link"], np.arange(len(plan.links) + 1))
    links = {
        number: _of_link(arrivals[bounds[number] : bounds[number + 1]])
        for number, link in enumerate(plan.links)
        if link.receiver < len(plan.formation)
    }
    return Arrivals(plan, links, ends_ns, good < len(fit))


def _of_link(records: NDArray[np.void]) -> LinkArrivals:
    """Returns the arrivals of a link.  Its records are in the order of numbers; of each message the first record has the
    arrival, the last one the instant from which on it counted."""
    numbers, sent_ns, arrived_ns = (records[name].astype(np.int64) for name in ("number", "sent", "arrived"))
    first, last = np.diff(numbers, prepend=-1) != 0, np.diff(numbers, append=-1) != 0
    return LinkArrivals(numbers[first], sent_ns[first], arrived_ns[first], arrived_ns[last])


def _fit(records: NDArray[np.void], plan: Plan) -> NDArray[np.bool_]:
    """Returns which records can be of this plan."""
    members = len(plan.formation)
    is_end = (records["link"] == END) & (records["number"] < members)
    known = records["link"] < len(plan.links)
    link = np.where(known, records["link"], 0)
    periods_ns, firsts_ns, receivers = (
        np.array(column, np.int64)
        for column in zip(*((link.period_ns, link.first_ns, link.receiver) for link in plan.links), strict=True)
    )
    numbers: Whole = (records["sent"] - firsts_ns[link]) // periods_ns[link]
    fits: NDArray[np.bool_] = is_end | (
        known & (receivers[link] < members) & (numbers == records["number"]) & (records["arrived"] >= records["sent"])
    )
    return fits
