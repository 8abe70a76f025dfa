"""Compares ways to run a lockstep of 13 processes: `python -m bench.lockstep [--ticks N] [--repeat R] [--peers a,b]`.

A *peer* is one way: Zenoh as this project uses it, or another library.  The peers are measured in turn, so that the load of the
machine is the same for all.  Rates are medians over the repeats; processor time and context switches are sums over all
processes of a peer.  A peer whose final values are not the expected ones has failed.
"""

from __future__ import annotations

import argparse
import importlib
import importlib.metadata
import importlib.util
import json
import os
import platform
import shutil
import statistics
import sys
import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from bench.tree import ROLES

PEERS: Final = {
    "zenoh": ("bench.peers.zenoh_session", "run", "eclipse-zenoh"),
    "zenoh-secrets": ("bench.peers.zenoh_session", "run_with_secrets", "eclipse-zenoh"),
    "pyzmq": ("bench.peers.pyzmq_ipc", "run", "pyzmq"),
    "pyzmq-batch": ("bench.peers.pyzmq_ipc", "run_batch", "pyzmq"),
    "pipes": ("bench.peers.pipes", "run", None),
    "helics": ("bench.peers.helics_ipc", "run", "helics"),
    "mosaik": ("bench.peers.mosaik_processes", "run", "mosaik"),
}
SLOW: Final = {"helics": 5, "mosaik": 5}
"""Slow peers run this many times fewer ticks"""


@dataclass(frozen=True, slots=True)
class Measurement:
    """One run of one peer."""

    ticks: int
    ticks_per_s: float
    cpu_ms_per_tick: float
    switches_per_tick: float
    values: tuple[float, ...]
    """The final value of every role, in the order of `ROLES`"""


def measure(run: Callable[[int, Path], None], ticks: int) -> Measurement:
    """Returns the measurement of one run of a peer; `run` takes the number of ticks and a folder for its results."""
    folder = Path(tempfile.mkdtemp(prefix="lockstep-"))
    try:
        run(ticks, folder)
        found = {path.stem: json.loads(path.read_text()) for path in folder.glob("*.json")}
    finally:
        shutil.rmtree(folder, ignore_errors=True)
    roles = [found[role.name] for role in ROLES]
    seconds = max(one["end"] for one in roles) - min(one["start"] for one in roles)
    return Measurement(
        ticks=ticks,
        ticks_per_s=ticks / seconds,
        cpu_ms_per_tick=sum(one["cpu_s"] for one in found.values()) * 1e3 / ticks,
        switches_per_tick=sum(one["switches"] for one in found.values()) / ticks,
        values=tuple(one["value"] for one in roles),
    )


def expected(ticks: int) -> tuple[float, ...]:
    """Returns the final values of all roles, computed in this process."""
    from bench.tree import COORDINATOR, LEADERS, command_law, robot_law, robot_start, sum_law

    values = {role: robot_start(role) for role in ROLES}
    for _ in range(ticks):
        for leader in LEADERS:
            robots = [role for role in ROLES if role.number is not None and role.group == leader.group]
            values[leader] = sum_law([values[robot] for robot in robots])
        values[COORDINATOR] = sum_law([values[leader] for leader in LEADERS])
        for role in ROLES:
            if role.number is not None and role.group is not None:
                values[role] = robot_law(values[role], command_law(values[COORDINATOR], role.group))
    return tuple(values[role] for role in ROLES)


def machine() -> dict[str, str | int]:
    """Returns facts about the machine and the versions of packages."""
    lines = Path("/proc/cpuinfo").read_text().splitlines()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    found: dict[str, str | int] = {
        "cpu": models[0] if models else platform.machine(),
        "cores": len(os.sched_getaffinity(0)),
        "kernel": platform.release(),
        "python": platform.python_version(),
        "load_before": f"{os.getloadavg()[0]:.2f}",
    }
    for package in sorted({package for _, _, package in PEERS.values() if package}):
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def installed(module: str) -> bool:
    """Returns whether all packages that a peer needs can be imported; `module` is the peer's module."""
    return all(importlib.util.find_spec(name) for name in importlib.import_module(module).REQUIRES)


def compare(names: list[str], ticks: int, repeat: int) -> tuple[dict[str, list[Measurement]], dict[str, str]]:
    """Measures peers in turn, `repeat` times; returns their measurements, and for peers without measurements the reason."""
    runs: dict[str, list[Measurement]] = {name: [] for name in names}
    failures: dict[str, str] = {}
    for number in range(repeat):
        for name in names:
            if name in failures:
                continue
            module, function, _ = PEERS[name]
            share = max(1, ticks // SLOW.get(name, 1))
            if not installed(module):
                failures[name] = "not installed"
                continue
            if sys.stderr.isatty():
                print(f"\r\x1b[K{number + 1}/{repeat} {name}", end="", file=sys.stderr, flush=True)
            try:
                found = measure(getattr(importlib.import_module(module), function), share)
            except (RuntimeError, KeyError) as error:
                failures[name] = f"failed: {error}"
                continue
            if found.values != expected(share):
                failures[name] = "failed: its final values are not those expected"
                continue
            runs[name].append(found)
    if sys.stderr.isatty():
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)
    return runs, failures


def main() -> int:
    """Measures and prints; returns the exit code: 1 if a peer failed, otherwise 0."""
    parser = argparse.ArgumentParser(prog="python -m bench.lockstep", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--ticks", type=int, default=2000, help="ticks of a run; slow peers run a fifth (default 2000)")
    parser.add_argument("--repeat", type=int, default=5, help="runs of each peer (default 5)")
    parser.add_argument("--peers", default=",".join(PEERS), help="which, comma separated (default all)")
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args()
    names = options.peers.split(",")
    if unknown := [name for name in names if name not in PEERS]:
        parser.error(f"unknown peer {unknown[0]!r}; there are {', '.join(PEERS)}")
    description = machine()
    runs, failures = compare(names, options.ticks, options.repeat)
    if options.json:
        peers = {name: [asdict(one) for one in runs[name]] for name in names}
        print(json.dumps({"machine": description, "peers": peers, "failures": failures}, indent=1))
    else:
        print("  ".join(f"{key} {value}" for key, value in description.items()))
        print(table(runs, failures))
    return 1 if any(text.startswith("failed") for text in failures.values()) else 0


def table(runs: dict[str, list[Measurement]], failures: dict[str, str]) -> str:
    """Returns a table with the medians of all peers, and the ratios of their rates to Zenoh's."""
    heads = ("ticks/s", "min", "max", "of zenoh", "cpu ms/tick", "switches/tick")
    lines = ["{:12} {:>8} {:>7} {:>7} {:>9} {:>12} {:>14}".format("peer", *heads)]
    base = statistics.median(one.ticks_per_s for one in runs["zenoh"]) if runs.get("zenoh") else None
    for name, found in runs.items():
        if name in failures or not found:
            lines.append(f"{name:12} {failures.get(name, 'no run')}")
            continue
        rates = [one.ticks_per_s for one in found]
        rate = statistics.median(rates)
        ratio = f"{rate / base:9.2f}" if base else f"{'-':>9}"
        cpu = statistics.median(one.cpu_ms_per_tick for one in found)
        switches = statistics.median(one.switches_per_tick for one in found)
        lines.append(f"{name:12} {rate:8.0f} {min(rates):7.0f} {max(rates):7.0f} {ratio} {cpu:12.3f} {switches:14.1f}")
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
