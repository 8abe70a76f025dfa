"""Runs for tests: small scenarios, and the command line as a process of its own."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

from echelon.plan.plan import Plan
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import load
from echelon.sim.results.trace import Trace, TraceBuilder

ROOT = Path(__file__).resolve().parents[2]
SCENARIOS = ROOT / "deploy" / "scenarios"
EXAMPLES = ROOT / "examples"


def plan_of(name: str, *overrides: str) -> Plan:
    """Returns the plan of a shipped scenario with overrides."""
    return load(SCENARIOS / f"{name}.toml", overrides)[1]


def trace_of(plan: Plan) -> Trace:
    """Runs a plan in this process and returns the trace."""
    builder = TraceBuilder(plan)
    Engine(plan, builder.add).run()
    return builder.build()


def echelon(
    *arguments: str | Path, timeout: float = 600, cwd: Path = ROOT, typed: str = "", **options: Any
) -> subprocess.CompletedProcess[str]:
    """Runs the command line to its end; `typed` is its standard input."""
    command = [sys.executable, "-m", "echelon", *map(str, arguments)]
    return subprocess.run(
        command, capture_output=True, text=True, timeout=timeout, cwd=cwd, input=typed, check=False, **options
    )


def start_echelon(*arguments: str | Path, **options: Any) -> subprocess.Popen[str]:
    """Starts the command line in a process session of its own, so that all its processes can be found; `options` are those of
    Popen."""
    return subprocess.Popen(
        [sys.executable, "-m", "echelon", *map(str, arguments)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        stdin=subprocess.DEVNULL,
        text=True,
        cwd=ROOT,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(
            signal.SIGINT, signal.SIG_DFL
        ),  # otherwise SIGINT is ignored if the tests run in the background
        **options,
    )


def _alive() -> list[tuple[int, int, int]]:
    """Returns (process, parent, session) of all processes that are alive, without zombies."""
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:
                continue
            if fields[0] != "Z":
                found.append((int(entry.name), int(fields[1]), int(fields[3])))
    return found


def lab_dbc(torque_scale: float = 0.001) -> str:
    """Returns the DBC of the robots of lab.toml, g1/r1 to g3/r9, with native drives."""
    from echelon.bridge.protocols.plan_dbc import plan_dbc

    return plan_dbc(plan_of("lab", f"can.torque_scale={torque_scale!r}"))


def session_members(session: int) -> list[int]:
    """Returns the processes of a session that are alive."""
    return [pid for pid, _, of in _alive() if of == session]


def descendants(ancestor: int) -> list[int]:
    """Returns the descendants of a process, over any number of generations."""
    alive, found = _alive(), [ancestor]
    for one in found:
        found += [pid for pid, parent, _ in alive if parent == one]
    return found[1:]


def pid_of(name: str, processes: list[int]) -> int:
    """Returns the process with a name, one of `processes`."""
    (pid,) = [pid for pid in processes if Path(f"/proc/{pid}/comm").read_text().strip() == name]
    return pid


def until(condition: Any, timeout_s: float = 600.0) -> bool:
    """Waits until a condition about other processes holds; returns False if it does not hold in time.  It polls, because there
    is no event to wait for."""
    import time

    deadline_s = time.monotonic() + timeout_s
    while not condition():
        if time.monotonic() > deadline_s:
            return False
        time.sleep(0.01)
    return True


def summary_of(folder: Path) -> dict[str, Any]:
    """Reads a run's summary."""
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    return summary


def kill_session(session: int) -> None:
    """Ends all processes of a session that a failed test may have left behind."""
    for pid in session_members(session):
        try:
            os.kill(pid, signal.SIGKILL)
        except ProcessLookupError:
            pass


def reasons(summary: dict[str, Any]) -> list[str]:
    """Returns the sentences of all checks of a summary.json that failed."""
    return [check["text"] for check in summary["verdict"]["checks"] if check["outcome"] == "failed"]
