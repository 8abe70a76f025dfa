"""The host of a robot's two CiA 402 drives, and what a CANopen bus has one of: the master's heartbeat and SYNC.

Each drive is brought up by itself, one SDO request per `poll` (bridge.protocols.cia402.wheel).
"""

import math
from collections import Counter

from echelon.bridge.protocols.cia402.codec import (
    EMCY_ID,
    HEARTBEAT_ID,
    HOST_NODE,
    SDO_ANSWER_ID,
    SYNC_ID,
    TPDO_IDS,
    Command,
    Nmt,
    heartbeat,
)
from echelon.bridge.protocols.cia402.configuration import heartbeat_ns
from echelon.bridge.protocols.cia402.wheel import Wheel
from echelon.bridge.protocols.frame import WHEELS, Frame
from echelon.plan.can_plan import DrivePlan


class Master:
    """What goes out once per bus, whatever the number of robots; the smallest watchdog of them counts."""

    def __init__(self, period_ns: int, watchdog_ns: int) -> None:
        if period_ns <= 0 or watchdog_ns <= 0:
            raise ValueError(f"period and watchdog must be positive, not {period_ns!r} and {watchdog_ns!r} ns")
        self._every_ns = heartbeat_ns(period_ns, watchdog_ns)
        self._slack_ns = period_ns // 2
        self._next_ns: int | None = None

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns the host's heartbeat when it is due; to be called once per period, early or late by less than half of it."""
        due_ns = time_ns if self._next_ns is None else self._next_ns
        if time_ns < due_ns - self._slack_ns:
            return []
        self._next_ns = max(due_ns, time_ns - self._slack_ns) + self._every_ns  # after a standstill from now on
        return [heartbeat(HOST_NODE, Nmt.OPERATIONAL)]

    def sync(self) -> Frame:
        """Returns the SYNC; at its end the drives sample what they report."""
        return Frame(SYNC_ID)


class Cia402Host:
    """Commands both drives of a robot.  Raises ValueError for bad node ids, or twice the same."""

    def __init__(self, plan: DrivePlan) -> None:
        if plan.node_ids[0] == plan.node_ids[1]:
            raise ValueError(f"each wheel needs a node id of its own, not twice {plan.node_ids[0]}")
        self.plan = plan
        self.refused: Counter[str] = Counter()
        self.clipped = 0
        self._wheels = (Wheel(plan, 0), Wheel(plan, 1))
        bases = (EMCY_ID, *TPDO_IDS[:3], SDO_ANSWER_ID, HEARTBEAT_ID)
        self._listeners = {base + wheel.node: (wheel, base) for wheel in self._wheels for base in bases}
        self._identifiers = frozenset(self._listeners)
        self._started = True
        self._ready = False  # a zero torque was sent since both are enabled

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames it listens to."""
        return self._identifiers

    @property
    def torque(self) -> tuple[float, float]:
        """Torque of the right and left wheel as the drives last reported it, means between two SYNCs [N m]."""
        right, left = self._wheels
        return right.torque, left.torque

    @property
    def torque_ns(self) -> int | None:
        """When the older of the two came; None before both did."""
        right, left = (wheel.torque_ns for wheel in self._wheels)
        return None if right is None or left is None else min(right, left)

    @property
    def enabled(self) -> bool:
        """True while both wheels take torque, as far as their drives said."""
        right, left = self._wheels
        return self._started and right.enabled and left.enabled

    @property
    def fault(self) -> str:
        """What a drive reports to be wrong, in words; empty if nothing is."""
        return "; ".join(
            f"{name}: {wheel.fault}" for name, wheel in zip(WHEELS, self._wheels, strict=True) if wheel.fault
        )

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns what is due besides torques: to bring drives up, or clear a fault and enable anew."""
        return [frame for wheel in self._wheels for frame in wheel.poll(time_ns, self._started)]

    def command(self, time_ns: int, tau_right: float, tau_left: float, saturated: bool = False) -> list[Frame]:
        """Returns the frames for wheel torques [N m], finite ones; zeros are sent while a drive is not enabled."""
        if not (math.isfinite(tau_right) and math.isfinite(tau_left)):
            raise ValueError(f"torques must be finite, not {tau_right!r} and {tau_left!r}")
        enabled = self.enabled
        torques = (tau_right, tau_left) if enabled and self._ready else (0.0, 0.0)
        self._ready = enabled
        return [
            wheel.target(torque)
            for wheel, torque in zip(self._wheels, torques, strict=True)
            if wheel.nmt is Nmt.OPERATIONAL
        ]

    def stop(self, time_ns: int) -> list[Frame]:
        """Returns frames that take the torque away at once and disable the drives; they stay so until `start`."""
        return self._halt(time_ns, Command.DISABLE_VOLTAGE)

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns frames that make the drives stop quickly, as they are configured to; they stay so until `start`."""
        return self._halt(time_ns, Command.QUICK_STOP)

    def _halt(self, time_ns: int, command: Command) -> list[Frame]:
        self._started = self._ready = False
        return [
            frame
            for wheel in self._wheels
            if wheel.nmt is Nmt.OPERATIONAL
            for frame in (wheel.target(0.0), wheel.control(time_ns, command))
        ]

    def start(self) -> None:
        """Lets `poll` enable the drives (again), whatever was wrong until then.  A new host is started."""
        self._started = True
        for wheel in self._wheels:
            wheel.recover()

    def mirror(self, tau_right: float, tau_left: float, enable: bool, saturated: bool = False) -> list[Frame]:
        """Returns the target torques [N m], finite ones, whatever the drives say."""
        torques = (tau_right, tau_left) if enable else (0.0, 0.0)
        return [wheel.target(torque) for wheel, torque in zip(self._wheels, torques, strict=True)]

    def receive(self, time_ns: int, frame: Frame) -> None:
        """Takes a frame from the bus."""
        listener = self._listeners.get(frame.can_id)
        if frame.remote or listener is None:
            self.refused["remote frame" if frame.remote else "identifier"] += 1
            return
        wheel, base = listener
        why = wheel.receive(time_ns, base, frame.data)
        if why:
            self.refused[why] += 1
