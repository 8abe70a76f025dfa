"""Checks of the envelope, as functions that take its module, so that they can also be given mutants of the module."""

import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from random import Random
from types import ModuleType
from typing import Any

import pytest

from echelon.bridge.roles.envelope import Rejection
from echelon.plan.can_plan import EnvelopePlan

INF = math.inf
MS = 1_000_000
WINDOW = 250 * MS
FREE = EnvelopePlan(INF, INF, INF, INF, 10**18)


def up(value: float) -> float:
    return math.nextafter(value, INF)


def sent(gate: Any, now_ns: int, right: float, left: float = 0.0) -> str:
    """Checks a fresh command; returns "" if it passed, otherwise the reason.  Asserts that the output agrees with this."""
    tau_right, tau_left, reason = gate.check(now_ns, now_ns, right, left)
    assert (tau_right, tau_left) == ((right, left) if reason is None else (0.0, 0.0))
    return reason or ""


def last(module: ModuleType, plan: EnvelopePlan, torques: list[float], step_ns: int = MS) -> str:
    """Returns the result for the last of some torques of one wheel.  Asserts that all before it pass, and that the result is
    the same for both wheels."""
    reasons = set()
    for wheel in (0, 1):
        gate = module.Envelope(plan)
        for n, torque in enumerate(torques):
            reason = sent(gate, 5 + n * step_ns, *((torque, 0.0) if wheel == 0 else (0.0, torque)))
            assert not reason or n == len(torques) - 1, (n, reason)
        reasons.add(reason)
    assert len(reasons) == 1
    return reasons.pop()


def check_everything_finite_passes_without_limits(module: ModuleType) -> None:
    gate = module.Envelope(FREE)
    for n, torque in enumerate((1.0, -1e300, 5e-324, 0.0, 1e300, -0.0)):
        assert sent(gate, n, torque, -torque) == ""
    assert gate.rejections == Counter()


def check_not_finite(module: ModuleType) -> None:
    for bad in (math.nan, INF, -INF):
        assert last(module, FREE, [1.0, bad]) == Rejection.NOT_FINITE
        gate = module.Envelope(FREE)
        assert gate.check(0, 0, bad, bad) == (0.0, 0.0, Rejection.NOT_FINITE)


def check_torque_limit(module: ModuleType) -> None:
    for limit in (0.0, 0.3, 2.0):
        for sign in (1, -1):
            plan = replace(FREE, torque_limit=limit)
            assert last(module, plan, [sign * limit]) == ""
            assert last(module, plan, [sign * up(limit)]) == Rejection.TORQUE


def check_rise_limit(module: ModuleType) -> None:
    for limit in (0.0, 0.1, 0.5):
        for start in (0.0, 0.3, 1.7):
            for sign in (1, -1):
                plan = replace(FREE, rise_limit=limit)
                ramp = [sign * (0.0 if limit == 0 else n * limit) for n in range(4)] if start else [0.0]
                begin = ramp[-1]
                top = abs(begin) + limit
                assert last(module, plan, [*ramp, sign * top]) == ""
                assert last(module, plan, [*ramp, sign * up(top)]) == Rejection.RISE
                if limit:  # through zero: only the rise from zero counts
                    assert last(module, plan, [*ramp, -sign * limit]) == ""
                    assert last(module, plan, [*ramp, -sign * up(limit)]) == Rejection.RISE


def check_fall_limit(module: ModuleType) -> None:
    for limit in (0.0, 0.1, 0.5):
        for start in (0.3, 0.5, 1.7):
            for sign in (1, -1):
                plan = replace(FREE, fall_limit=limit)
                bottom = start - limit
                if bottom <= 0:  # falling to zero, and rising on the other side, is allowed
                    assert last(module, plan, [sign * start, -sign * 9.0]) == ""
                    continue
                assert last(module, plan, [sign * start, sign * bottom]) == ""
                assert last(module, plan, [sign * start, sign * 9.0]) == ""
                below = math.nextafter(bottom, -INF)
                assert last(module, plan, [sign * start, sign * below]) == Rejection.FALL
                assert last(module, plan, [sign * start, -sign * 0.01]) == Rejection.FALL
                assert last(module, plan, [sign * start, 0.0]) == Rejection.FALL


def check_change_of_sign(module: ModuleType) -> None:
    plan = replace(FREE, rise_limit=0.5, fall_limit=1.0)
    for sign in (1, -1):
        ramp = [sign * 0.5, sign * 1.0]
        assert last(module, plan, [*ramp, -sign * 0.5]) == ""
        assert last(module, plan, [*ramp, -sign * up(0.5)]) == Rejection.RISE
        ramp = [sign * 0.5, sign * up(1.0)]
        assert last(module, replace(plan, rise_limit=0.75), [*ramp, -sign * 0.25]) == Rejection.FALL


def check_window_limit(module: ModuleType) -> None:
    plan = replace(FREE, window_limit=1.5)
    for sign in (1, -1):
        assert last(module, plan, [sign * 1.5]) == ""
        assert last(module, plan, [sign * up(1.5)]) == Rejection.WINDOW  # the window holds the zero at the start
        assert last(module, plan, [sign * 0.5, sign * 0.25, -sign * 1.0]) == ""
        assert last(module, plan, [sign * 0.5, sign * 0.25, -sign * up(1.0)]) == Rejection.WINDOW
        # a torque 250 ms ago is in the window; one nanosecond earlier it is not
        gate = module.Envelope(plan)
        assert sent(gate, 0, sign * 1.0) == ""
        assert sent(gate, WINDOW, sign * 2.0) == Rejection.WINDOW
        for at in (WINDOW + 1, WINDOW + 2):
            gate = module.Envelope(plan)
            assert sent(gate, 0, sign * 1.0) == ""
            assert sent(gate, 1, sign * 1.0) == ""
            assert sent(gate, at, sign * 3.0) == ("" if at == WINDOW + 2 else Rejection.WINDOW)
    # torques within their own limit may be too far apart until the window is twice as wide
    for window in (1.5, math.nextafter(2.0, 0.0)):
        plan = replace(FREE, torque_limit=1.0, window_limit=window)
        assert last(module, plan, [-1.0, 0.5]) == ""
        assert last(module, plan, [-1.0, 1.0]) == Rejection.WINDOW
    assert last(module, replace(FREE, torque_limit=1.0, window_limit=2.0), [-1.0, 1.0]) == ""
    assert last(module, replace(FREE, window_limit=0.0), [0.0, 0.0]) == ""
    assert last(module, replace(FREE, window_limit=0.0), [0.0, 5e-324]) == Rejection.WINDOW


def check_age(module: ModuleType) -> None:
    for stale_ns in (0, 20 * MS):
        plan = replace(FREE, stale_ns=stale_ns)
        for now in (-3, 0, 7 * MS):
            assert module.Envelope(plan).check(now, now - stale_ns, 1.0, 2.0) == (1.0, 2.0, None)
            assert module.Envelope(plan).check(now, now - stale_ns - 1, 1.0, 2.0) == (0, 0, Rejection.STALE)
            assert module.Envelope(plan).check(now, now + 1, 1.0, 2.0) == (0, 0, Rejection.FUTURE)


def check_clock(module: ModuleType) -> None:
    gate = module.Envelope(FREE)
    assert [sent(gate, now, 1.0) for now in (-5, -5, 10, 10)] == [""] * 4
    assert gate.check(9, 9, 1.0, 1.0).reason == Rejection.CLOCK
    assert [sent(gate, now, 1.0) for now in (9, 10)] == [Rejection.CLOCK, ""]
    gate.stop(20)
    gate.stop(15)  # does not turn the gate's clock back
    assert [sent(gate, now, 1.0) for now in (19, 20)] == [Rejection.CLOCK, ""]
    assert gate.check(30, 31, 0.0, 0.0).reason == Rejection.FUTURE  # a refused command also sets the gate's clock
    assert [sent(gate, now, 1.0) for now in (29, 30)] == [Rejection.CLOCK, ""]
    assert gate.rejections == {Rejection.CLOCK: 4, Rejection.FUTURE: 1}


def check_after_zero_all_begins_anew(module: ModuleType) -> None:
    plan = EnvelopePlan(5.0, 0.5, 0.25, 2.0, 10**18)

    def risen() -> Any:
        gate = module.Envelope(plan)
        assert [sent(gate, n, 0.5 * n, -0.5 * n) for n in range(4)] == [""] * 4
        return gate

    gate = risen()
    assert sent(gate, 4, 1.5, math.nan) == Rejection.NOT_FINITE
    assert sent(gate, 5, 1.5, -1.5) == Rejection.RISE  # refused until it starts near zero
    assert sent(gate, 6, 0.5, -0.5) == ""
    gate = risen()
    gate.stop(4)
    assert gate.rejections == Counter()
    assert sent(gate, 5, -0.5, 0.5) == ""  # the fall to zero does not count in the window
    assert [sent(gate, 5 + n, -0.5 * n, 0.0) for n in (2, 3, 4)] == [Rejection.FALL, Rejection.RISE, Rejection.RISE]
    assert gate.rejections == {Rejection.FALL: 1, Rejection.RISE: 2}
    gate = module.Envelope(replace(FREE, window_limit=2.0))
    assert sent(gate, 0, 1.0) == ""
    gate.stop(1)
    assert sent(gate, 2 + WINDOW, 3.0) == ""
    gate.stop(3 + WINDOW)
    assert sent(gate, 3 + 2 * WINDOW, 3.0) == Rejection.WINDOW
    gate.stop(3 + 2 * WINDOW)
    assert sent(gate, 4 + 3 * WINDOW, 3.0) == ""
    gate.stop(5 + 3 * WINDOW)
    assert sent(gate, 4 + 3 * WINDOW, 1.0) == Rejection.CLOCK  # zero, at the latest time that the gate knows
    assert sent(gate, 5 + 4 * WINDOW, 3.0) == Rejection.WINDOW


def check_one_wheel_stops_both(module: ModuleType) -> None:
    plan = replace(FREE, torque_limit=1.0)
    assert sent(module.Envelope(plan), 0, 2.0, 0.5) == Rejection.TORQUE
    assert sent(module.Envelope(plan), 0, 0.5, 2.0) == Rejection.TORQUE
    assert sent(module.Envelope(plan), 0, 2.0, 2.0) == Rejection.TORQUE


def check_limits_that_are_none(module: ModuleType) -> None:
    for name in ("torque_limit", "rise_limit", "fall_limit", "window_limit", "stale_ns"):
        for bad in (-1, -5e-324, math.nan):
            limits: dict[str, Any] = {name: bad}
            with pytest.raises(ValueError, match=f"{name} must be 0 or more, not {bad}"):
                module.Envelope(replace(FREE, **limits))
        zero: dict[str, Any] = {name: 0}
        module.Envelope(replace(FREE, **zero))


class SlowGate:
    """The rules of the envelope, written directly: it keeps all torques since the gate's last zero, as exact fractions."""

    def __init__(self, plan: EnvelopePlan) -> None:
        self.plan = plan
        self.latest: int | None = None
        self.history: list[tuple[int, Fraction, Fraction]] = []

    def violated(self, now: int, command: int, torques: tuple[float, float]) -> set[Rejection]:
        """Returns all rules that these torques break."""
        plan = self.plan
        if self.latest is None:
            self.stop(now)
        assert self.latest is not None
        broken = set()
        if now < self.latest:
            broken.add(Rejection.CLOCK)
        if command > now:
            broken.add(Rejection.FUTURE)
        if command < now - plan.stale_ns:
            broken.add(Rejection.STALE)
        if not all(abs(torque) < INF for torque in torques):
            return broken | {Rejection.NOT_FINITE}
        exact = Fraction(torques[0]), Fraction(torques[1])
        for wheel, torque in enumerate(exact, 1):
            before = self.history[-1][wheel]
            assert isinstance(before, Fraction)
            rise, fall = abs(torque), abs(before)
            if torque * before > 0:
                rise, fall = abs(torque) - abs(before), abs(before) - abs(torque)
            if abs(torque) > plan.torque_limit:
                broken.add(Rejection.TORQUE)
            if rise > plan.rise_limit:
                broken.add(Rejection.RISE)
            if fall > plan.fall_limit:
                broken.add(Rejection.FALL)
            window = [entry[wheel] for entry in self.history if now - entry[0] <= WINDOW]
            if max(*window, torque, torque) - min(*window, torque, torque) > plan.window_limit:
                broken.add(Rejection.WINDOW)
        if not broken:
            self.latest = now
            self.history.append((now, *exact))
        return broken

    def stop(self, now: int) -> None:
        """Notes that zero is sent."""
        self.latest = now if self.latest is None else max(self.latest, now)
        self.history = [(self.latest, Fraction(0), Fraction(0))]


def step(gate: Any, slow: SlowGate, now: int, age: int, torques: tuple[float, float]) -> bool:
    """Gives one command to both gates; returns True if it passed.  Asserts that they agree."""
    before = Counter(gate.rejections)
    broken = slow.violated(now, now - age, torques)
    right, left, reason = gate.check(now, now - age, *torques)
    if not broken:
        assert (right, left, reason) == (*torques, None)
        assert gate.rejections == before
        return True
    slow.stop(now)
    assert (right, left) == (0.0, 0.0)
    assert reason in broken
    before[reason] += 1
    assert gate.rejections == before
    return False


GAPS = [0] * 3 + [1, MS] * 9 + [WINDOW // 10] * 30 + [WINDOW - MS, WINDOW, WINDOW + 1]
AGES = [0, 1, 2, 3] * 22 + [-1, 4]


def check_against_the_slow_gate(module: ModuleType) -> None:
    random = Random(1)
    passed = 0
    for _ in range(12):
        highest, rise, fall, window = (random.choice([INF, n / 8]) for n in (24, 6, 8, 20))
        plan = EnvelopePlan(highest, rise, fall, window, 3)
        gate, slow = module.Envelope(plan), SlowGate(plan)
        now = random.randint(-WINDOW, WINDOW)
        right = left = 0.0
        for _ in range(150):
            now += random.choice(GAPS)
            right += random.randint(-9, 9) / 8 * random.randint(0, 1)
            left += random.randint(-9, 9) / 8 * random.randint(0, 1)
            if step(gate, slow, now, random.choice(AGES), (right, left)):
                passed += 1
            else:
                right = left = 0.0
    assert 500 < passed < 1700


CHECKS: list[Callable[[ModuleType], None]] = [value for name, value in list(globals().items()) if name[:6] == "check_"]
