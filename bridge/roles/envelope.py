"""The last gate before the bus: which torques may become a frame, whoever computed them.  Pure.

A pair of wheel torques passes as it is, or both wheels get zero.  It passes if, for each wheel,
- the torque is finite and its magnitude at most `torque_limit`;
- from the torque that the last frame had, it rises by at most `rise_limit` and falls by at most `fall_limit`.  Both are
  changes of magnitude; a change of sign falls to zero and rises from there, and both parts must keep their limits;
- largest and smallest torque of all frames of the last 250 ms, this one included, differ by at most `window_limit`;
and if the command is at most `stale_ns` old and not from the future, and the gate's time does not run backwards.
What reaches a limit exactly passes: a torque that was computed as last + rise_limit, too, since it is compared so.

The gate itself may go to zero from anywhere.  Then everything begins anew from that zero: next passes what is near it.
So does it at first.
"""

import math
from collections import Counter, deque
from enum import StrEnum
from typing import NamedTuple

from echelon.plan.can_plan import EnvelopePlan

WINDOW_NS = 250_000_000


class Rejection(StrEnum):
    """Why torques became zero."""

    CLOCK = "time ran backwards"
    FUTURE = "command from the future"
    STALE = "stale command"
    NOT_FINITE = "not finite"
    TORQUE = "torque limit"
    RISE = "rise limit"
    FALL = "fall limit"
    WINDOW = "window limit"


class Verdict(NamedTuple):
    """The torques [N m] that may be sent, and why they are zero; None if they are what was asked for."""

    tau_right: float
    tau_left: float
    reason: Rejection | None


class Envelope:
    """The gate of one robot.  Raises ValueError for a limit that is negative or no number."""

    def __init__(self, plan: EnvelopePlan) -> None:
        for name in ("torque_limit", "rise_limit", "fall_limit", "window_limit", "stale_ns"):
            if not getattr(plan, name) >= 0:
                raise ValueError(f"{name} must be 0 or more, not {getattr(plan, name)!r}")
        self.plan = plan
        self.rejections: Counter[Rejection] = Counter()
        self._clock_ns = -math.inf
        self._wheels = _Wheel(plan), _Wheel(plan)

    def check(self, now_ns: int, command_ns: int, tau_right: float, tau_left: float) -> Verdict:
        """Returns what is to be sent at `now_ns` for torques [N m] that were commanded at `command_ns`."""
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
        """Takes note of zero torques that are sent for other reasons."""
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
        right, left = self._wheels
        return right.rejection(now_ns, tau_right) or left.rejection(now_ns, tau_left)


class _Wheel:
    """What one wheel was sent; of the window only what is, or will be, its largest torque, and its smallest (negated)."""

    def __init__(self, plan: EnvelopePlan) -> None:
        self.plan = plan

    def stop(self, now_ns: float) -> None:
        self.sent = 0.0
        self.highs, self.lows = deque([(now_ns, 0.0)]), deque([(now_ns, 0.0)])

    def rejection(self, now_ns: int, torque: float) -> Rejection | None:
        """Holds a finite torque against the limits; takes it as sent if it keeps them."""
        plan, sent = self.plan, self.sent
        size, before = abs(torque), abs(sent)
        # what both have in common: the magnitude falls to it, then rises from it
        common = min(size, before) if (torque > 0.0) is (sent > 0.0) else 0.0
        if size > plan.torque_limit:
            return Rejection.TORQUE
        if size > common + plan.rise_limit:
            return Rejection.RISE
        if before - plan.fall_limit > common:
            return Rejection.FALL
        if _largest(self.highs, now_ns, torque) + _largest(self.lows, now_ns, -torque) > plan.window_limit:
            return Rejection.WINDOW
        self.sent = torque
        return None


def _largest(window: deque[tuple[float, float]], now_ns: int, value: float) -> float:
    """Puts a value into a window in which each is less than those before it; returns the largest in it."""
    while window and window[-1][1] <= value:
        window.pop()
    window.append((now_ns, value))
    while window[0][0] < now_ns - WINDOW_NS:
        window.popleft()
    return window[0][1]
