"""A bench for drives: plans of drives, and a thread that runs virtual drives on a bus in real time."""

import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from math import inf
from typing import Any, Self

from echelon.bridge.can.bus import open_bus
from echelon.bridge.protocols.frame import Drive, Frame
from echelon.plan.can_plan import DrivePlan, EnvelopePlan, MotorPlan
from echelon.plugins import Part
from echelon.sim.parts.loading import REGISTRY
from support.runs import EXAMPLES

MS = 1_000_000

MOTOR = MotorPlan(
    torque_limit=1.5,
    rated_torque=1.0,
    torque_slew=inf,
    lag=0.0,
    torque_constant=0.125,
    resistance=0.25,
    thermal_resistance=2.0,
    thermal_time=60.0,
    ambient=25.0,
    derating_from=90.0,
    temperature_limit=120.0,
    supply_voltage=24.0,
    supply_resistance=0.05,
    brown_out=16.0,
    encoder_counts=8192,
    inertia=0.01,
    friction=0.02,
)
"""A small wheel motor whose torque follows at once"""

ENVELOPE = EnvelopePlan(torque_limit=1.5, rise_limit=inf, fall_limit=inf, window_limit=inf, stale_ns=100 * MS)


def motor_plan(**changes: Any) -> MotorPlan:
    """Returns the plan of the small motor, with changes."""
    return replace(MOTOR, **changes)


def protocol(use: str) -> Part[Any]:
    """Returns a built-in protocol, or one in a file of the examples."""
    return REGISTRY.make("protocols", use, {}, EXAMPLES)


def drive_plan(use: str, node_ids: tuple[int, int] | None = None, **changes: Any) -> DrivePlan:
    """Returns the plan of a robot's drives, with changes: 100 Hz, watchdog 100 ms, no recovery.

    Unless given, their node ids are 1 and 2; in a protocol in which the node id is the robot's number, it is 3."""
    part = protocol(use)
    plan = DrivePlan(
        protocol=part,
        bus=0,
        node_ids=node_ids or ((3, 3) if part.made.by_number else (1, 2)),
        period_ns=10 * MS,
        watchdog_ns=100 * MS,
        torque_scale=0.001,
        recover_ns=None,
        motor=MOTOR,
    )
    return replace(plan, **changes)


class Bench:
    """Virtual drives that run on a bus in a thread of their own; times are those of the monotonic clock.

    While it runs, the drives may be read and changed only under `lock`.  If an exception ends the thread early, it is in
    `failure`, and leaving the context raises it.
    """

    def __init__(self, url: str, drives: Sequence[Drive]) -> None:
        self.drives = tuple(drives)
        self.lock = threading.Lock()
        self.failure: BaseException | None = None
        self._bus = open_bus(url)
        self.url = self._bus.url
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._serve, name="bench", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *exc: object) -> None:
        self._end.set()
        self._thread.join(10.0)
        self._bus.close()
        if self.failure is not None:
            raise self.failure

    def inject(self, drive: int, wheel: int, fault: Any) -> None:
        """Injects a fault at this moment."""
        with self.lock:
            now_ns = time.monotonic_ns()
            self._advance(now_ns)
            self._send(self.drives[drive].inject(now_ns, wheel, fault))

    def mend(self, drive: int, wheel: int, fault: Any) -> None:
        """Removes the cause of a fault at this moment."""
        with self.lock:
            now_ns = time.monotonic_ns()
            self._advance(now_ns)
            self.drives[drive].mend(now_ns, wheel, fault)

    def _serve(self) -> None:
        try:
            self._turn(None)
            while not self._end.is_set():
                due_ns = min(drive.due_ns for drive in self.drives)
                wait_s = min(max(due_ns - time.monotonic_ns(), 0) * 1e-9, 0.1)  # so that `__exit__` takes at most 0.1 s
                heard = self._bus.recv(wait_s)
                self._turn(heard and Frame(heard.can_id, heard.data, heard.remote))
        except BaseException as error:
            self.failure = error

    def _turn(self, frame: Frame | None) -> None:
        with self.lock:
            now_ns = time.monotonic_ns()
            self._advance(now_ns)
            for drive in self.drives if frame else ():
                assert frame is not None
                if frame.can_id in drive.identifiers:
                    self._send(drive.receive(now_ns, frame))

    def _advance(self, now_ns: int) -> None:
        for drive in self.drives:
            self._send(drive.advance(now_ns))

    def _send(self, frames: Sequence[Frame]) -> None:
        for can_id, data, remote in frames:
            self._bus.send(can_id, data, remote=remote)
