"""The mirrored torque path: wheel torques in, CAN frames out, counted for each robot (docs/architecture.md, 5.1). Pure.

Each robot sends its torques once per acceleration period. They become frames at once, so frames have the order of the torques:
by time, then by robot. Torques that must not reach a wheel, or that the envelope rejects, become frames with zero torque
that do not enable. So drives stop instead of holding the torque before. The next frame that enables has zero torque: drives
refuse any other. The limits of the envelope count from this zero.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from echelon.bridge.protocols.checked import those_at_rest_first
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
    """Counts of one robot. Torques are as commanded, before clipping [N m]: right wheel, left wheel."""

    frames: int = 0
    stopped: dict[str, int] = field(default_factory=dict)  # frames that did not enable, by reason; part of `frames`
    repeated: int = 0  # second torques for the same period; they made no frame
    skipped: int = 0  # periods without torques between two periods with torques
    clipped: int = 0  # frames in which a torque was cut to the range of the frame
    saturated: int = 0  # frames that say that the robot's own limit was reached
    smallest: tuple[float, float] = (math.inf, math.inf)
    largest: tuple[float, float] = (-math.inf, -math.inf)
    last_ns: int | None = None  # instant of the newest torques that became a frame
    bits: BitCount = field(default_factory=BitCount)  # length of its frames on a real bus


class TorqueMirror:
    """Turns torques into frames.

    Parameters: the robots' hosts in the order of their numbers; the acceleration period [ns], one for all robots or one for
    each; the robots' envelopes (none: no limits). Raises ValueError for a period that is not positive."""

    __slots__ = (
        "_envelopes",
        "_hosts",
        "_period_ns",
        "_zero_first",
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
        self._zero_first = [False for _ in hosts]
        """For each robot, whether its drives were disabled, or may have been, so that the next frame has zero torque"""
        self.counts = [RobotCounts() for _ in hosts]
        self.frames = 0

    def encode(
        self, time_ns: int, robot: int, tau_right: float, tau_left: float, saturated: bool = False
    ) -> list[Frame]:
        """Returns the frames for the torques [N m] that robot number `robot` commands at `time_ns`.

        Torques that are not finite, or older than the last ones, give frames that stop the robot's drives. The first torques
        after such frames give frames that enable with zero torque. A second pair of torques for the same instant gives no
        frame. Raises IndexError for an unknown robot."""
        counts = self.counts[robot]
        last = counts.last_ns
        if last is not None and time_ns <= last:
            if time_ns < last:
                return self.stop(robot, Stop.STALE)
            counts.repeated += 1
            return []
        counts.last_ns = time_ns
        if last is not None and (passed_ns := time_ns - last) != (period_ns := self._period_ns[robot]):
            counts.skipped += max(0, (passed_ns + period_ns // 2) // period_ns - 1)
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
        if self._zero_first[robot]:
            self._zero_first[robot] = False
            tau_right = tau_left = 0.0
            if self._envelopes:
                self._envelopes[robot].stop(time_ns)
        counts.saturated += saturated
        host = self._hosts[robot]
        clipped = host.clipped
        frames = host.mirror(tau_right, tau_left, True, saturated)
        counts.clipped += host.clipped > clipped
        return self._send(robot, frames)

    def stop(self, robot: int, why: StrEnum = Stop.REQUESTED) -> list[Frame]:
        """Returns the frames that stop a robot's drives: zero torque, not enabled; for a silent robot, or an e-stop."""
        counts = self.counts[robot]
        counts.stopped[why.value] = counts.stopped.get(why.value, 0) + 1
        if self._envelopes and counts.last_ns is not None:
            self._envelopes[robot].stop(counts.last_ns)
        self._zero_first[robot] = True
        return self._send(robot, self._hosts[robot].mirror(0.0, 0.0, False))

    def unsent(self, robot: int) -> None:
        """Says that a bus did not take a robot's last frames: its drives may be disabled still."""
        self._zero_first[robot] = True

    def driven(self) -> list[list[int]]:
        """Returns the robots that had torques, in the groups in which they are to be stopped (`those_at_rest_first`)."""
        return those_at_rest_first((robot, host) for robot, host in enumerate(self._hosts) if self.counts[robot].frames)

    def end(self, robots: Sequence[int]) -> tuple[list[tuple[int, Frame]], BaseException | None]:
        """Returns the frames that stop the drives of some robots, each with the number of its robot, and what a host raised, if
        one has failed: the other robots are stopped all the same.

        The frames are not counted, since no state has caused them."""
        frames, failure = list[tuple[int, Frame]](), None
        for robot in robots:
            try:
                frames += [(robot, frame) for frame in self._hosts[robot].mirror(0.0, 0.0, False)]
            except BaseException as error:  # also of a time limit, for a host that hangs
                failure = failure or error
        return frames, failure

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
