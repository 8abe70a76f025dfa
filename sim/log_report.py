"""The report on the buses of a run whose bridge gave none, since it was killed or failed: from can.log."""

import os
from pathlib import Path
from typing import Final

from echelon.bridge.referee.log import read_run_log
from echelon.bridge.reports import BusReport, CanReport
from echelon.bridge.timing.bus_load import BitCount
from echelon.bridge.timing.buses import scheduled
from echelon.bridge.timing.fit import plan_fit
from echelon.plan.plan import Plan, on_wall_clock

LONGEST_LINE: Final = 4096
"""No line of can.log is longer [bytes]"""


def report_of_log(plan: Plan, log: Path, clock: str) -> CanReport:
    """Returns the report on the buses, as far as can.log shows it; counts that it does not show are None.  `clock` is
    that of the run, `virtual` or `wall`.

    An unfinished last line is removed from the log.  Raises OSError, and PartRunError if a user's own protocol fails."""
    _drop_cut_line(log)
    plan = on_wall_clock(plan) if clock == "wall" else plan
    start_ns = plan.can.bring_up_ns if plan.can.closed else 0
    counts, frames, last_ns = [BitCount() for _ in plan.can.buses], 0, -start_ns
    for time_ns, bus, (can_id, data, remote) in read_run_log(log, plan):
        counts[bus].add(can_id, data, remote)
        frames, last_ns = frames + 1, max(last_ns, time_ns)
    seconds = max(last_ns + start_ns, 1) / 1e9
    buses = tuple(
        BusReport(bus.name, bus.bitrate, count.bits / (bus.bitrate * seconds))
        for bus, count in zip(plan.can.buses, counts, strict=True)
    )
    fit = plan_fit(plan)
    return CanReport(
        path=plan.can.path,
        timing=plan.can.timing if plan.can.closed else None,
        url="",
        listen="",
        torque_scale=plan.can.torque_scale,
        log_start=-start_ns / 1e9,
        frames=frames,
        load_mean=max(bus.load for bus in buses),
        fit=tuple(bus.lines[0] for bus in fit),
        advice=tuple(way for bus in fit for way in bus.advice),
        buses=buses,
        scheduled=scheduled(plan),
        sent=None,
        failed=None,
        dropped=None,
        log_lost=None,
        log_error=None,
        robots={},
    )


def _drop_cut_line(log: Path) -> None:
    """Removes an unfinished last line: half a frame may look like a frame with less data."""
    with log.open("rb") as file:
        size = file.seek(0, os.SEEK_END)
        begin = file.seek(max(0, size - LONGEST_LINE))
        whole = begin + file.read().rfind(b"\n") + 1
    if whole < size and (whole > begin or not begin):
        os.truncate(log, whole)
