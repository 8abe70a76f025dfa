"""One robot on a real bus in real time: its virtual drives, and its host, each in a thread."""

import threading
import time
from pathlib import Path
from typing import Any, Self

import numpy as np
import tomlkit

from echelon.bridge.can.bus import open_bus
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.registry import drive_places, make_drive, make_host, make_masters
from echelon.plan.plan import Plan
from echelon.sim.parts.loading import load
from support.bench_drives import Bench
from support.trees import ROBOT, scenario

TORQUES = (0.25, -0.5)


def one_robot(folder: Path, protocol: str = "native", **can: Any) -> tuple[Path, Plan]:
    """Writes the scenario of one robot with a closed torque path at 100 Hz; returns its file and its plan.  The watchdog is
    long, so that a busy machine causes no fault."""
    table = scenario(
        (None,),
        np.random.default_rng(1),
        duration=1.0,
        periods={"acceleration": 0.01, "torque": 0.01},
        robot=ROBOT | {"torque_limit": 1.5, "drive": {"protocol": protocol}},
        can={"path": "closed", "watchdog": 2.0, "torque_scale": 0.001} | can,
        claims=[],
    )
    path = folder / "one.toml"
    path.write_text(tomlkit.dumps(table))
    return path, load(path)[1]


class LiveRobot:
    """Drives and host that run until the context ends."""

    def __init__(self, plan: Plan, url: str) -> None:
        self._bench = Bench(url, [make_drive(plan, place) for place in drive_places(plan)])
        self._host = make_host(plan.robots[0])
        drive = plan.robots[0].drive
        self._period_s = drive.period_ns / 1e9
        self._masters = [master for _, master in make_masters(plan)]
        self._bus = open_bus(url)
        self._end = threading.Event()
        self.enabled = threading.Event()
        """Set when torques are commanded"""
        self._thread = threading.Thread(target=self._serve, name="host", daemon=True)

    @property
    def fault(self) -> str:
        """The present faults of the drives, as the host has them."""
        return self._host.fault

    def __enter__(self) -> Self:
        self._bench.__enter__()
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._end.set()
        self._thread.join(10.0)
        self._bus.close()
        self._bench.__exit__(*exc)

    def _serve(self) -> None:
        next_s = time.monotonic()
        while not self._end.is_set():
            now_ns = time.monotonic_ns()
            frames = self._host.poll(now_ns) + self._host.command(now_ns, *TORQUES)
            for master in self._masters:
                sync = master.sync()
                frames += [*master.poll(now_ns), *([] if sync is None else [sync])]
            for can_id, data, remote in frames:
                self._bus.send(can_id, data, remote=remote)
            if self._host.enabled:
                self.enabled.set()
            next_s += self._period_s
            while (wait_s := next_s - time.monotonic()) > 0:
                received = self._bus.recv(wait_s)
                if received is not None and received.can_id in self._host.identifiers:
                    self._host.receive(time.monotonic_ns(), Frame(received.can_id, received.data, received.remote))
