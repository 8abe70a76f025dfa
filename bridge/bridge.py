"""The bridge where torque is mirrored: wheel torques in, CAN frames out, and what there is to know about them. Pure.

Each robot sends its torques once per acceleration period, and each becomes one frame at once; nothing is held back, so
torques in the order (time, robot) give frames in that order. What must not reach a wheel becomes a frame with zero
torque that does not enable, so that the drives stop instead of holding the torque before. So does what the envelope
does not let pass.
"""

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

from echelon.bridge.bus_load import BitCount
from echelon.bridge.envelope import Envelope
from echelon.bridge.frame import Frame, Host
from echelon.can_plan import EnvelopePlan


class Stop(StrEnum):
    """Why a frame does not enable."""

    NOT_FINITE = "not finite"
    STALE = "stale"
    MISSING = "missing"
    REQUESTED = "requested"


@dataclass(slots=True)
class RobotCounts:
    """What the bridge saw of one robot. Torques are as commanded, before clipping [N m], right and left wheel."""

    frames: int = 0
    stopped: dict[StrEnum, int] = field(default_factory=dict)  # frames that did not enable; part of `frames`
    repeated: int = 0  # torques for a period that had its frame: no frame
    skipped: int = 0  # periods without torques between two that had them
    clipped: int = 0  # frames in which a torque was cut to the range of the frame
    saturated: int = 0  # frames that say the robot's own limit was reached
    smallest: tuple[float, float] = (math.inf, math.inf)
    largest: tuple[float, float] = (-math.inf, -math.inf)
    last_ns: int | None = None  # the newest torques turned into a frame


class Bridge:
    """Turns torques into frames.

    Parameters: the robots' path names in the order of their numbers, their hosts, the acceleration period [ns], and the
    robots' envelopes (none: no limits). Raises ValueError for a period that is not positive."""

    __slots__ = (
        "_bits",
        "_envelopes",
        "_hosts",
        "_names",
        "_period_ns",
        "counts",
        "frames",
    )

    def __init__(
        self,
        robots: Sequence[str],
        hosts: Sequence[Host],
        period_ns: int | Sequence[int],
        envelopes: Sequence[EnvelopePlan] = (),
    ) -> None:
        periods = [period_ns] * len(robots) if isinstance(period_ns, int) else list(period_ns)
        if len(periods) != len(robots) or min(periods, default=1) <= 0:
            raise ValueError(f"periods must be positive, one for each of {len(robots)} robots, not {period_ns!r} ns")
        self._names = tuple(robots)
        self._hosts = tuple(hosts)
        self._period_ns = periods
        self._envelopes = [Envelope(plan) for plan in envelopes]
        self.counts = [RobotCounts() for _ in robots]
        self.frames = 0
        self._bits = BitCount()

    def encode(
        self, time_ns: int, robot: int, tau_right: float, tau_left: float, saturated: bool = False
    ) -> list[Frame]:
        """The frame for the torques [N m] that robot number `robot` commands at `time_ns`.

        Torques not finite, or older than the last ones, give a frame that stops the robot's drives; a second set of
        torques for one instant gives none. Raises IndexError for a robot the bridge does not have."""
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
        counts.stopped[why] = counts.stopped.get(why, 0) + 1
        if self._envelopes and counts.last_ns is not None:
            self._envelopes[robot].stop(counts.last_ns)
        return self._send(robot, self._hosts[robot].mirror(0.0, 0.0, False))

    def _send(self, robot: int, frames: list[Frame]) -> list[Frame]:
        self.counts[robot].frames += len(frames)
        self.frames += len(frames)
        for can_id, data, _ in frames:
            self._bits.add(can_id, data)
        return frames

    def stopped(self) -> Counter[str]:
        """How many torques did not reach a wheel, by reason, over all robots."""
        return sum((Counter(counts.stopped) for counts in self.counts), Counter[str]())

    @property
    def bits(self) -> int:
        """Bits that all frames so far would take on a real bus, stuff bits and interframe space included."""
        return self._bits.bits

    def summary(self) -> dict[str, Any]:
        """All counts, ready for JSON: totals, and one entry for each robot under its path name."""
        robots = {}
        for name, counts in zip(self._names, self.counts, strict=True):
            commanded = counts.smallest[0] <= counts.largest[0]
            robots[name] = {
                "frames": counts.frames,
                "stopped": {why.value: number for why, number in sorted(counts.stopped.items())},
                "repeated": counts.repeated,
                "skipped": counts.skipped,
                "clipped": counts.clipped,
                "saturated": counts.saturated,
                "torque_min": list(counts.smallest) if commanded else None,
                "torque_max": list(counts.largest) if commanded else None,
            }
        return {"frames": self.frames, "bits": self.bits, "robots": robots}
