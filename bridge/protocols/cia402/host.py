"""The host of a robot's two CiA 402 drives, and the master of a CANopen bus: the host's heartbeat and SYNC.

Each drive is brought up separately, with one SDO request per `poll` (bridge.protocols.cia402.wheel).
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
    """SYNC and the host's heartbeat, once per bus.  Raises ValueError for a period or a watchdog that is not positive."""

    def __init__(self, period_ns: int, watchdog_ns: int) -> None:
        if period_ns <= 0 or watchdog_ns <= 0:
            raise ValueError(f"period and watchdog must be positive, not {period_ns!r} and {watchdog_ns!r} ns")
        self._every_ns = heartbeat_ns(period_ns, watchdog_ns)
        self._slack_ns = period_ns // 2
        self._next_ns: int | None = None

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns the host's heartbeat if it is due; must be called once per period, early or late by less than half."""
        due_ns = time_ns if self._next_ns is None else self._next_ns
        if time_ns < due_ns - self._slack_ns:
            return []
        self._next_ns = max(due_ns, time_ns - self._slack_ns) + self._every_ns  # no burst after a standstill
        return [heartbeat(HOST_NODE, Nmt.OPERATIONAL)]

    def sync(self) -> Frame:
        """Returns the SYNC, at whose end the drives sample their feedback."""
        return Frame(SYNC_ID)


class Cia402Host:
    """Commands both drives of a robot.  Raises ValueError for an invalid node id, or the same for both wheels."""

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
        self._ready = False  # the first zero torque was sent since both drives are enabled

    @property
    def identifiers(self) -> frozenset[int]:
        """Identifiers of the frames that it listens to."""
        return self._identifiers

    @property
    def torque(self) -> tuple[float, float]:
        """The last reported torques of the right and the left wheel, means between two SYNCs [N m]."""
        right, left = self._wheels
        return right.torque, left.torque

    @property
    def torque_ns(self) -> int | None:
        """When the older of the two reports came [ns]; None before both have come."""
        right, left = (wheel.torque_ns for wheel in self._wheels)
        return None if right is None or left is None else min(right, left)

    @property
    def enabled(self) -> bool:
        """True while both wheels take torque, by what their drives reported."""
        right, left = self._wheels
        return self._started and right.enabled and left.enabled

    @property
    def fault(self) -> str:
        """The present faults of the drives in words; empty without any."""
        return "; ".join(
            f"{name}: {wheel.fault}" for name, wheel in zip(WHEELS, self._wheels, strict=True) if wheel.fault
        )

    def poll(self, time_ns: int) -> list[Frame]:
        """Returns all due frames except torques: they bring drives up, clear faults and enable again."""
        return [frame for wheel in self._wheels for frame in wheel.poll(time_ns, self._started)]

    def command(self, time_ns: int, tau_right: float, tau_left: float, saturated: bool = False) -> list[Frame]:
        """Returns the frames for wheel torques [N m].  It sends zeros until both drives are enabled.

        Raises ValueError for a torque that is not finite."""
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
        """Returns frames that take the torque away at once and disable the drives.  They stay disabled until `start`."""
        return self._halt(time_ns, Command.DISABLE_VOLTAGE)

    def estop(self, time_ns: int) -> list[Frame]:
        """Returns the quick stop: the drives take the torque away themselves.  They stay stopped until `start`."""
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
        """Lets `poll` enable the drives (again), whatever was wrong before.  A new host is started already."""
        self._started = True
        for wheel in self._wheels:
            wheel.recover()

    def mirror(self, tau_right: float, tau_left: float, enable: bool, saturated: bool = False) -> list[Frame]:
        """Returns the frames for finite wheel torques [N m], whatever the drives reported."""
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
