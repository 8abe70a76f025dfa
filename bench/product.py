"""Speed, start-up time and memory of whole runs: paper.toml as processes, lab.toml in one process."""

import statistics
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from echelon.bridge.can.bus_url import resolve_url
from echelon.planning.loading import effective_toml
from echelon.shipped import shipped
from echelon.sim.engines.in_process import Engine
from echelon.sim.out_folder import OutFolder
from echelon.sim.parts.loading import load
from echelon.sim.processes.supervisor import Supervisor
from echelon.sim.run import execute
from echelon.sim.view.live import Display

LATE: Final = ('links=[{source="**", receiver="**", delay=0.005}]', "law.epsilon=[0.3, 0.3]")
"""All links 5 ms late.  The formation is slower than the paper's, which would diverge with this delay"""


@dataclass(frozen=True, slots=True)
class Row:
    """A row of the table: what was measured, its unit, and the value of each repeat."""

    what: str
    unit: str
    values: tuple[float, ...]

    @property
    def median(self) -> float:
        """The median of the repeats."""
        return statistics.median(self.values)


def paper_processes(
    seconds: float, *, recorded: bool, can: bool, changes: Sequence[str] = ()
) -> tuple[float, float, float]:
    """Runs `seconds` of paper.toml as processes, with `changes` as for `--set`; returns ticks per second, start-up time [s],
    and the largest memory of a robot's process [MB]."""
    scenario, plan = load(shipped()["paper"], [f"duration={seconds}", *changes])
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        outcome = Supervisor(
            plan,
            Path(folder),
            run=f"bench-{time.monotonic_ns():x}",
            virtual=True,
            can_urls=(resolve_url("auto"),) if can else (),
            scenario_toml=effective_toml(scenario),
            recorded=recorded,
        ).run()
    if outcome.failure:
        raise RuntimeError(outcome.failure)
    ticks = plan.duration_ns / plan.robots[0].period_ns
    robots = {robot.name for robot in plan.robots}
    memory = max(result.memory_bytes for result in outcome.processes if result.name in robots)
    return ticks / outcome.wall_s, outcome.startup_s, memory / 1e6


def lab_in_process(*, whole: bool) -> float:
    """Runs lab.toml in this process; returns run time over wall time.

    `whole`: with recording and frames on a virtual bus; otherwise only roles and links."""
    scenario, plan = load(shipped()["lab"])
    if whole:
        with tempfile.TemporaryDirectory(prefix="bench-") as folder:
            display = Display(plan, quiet=True)
            summary, _ = execute(
                scenario,
                plan,
                OutFolder(Path(folder), scenario.name, ()),
                engine="inprocess",
                clock="virtual",
                can_urls=("virtual",),
                display=display,
            )
        return float(summary.run.real_time_factor or 0.0)
    engine = Engine(plan)
    begun_s = time.perf_counter()
    engine.run()
    return plan.duration_ns / 1e9 / (time.perf_counter() - begun_s)


def measure(repeats: int, seconds: float) -> list[Row]:
    """Measures everything `repeats` times, each kind of run in turn; `seconds` is the run time of paper.toml."""
    full, bare, late, startups, memories, alone, whole = [], [], [], [], [], [], []
    for _ in range(repeats):
        rate, startup, memory = paper_processes(seconds, recorded=True, can=True)
        full.append(rate)
        startups.append(startup)
        memories.append(memory)
        bare.append(paper_processes(seconds, recorded=False, can=False)[0])
        late.append(paper_processes(seconds, recorded=False, can=False, changes=LATE)[0])
        alone.append(lab_in_process(whole=False))
        whole.append(lab_in_process(whole=True))
    return [
        Row("paper.toml as processes: laws, recorder, CAN", "ticks/s", tuple(full)),
        Row("paper.toml as processes: laws alone", "ticks/s", tuple(bare)),
        Row("the same, all links 5 ms late", "ticks/s", tuple(late)),
        Row("lab.toml in one process: roles and links", "× real time", tuple(alone)),
        Row("lab.toml in one process: with recording and CAN", "× real time", tuple(whole)),
        Row("start-up of 15 processes", "s", tuple(startups)),
        Row("memory of a robot process (PSS), largest", "MB", tuple(memories)),
    ]


def table(rows: list[Row]) -> str:
    """Returns the rows as a table with median, smallest and largest value."""
    lines = [f"{'':52} {'median':>9} {'min':>9} {'max':>9}"]
    lines += [
        f"{f'{row.what} [{row.unit}]':52.64} {row.median:9.4g} {min(row.values):9.4g} {max(row.values):9.4g}"
        for row in rows
    ]
    return "\n".join(lines)
