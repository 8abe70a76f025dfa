"""Torque that is mirrored: wheel torques in, CAN frames out, counted robot by robot. Pure.

Each robot sends its torques once per acceleration period, and each becomes one frame at once; nothing is held back, so
torques in the order (time, robot) give frames in that order. What must not reach a wheel becomes a frame with zero
torque that does not enable, so that the drives stop instead of holding the torque before. So does what the envelope
does not let pass.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from echelon.bridge.protocols.frame import Frame, Host
from echelon.bridge.reports import WheelsReport
from echelon.bridge.roles.envelope import Envelope
from echelon.bridge.timing.bus_load import BitCount
from echelon.plan.can_plan import EnvelopePlan


class Stop(StrEnum):
    """Why a frame does not enable."""

    NOT_FINITE = "not finite"
    STALE = "stale"
    MISSING = "missing"
    REQUESTED = "requested"


@dataclass(slots=True)
class RobotCounts:
    """What was seen of one robot. Torques are as commanded, before clipping [N m], right and left wheel."""

    frames: int = 0
    stopped: dict[str, int] = field(default_factory=dict)  # frames that did not enable; part of `frames`
    repeated: int = 0  # torques for a period that had its frame: no frame
    skipped: int = 0  # periods without torques between two that had them
    clipped: int = 0  # frames in which a torque was cut to the range of the frame
    saturated: int = 0  # frames that say the robot's own limit was reached
    smallest: tuple[float, float] = (math.inf, math.inf)
    largest: tuple[float, float] = (-math.inf, -math.inf)
    last_ns: int | None = None  # the newest torques turned into a frame
    bits: BitCount = field(default_factory=BitCount)  # that its frames would take on a real bus


class TorqueMirror:
    """Turns torques into frames.

    Parameters: the robots' hosts in the order of their numbers, the acceleration period [ns], and the robots' envelopes
    (none: no limits). Raises ValueError for a period that is not positive."""

    __slots__ = (
        "_envelopes",
        "_hosts",
        "_period_ns",
        "counts",
        "frames",
    )

    def __init__(
        self,
        hosts: Sequence[Host],
        period_ns: int | Sequence[int],
        envelopes: Sequence[EnvelopePlan] = (),
    ) -> None:
        periods = [period_ns] * len(hosts) if isinstance(period_ns, int) else list(period_ns)
        if len(periods) != len(hosts) or min(periods, default=1) <= 0:
            raise ValueError(f"periods must be positive, one for each of {len(hosts)} robots, not {period_ns!r} ns")
        self._hosts = tuple(hosts)
        self._period_ns = periods
        self._envelopes = [Envelope(plan) for plan in envelopes]
        self.counts = [RobotCounts() for _ in hosts]
        self.frames = 0

    def encode(
        self, time_ns: int, robot: int, tau_right: float, tau_left: float, saturated: bool = False
    ) -> list[Frame]:
        """The frame for the torques [N m] that robot number `robot` commands at `time_ns`.

        Torques not finite, or older than the last ones, give a frame that stops the robot's drives; a second set of
        torques for one instant gives none. Raises IndexError for a robot it does not have."""
        counts = self.counts[robot]
        last = counts.last_ns
        if last is not None and time_ns <= last:
            if time_ns < last:
                return self.stop(robot, Stop.STALE)
            counts.repeated += 1
            return []
        counts.last_ns = time_ns
        if last is not None:
            counts.skipped += max(0, (time_ns - last + self._period_ns[robot] // 2) // self._period_ns[robot] - 1)
        if not (math.isfinite(tau_right) and math.isfinite(tau_left)):
            return self.stop(robot, Stop.NOT_FINITE)
        (low_right, low_left), (high_right, high_left) = counts.smallest, counts.largest
        if tau_right < low_right or tau_left < low_left:
            counts.smallest = min(tau_right, low_right), min(tau_left, low_left)
        if tau_right > high_right or tau_left > high_left:
            counts.largest = max(tau_right, high_right), max(tau_left, high_left)
        if self._envelopes:
            tau_right, tau_left, reason = self._envelopes[robot].check(time_ns, time_ns, tau_right, tau_left)
            if reason is not None:
                return self.stop(robot, reason)
        counts.saturated += saturated
        host = self._hosts[robot]
        clipped = host.clipped
        frames = host.mirror(tau_right, tau_left, True, saturated)
        counts.clipped += host.clipped > clipped
        return self._send(robot, frames)

    def stop(self, robot: int, why: StrEnum = Stop.REQUESTED) -> list[Frame]:
        """The frame that stops a robot's drives: torques 0, not enabled; for a robot that is silent, or an e-stop."""
        counts = self.counts[robot]
        counts.stopped[why.value] = counts.stopped.get(why.value, 0) + 1
        if self._envelopes and counts.last_ns is not None:
            self._envelopes[robot].stop(counts.last_ns)
        return self._send(robot, self._hosts[robot].mirror(0.0, 0.0, False))

    def _send(self, robot: int, frames: list[Frame]) -> list[Frame]:
        counts = self.counts[robot]
        counts.frames += len(frames)
        self.frames += len(frames)
        for can_id, data, _ in frames:
            counts.bits.add(can_id, data)
        return frames

    def report(self, robot: int, protocol: str) -> WheelsReport:
        """Returns the counts of a robot whose drives speak `protocol`."""
        counts = self.counts[robot]
        commanded = (*counts.smallest, *counts.largest) if counts.smallest[0] <= counts.largest[0] else (0.0,)
        return WheelsReport(
            protocol=protocol,
            commands=counts.frames,
            stopped=dict(sorted(counts.stopped.items())),
            largest=max(map(abs, commanded)),
            clipped=counts.clipped,
            saturated=counts.saturated,
            repeated=counts.repeated,
            skipped=counts.skipped,
        )
