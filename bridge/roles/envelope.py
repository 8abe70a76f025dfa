"""The envelope, the last gate before the bus: it decides which torques become a frame (docs/architecture.md, 5.4).  Pure.

A pair of wheel torques passes unchanged, or both wheels get zero.  It passes if for each wheel

- the torque is finite and its magnitude is at most `torque_limit`;
- its magnitude rises by at most `rise_limit` and falls by at most `fall_limit` from the torque of the last frame.  A change of
  sign falls to zero and rises from there, and both parts must keep their limits;
- the largest and the smallest torque of the frames of the last 250 ms, this one included, differ by at most `window_limit`;

and if the command is at most `stale_ns` old and not from the future, and time does not run backwards.  A torque that reaches a
limit exactly passes.  The sum last + `rise_limit` is rounded as floats are, so a torque that was computed as this sum passes.

The gate itself may go to zero from any torque.  The limits then count from this zero, and the window is empty but for it.  At
the first call the gate also starts from zero.
"""

import math
from collections import Counter, deque
from enum import StrEnum
from typing import NamedTuple

from echelon.plan.can_plan import EnvelopePlan

WINDOW_NS = 250_000_000


class Rejection(StrEnum):
    """Why the envelope replaced torques by zero."""

    CLOCK = "time ran backwards"
    FUTURE = "command from the future"
    STALE = "stale command"
    NOT_FINITE = "not finite"
    TORQUE = "torque limit"
    RISE = "rise limit"
    FALL = "fall limit"
    WINDOW = "window limit"


class Verdict(NamedTuple):
    """The torques [N m] that may be sent.  `reason` is None if they are the commanded ones, otherwise both are zero."""

    tau_right: float
    tau_left: float
    reason: Rejection | None


class Envelope:
    """The envelope of one robot.  Raises ValueError for a limit that is negative or NaN."""

    def __init__(self, plan: EnvelopePlan) -> None:
        for name in ("torque_limit", "rise_limit", "fall_limit", "window_limit", "stale_ns"):
            if not getattr(plan, name) >= 0:
                raise ValueError(f"{name} must be 0 or more, not {getattr(plan, name)!r}")
        self.plan = plan
        self.rejections: Counter[Rejection] = Counter()
        self._clock_ns = -math.inf
        self._wheels = _Wheel(plan), _Wheel(plan)
        limits = plan.torque_limit, plan.rise_limit, plan.fall_limit, plan.window_limit
        self._unlimited = all(limit == math.inf for limit in limits)

    def check(self, now_ns: int, command_ns: int, tau_right: float, tau_left: float) -> Verdict:
        """Returns the torques to send at `now_ns` if `tau_right` and `tau_left` [N m] were commanded at `command_ns`."""
        if self._clock_ns == -math.inf:
            self.stop(now_ns)
        reason = self._rejection(now_ns, command_ns, tau_right, tau_left)
        if reason is None:
            self._clock_ns = now_ns
            return Verdict(tau_right, tau_left, None)
        self.rejections[reason] += 1
        self.stop(now_ns)
        return Verdict(0.0, 0.0, reason)

    def stop(self, now_ns: int) -> None:
        """Notes that zero torques are sent at `now_ns` for a reason outside the envelope."""
        self._clock_ns = max(self._clock_ns, now_ns)
        for wheel in self._wheels:
            wheel.stop(self._clock_ns)

    def _rejection(self, now_ns: int, command_ns: int, tau_right: float, tau_left: float) -> Rejection | None:
        if now_ns < self._clock_ns:
            return Rejection.CLOCK
        if command_ns > now_ns:
            return Rejection.FUTURE
        if now_ns - command_ns > self.plan.stale_ns:
            return Rejection.STALE
        if not (math.isfinite(tau_right) and math.isfinite(tau_left)):
            return Rejection.NOT_FINITE
        if self._unlimited:
            return None
        right, left = self._wheels
        return right.rejection(now_ns, tau_right) or left.rejection(now_ns, tau_left)


class _Wheel:
    """The torques that were sent to one wheel.

    `highs` holds those torques of the window that are, or can still become, the largest in it.  `lows` is the same for
    negated torques."""

    def __init__(self, plan: EnvelopePlan) -> None:
        self.plan = plan
        # torques within the limit are at most twice the limit apart
        self._windowed = plan.window_limit < 2 * plan.torque_limit

    def stop(self, now_ns: float) -> None:
        self.sent = 0.0
        self.highs, self.lows = deque([(now_ns, 0.0)]), deque([(now_ns, 0.0)])

    def rejection(self, now_ns: int, torque: float) -> Rejection | None:
        """Compares a finite torque with the limits.  Returns the limit that it breaks; otherwise notes it as sent."""
        plan, sent = self.plan, self.sent
        size, before = abs(torque), abs(sent)
        # the magnitude falls to the common part of both, then rises from there; it is 0 if the sign changes
        common = min(size, before) if (torque > 0.0) is (sent > 0.0) else 0.0
        if size > plan.torque_limit:
            return Rejection.TORQUE
        if size > common + plan.rise_limit:
            return Rejection.RISE
        if before - plan.fall_limit > common:
            return Rejection.FALL
        if (
            self._windowed
            and _largest(self.highs, now_ns, torque) + _largest(self.lows, now_ns, -torque) > plan.window_limit
        ):
            return Rejection.WINDOW
        self.sent = torque
        return None


def _largest(window: deque[tuple[float, float]], now_ns: int, value: float) -> float:
    """Adds a value to a window of falling values and drops what is too old; returns the largest value."""
    while window and window[-1][1] <= value:
        window.pop()
    window.append((now_ns, value))
    while window[0][0] < now_ns - WINDOW_NS:
        window.popleft()
    return window[0][1]
