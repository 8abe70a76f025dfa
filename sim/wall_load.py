"""Whether a machine has the processor time for a run on a wall clock, estimated before the run; and what is recorded if not.

A run on a wall clock cannot wait.  Where all processors are busy, stages are late, and messages to the recorder are lost.  So
the load is estimated from the plan:

    load = (messages/s · MESSAGE_S + copies/s · COPY_S + wakes/s · WAKE_S + frames/s · FRAME_S) / processors

The times were measured on a virtual machine with two processors: processor time of each process, over the number of its
periods, in runs of 9 robots.  There a robot takes 0.24 ms in each period, a leader of three 0.41 ms, the recorder 0.05 ms
for each message.  Nine robots at 10 ms take a quarter of two processors, 27 three quarters, 60 more than there is.

Beyond `BUSY` the recording is thinned by rule, never control: of the messages of each member and channel only the first in
every `every_ns` is recorded, so that the states of all robots are of the same instants.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

from echelon.plan.plan import Plan

BUSY: Final = 0.6
"""Load above which a run on a wall clock misses deadlines, as a share of all processors"""
MESSAGE_S: Final = 100e-6
"""Processor time of a message at its sender and its receiver [s]"""
COPY_S: Final = 75e-6
"""Processor time of the copy of a message at its sender and the recorder [s]"""
WAKE_S: Final = 90e-6
"""Processor time of a process in each of its periods, apart from messages [s]"""
FRAME_S: Final = 60e-6
"""Processor time of a frame at the bridge, and at the drives that take it [s]"""
STEPS: Final = (1, 2, 5, 10)
"""Of how many instants one is recorded"""


@dataclass(frozen=True, slots=True)
class WallLoad:
    """The estimated load of a run on a wall clock."""

    processes: int
    processors: int
    share: float
    """Processor time of all processes, as a share of that of all processors, if everything is recorded"""
    step: int
    """One of so many instants is recorded; 1: everything is"""
    every_ns: int
    """The time from one recorded instant to the next [ns]; 0: everything is recorded"""
    most: int
    """About how many robots of this kind this machine can take, at these periods"""

    @property
    def text(self) -> str:
        """The load in words."""
        return f"{self.processes} processes take about {100 * self.share:.0f} % of {self.processors} processors"

    @property
    def warning(self) -> str:
        """What is too much, and what then happens; empty if the machine has time enough."""
        if self.share <= BUSY:
            return ""
        thinned = f"; of {self.step} instants one is recorded" if self.step > 1 else ""
        return (
            f"on a wall clock {self.text}: beyond {100 * BUSY:.0f} % stages are late (about {self.most} robots fit{thinned}); "
            "use longer periods, fewer robots, or virtual time"
        )


def wall_load(plan: Plan, frames: bool, processors: int | None = None) -> WallLoad:
    """Returns the load of a plan on a wall clock.

    `frames`: the run has buses.  `processors` are those of this machine unless given."""
    cores = processors or len(os.sched_getaffinity(0))
    copies = _per_second([one.period_ns for one in plan.formation])
    spent = COPY_S * copies + WAKE_S * _per_second([one.period_ns for one in plan.all_roles])
    spent += MESSAGE_S * _per_second([link.period_ns for link in plan.links])
    if frames and plan.can.enabled:
        each = 4 if plan.can.closed else 1  # commands and reports, each at two processes
        spent += FRAME_S * each * _per_second([robot.drive.period_ns for robot in plan.robots])
    thin = COPY_S * copies
    step = next((step for step in STEPS if spent - thin + thin / step <= BUSY * cores), STEPS[-1])
    every_ns = step * max(robot.period_ns for robot in plan.robots) if step > 1 else 0
    share = spent / cores
    most = max(1, int(len(plan.robots) * BUSY / share))
    return WallLoad(len(plan.all_roles) + 1, cores, share, step, every_ns, most)


def _per_second(periods_ns: Sequence[int]) -> float:
    return sum(1e9 / period_ns for period_ns in periods_ns)
