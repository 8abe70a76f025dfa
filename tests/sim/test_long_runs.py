"""Long runs: no process of a run grows, and a recording of an hour takes no more memory than a short one."""

import os
import time
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from echelon import large_arrays
from echelon.bridge.can.bus_url import resolve_url
from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.planning.loading import effective_toml
from echelon.sim.parts.loading import parse
from echelon.sim.processes.outcome import Progress
from echelon.sim.processes.supervisor import Supervisor
from echelon.sim.processes.watchers import RunRecorder
from support.runs import descendants

PERIOD = 0.05
"""Period of all messages [s]"""
KEPT = 60
"""No process may keep more of a period [bytes]"""


def small(duration: float) -> str:
    """Returns a scenario of two robots with a closed torque path."""
    robots = "\n".join(f"r{number} = {{ start = [{number}.2, 0.0] }}" for number in range(2))
    return f"""
name = "small"
duration = {duration}
periods = {{ acceleration = {PERIOD}, torque = {PERIOD} }}
robot = {{ mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1, torque_limit = 1.5 }}
law = {{ epsilon = [0.5] }}
trajectory = {{ kind = "line", velocity = [0.001, 0.0] }}
can = {{ path = "closed", watchdog = 0.5 }}
[formation]
shape = {{ kind = "line", spacing = 1.0 }}
[formation.robots]
{robots}
"""


def own_memory() -> dict[str, int]:
    """Returns the memory of each process of a run that is its own [bytes], by the name of the process."""
    found = {}
    for pid in descendants(os.getpid()):
        try:
            name = Path(f"/proc/{pid}/comm").read_text().strip()
            lines = Path(f"/proc/{pid}/status").read_text().splitlines()
            found[name] = next(1024 * int(line.split()[1]) for line in lines if line.startswith("RssAnon:"))
        except (OSError, StopIteration):
            continue
    return found


def test_no_process_of_a_run_grows(tmp_path: Path) -> None:
    """From a quarter of a run to its end; the recorder alone holds messages back, to put them in order."""
    scenario, plan = parse(small(300.0), "small.toml")
    samples: list[dict[str, int]] = []

    def look(progress: Progress) -> None:
        if progress.phase == "running":
            samples.append(own_memory())

    run, urls, toml = f"long-{os.getpid()}", (resolve_url("auto"),), effective_toml(scenario)
    outcome = Supervisor(plan, tmp_path, run=run, virtual=True, can_urls=urls, scenario_toml=toml, show=look).run()
    assert outcome.failure is None
    early, late = samples[len(samples) // 4], samples[-1]
    periods = 0.75 * plan.duration_ns / plan.robots[0].period_ns
    for name in ("bridge", "drives", "r0", "r1", "coordinator"):
        assert late[name] - early[name] < KEPT * periods, name


def test_a_recording_of_an_hour_takes_no_more_memory_than_one_of_a_quarter(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of what is in a file from the beginning; small ones are in memory."""
    monkeypatch.setattr(large_arrays, "LARGE", 1)
    scenario, plan = parse(small(3600.0).replace(str(PERIOD), "0.25"), "small.toml")
    luck, period_ns = np.random.default_rng(1), plan.robots[0].period_ns
    rows = luck.normal(size=(256, len(STATE_FIELDS)))
    periods = plan.duration_ns // period_ns
    tracemalloc.start()
    try:
        recording, held = RunRecorder(tmp_path, plan, effective_toml(scenario), {}), list[int]()
        for number in range(periods):
            recording.add(
                [Message(Channel.STATE, robot, number, number * period_ns, rows[number % 256]) for robot in (0, 1)]
            )
            if not number % 100:
                recording.recorder.flush_if_due(time.monotonic_ns())
                held.append(tracemalloc.get_traced_memory()[0])
        recording.close([])
        report = recording.report()
    finally:
        tracemalloc.stop()
    assert report.failure is None
    assert [len(times) for times in report.trace.times_ns] == [periods] * 2
    early, late = max(held[: len(held) // 4]), max(held[len(held) // 4 :])
    assert late - early < KEPT * 0.75 * periods
