"""The motor, compared with numerical solutions of its differential equations and with closed-form solutions."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from echelon.bridge.protocols.faults import LATCHING, ON_DEMAND, Fault
from echelon.bridge.protocols.motor import Motor
from echelon.bridge.protocols.motor_physics import STEP_NS
from echelon.plan.can_plan import MotorPlan
from support.bench_drives import MOTOR, MS, motor_plan

K_T = MOTOR.torque_constant


def pieces(events: list[tuple[float, float]], end: float, plan: MotorPlan) -> list[tuple[float, float, float, float]]:
    """Returns the straight pieces of the setpoint, (from, to, setpoint at the start, slope), for events (time, torque)."""
    found, at = [], 0.0
    for (start, wanted), stop in zip(events, [time for time, _ in events[1:]] + [end], strict=True):
        goal = float(np.clip(wanted, -plan.torque_limit, plan.torque_limit))
        if math.isinf(plan.torque_slew):
            at, ramp = goal, 0.0
        else:
            # compared as durations: by rounding, start + (stop - start) may be before stop
            ramp = min(abs(goal - at) / plan.torque_slew, stop - start)
        slope = math.copysign(plan.torque_slew, goal - at) if ramp else 0.0
        if ramp:
            found.append((start, start + ramp, at, slope))
        at = goal if ramp < stop - start else at + slope * ramp
        if ramp < stop - start:
            found.append((start + ramp, stop, at, 0.0))
    return found


def solve(events: list[tuple[float, float]], end: float, plan: MotorPlan) -> tuple[float, float, float]:
    """Returns the shaft torque at the end, ∫τ and ∫τ², by Runge-Kutta over each straight piece of the setpoint."""
    state = [0.0, 0.0, 0.0]
    for start, stop, setpoint, slope in pieces(events, end, plan):

        def rates(t: float, y: list[float], s: float = setpoint, k: float = slope, t0: float = start) -> list[float]:
            return [(s + k * (t - t0) - y[0]) / plan.lag, y[0], y[0] ** 2]

        solved = solve_ivp(rates, (start, stop), state, method="DOP853", rtol=1e-11, atol=1e-13)
        state = list(solved.y[:, -1])
    return state[0], state[1], state[2]


event_lists = st.lists(
    st.tuples(st.integers(1, 30_000), st.floats(-2.0, 2.0, allow_subnormal=False)), min_size=1, max_size=6
)


@settings(max_examples=60, deadline=None)
@given(event_lists, st.sampled_from([1e-3, 5e-3, 0.05]), st.sampled_from([5.0, 80.0, math.inf]), st.integers(0, 5))
@example([(205, 0.0), (1057, 1.0), (1, 0.0)], 1e-3, 5.0, 0)
def test_torque_mean_and_heat_are_those_of_the_differential_equation(
    steps: list[tuple[int, float]], lag: float, slew: float, asked: int
) -> None:
    """Any list of torques.  `asked` additional calls of `advance` in between must not change the result."""
    thermal_time = 2.0
    plan = motor_plan(lag=lag, torque_slew=slew, thermal_time=thermal_time, supply_resistance=0.0)
    motor, time_us, events = Motor(plan), 0, []
    motor.advance(0)
    for wait_us, torque in steps:
        motor.set_torque(time_us * 1000, torque)
        events.append((time_us * 1e-6, torque))
        for look in range(asked):
            motor.advance(time_us * 1000 + wait_us * 1000 * look // asked)
        time_us += wait_us
    torque, area, square = solve(events, time_us * 1e-6, plan)
    assert motor.mean_torque(time_us * 1000) == pytest.approx(area / (time_us * 1e-6), rel=1e-8, abs=1e-9)
    assert motor.torque == pytest.approx(torque, rel=1e-8, abs=1e-9)
    # zero torque to the next step: the heat of the step must not be lost; the temperature rise is linear in it
    motor.cut(time_us * 1000)
    end_ns = (time_us * 1000 // STEP_NS + 1) * STEP_NS
    motor.advance(end_ns)
    most = plan.resistance * plan.thermal_resistance * square / K_T**2 / thermal_time
    least = most * math.exp(-(end_ns * 1e-9 + STEP_NS * 1e-9) / thermal_time)
    assert least - 1e-9 <= motor.temperature - plan.ambient <= most * (1 + 0.005) + 1e-9


def test_heat_of_one_step_is_exact() -> None:
    plan = motor_plan(lag=4e-3, torque_slew=300.0, thermal_time=2.0)
    motor = Motor(plan)
    motor.advance(0)
    motor.set_torque(0, 1.2)
    motor.advance(STEP_NS)
    _, _, square = solve([(0.0, 1.2)], 0.01, plan)
    warm = plan.thermal_resistance * plan.resistance * square / 0.01 / K_T**2
    assert motor.temperature - plan.ambient == pytest.approx(warm * (1 - math.exp(-0.01 / 2.0)), rel=1e-9)


def test_without_lag_or_ramp_the_shaft_follows_at_once() -> None:
    motor = Motor(MOTOR)
    motor.set_torque(-20 * MS, 0.5)
    assert (motor.torque, motor.setpoint, motor.current, motor.current_setpoint) == (0.5, 0.5, 4.0, 4.0)
    assert motor.mean_torque(-20 * MS) == 0.5
    motor.set_torque(-17 * MS, -1.0)
    motor.set_torque(-11 * MS, 9.0)
    assert motor.torque == 1.5
    assert motor.mean_torque(-10 * MS) == pytest.approx((0.5 * 3 - 1.0 * 6 + 1.5) / 10)
    motor.cut(-10 * MS)
    assert motor.mean_torque(0) == 0.0


def test_slew_without_lag() -> None:
    motor = Motor(motor_plan(torque_slew=100.0))
    motor.set_torque(0, 1.0)
    motor.advance(4 * MS)
    assert (motor.torque, motor.setpoint) == (pytest.approx(0.4), pytest.approx(0.4))
    assert motor.mean_torque(20 * MS) == pytest.approx((0.5 * 10 + 1.0 * 10) / 20)
    motor.set_torque(20 * MS, -1.0)
    motor.advance(30 * MS)
    assert motor.torque == pytest.approx(0.0, abs=1e-12)


def test_cut_needs_no_ramp() -> None:
    motor = Motor(motor_plan(torque_slew=10.0, lag=0.01))
    motor.set_torque(0, 1.0)
    motor.advance(50 * MS)
    assert motor.torque > 0.1
    motor.cut(50 * MS)
    assert (motor.torque, motor.setpoint) == (0.0, 0.0)
    motor.mean_torque(50 * MS)
    assert motor.mean_torque(90 * MS) == 0.0


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(0, 40), st.floats(-1.5, 1.5), st.booleans()), min_size=1, max_size=20))
def test_means_add_up(calls: list[tuple[int, float, bool]]) -> None:
    """The means over windows, weighted by their lengths, give the mean over the whole time, wherever the windows end."""
    plan = motor_plan(torque_slew=60.0, lag=2e-3)
    one, other, time_ns, total = Motor(plan), Motor(plan), 0, 0.0
    one.advance(0)
    other.advance(0)
    last_ns = 0
    for wait, torque, look in calls:
        one.set_torque(time_ns, torque)
        other.set_torque(time_ns, torque)
        time_ns += wait * 100_000
        if look:
            total += one.mean_torque(time_ns) * (time_ns - last_ns)
            last_ns = time_ns
    total += one.mean_torque(time_ns) * (time_ns - last_ns)
    assert total == pytest.approx(other.mean_torque(time_ns) * time_ns, rel=1e-9, abs=1e-3)


def test_a_winding_warms_as_the_law_says() -> None:
    plan = motor_plan(thermal_time=20.0, derating_from=1e9, temperature_limit=1e9, brown_out=0.0)
    motor = Motor(plan)
    motor.set_torque(0, 0.75)
    final = plan.ambient + plan.thermal_resistance * plan.resistance * 36.0  # I = 6 A
    for seconds in (1, 5, 20, 60):
        motor.advance(seconds * 1000 * MS)
        assert motor.temperature == pytest.approx(final - 18.0 * math.exp(-seconds / 20.0), rel=1e-9)
    motor.cut(60_000 * MS)
    hot = motor.temperature
    motor.advance(70_000 * MS)
    assert motor.temperature == pytest.approx(25.0 + (hot - 25.0) * math.exp(-0.5), rel=1e-9)


def test_derating_settles_where_heat_and_limit_meet() -> None:
    plan = motor_plan(thermal_time=2.0, thermal_resistance=3.0)
    motor = Motor(plan)
    motor.set_torque(0, 5.0)
    assert motor.torque == 1.5
    motor.advance(60_000 * MS)
    # 25 + 3 R τ²/K² = T and τ = 1.5 (120 - T)/30: a quadratic equation for τ
    a = plan.thermal_resistance * plan.resistance / K_T**2
    torque = (-20.0 + math.sqrt(400.0 + 4 * a * (120.0 - 25.0))) / (2 * a)
    assert motor.torque == pytest.approx(torque, rel=1e-9)
    assert motor.limit == motor.torque
    assert 90.0 < motor.temperature < 120.0
    assert motor.advance(60_000 * MS) is None


def test_over_temperature_cuts_when_it_happens() -> None:
    plan = motor_plan(thermal_time=2.0, derating_from=60.0, temperature_limit=60.0)
    motor = Motor(plan)
    motor.set_torque(0, 1.2)
    rise = plan.thermal_resistance * plan.resistance * (1.2 / K_T) ** 2
    at = -2.0 * math.log(1 - 35.0 / rise)  # when 60 °C are reached
    at_ns = math.ceil(at * 1e9 / STEP_NS) * STEP_NS
    assert motor.advance(at_ns - 1) is None
    motor.mean_torque(at_ns - 1)
    assert motor.mean_torque(at_ns + 1) == pytest.approx(0.6)
    assert motor.advance(at_ns + 5 * MS) is Fault.OVER_TEMPERATURE
    assert motor.advance(at_ns + 5 * MS) is None
    assert Fault.OVER_TEMPERATURE in motor.causes
    motor.advance(at_ns + 100 * MS)
    assert motor.causes == frozenset()
    assert motor.torque == 0.0


def test_supply_voltage_falls_with_power() -> None:
    plan = motor_plan(supply_resistance=0.5)
    motor = Motor(plan)
    motor.set_speed(0, 40.0)
    motor.set_torque(0, 1.0)
    motor.advance(STEP_NS)
    power = 40.0 + 0.25 * 64.0
    assert motor.bus_voltage * (24.0 - motor.bus_voltage) / 0.5 == pytest.approx(power)  # V I = P
    assert 12.0 < motor.bus_voltage < 24.0
    motor.set_torque(STEP_NS, -0.1)  # braking feeds back
    motor.advance(2 * STEP_NS)
    assert motor.bus_voltage > 24.0


@pytest.mark.parametrize(("resistance", "volts"), [(2.0, 15.31662479), (3.0, 12.0)])
def test_brown_out(resistance: float, volts: float) -> None:
    """The second supply cannot deliver the power at all."""
    motor = Motor(motor_plan(supply_resistance=resistance, brown_out=16.0))
    motor.set_speed(0, 50.5)
    motor.set_torque(0, 1.0)  # 66.5 W: 15.317 V at 2 ohms
    assert motor.advance(STEP_NS - 1) is None
    assert motor.advance(STEP_NS) is Fault.BROWN_OUT
    assert motor.bus_voltage == pytest.approx(volts)
    assert motor.torque == 0.0
    assert motor.causes == {Fault.BROWN_OUT}
    assert motor.advance(2 * STEP_NS) is None
    assert motor.causes == frozenset()
    assert motor.bus_voltage == 24.0


@settings(max_examples=50, deadline=None)
@given(st.floats(-1.0, 1.0), st.sampled_from([0.0, 1e-9, 1e-4, 0.02, 3.0]), st.integers(1, 3000))
def test_a_bench_wheel_turns_as_mechanics_says(torque: float, friction: float, time_ms: int) -> None:
    plan = motor_plan(friction=friction, supply_resistance=0.0, thermal_resistance=0.0)
    motor = Motor(plan)
    motor.advance(0)
    motor.set_torque(0, torque)
    motor.advance(time_ms * MS)

    def rates(_: float, y: list[float]) -> list[float]:
        return [(torque - friction * y[0]) / plan.inertia, y[0]]

    solved = solve_ivp(rates, (0, time_ms * 1e-3), [0.0, 0.0], method="Radau" if friction > 1 else "DOP853", rtol=1e-9)
    omega, angle = solved.y[:, -1]
    assert motor.omega == pytest.approx(omega, rel=1e-6, abs=1e-6)
    revolutions = angle / (2 * math.pi)
    assert abs(motor.position - revolutions) <= 1 / plan.encoder_counts + 1e-6 * abs(revolutions) + 1e-6


def test_a_bench_wheel_lags_little_behind_the_exact_one() -> None:
    plan = motor_plan(lag=5e-3, friction=0.5)
    motor = Motor(plan)
    motor.set_torque(0, 1.0)
    for time_ms in range(1, 60):
        motor.advance(time_ms * MS)
    a, b = plan.friction / plan.inertia, 1 / plan.lag  # ω' = (1 - e^(-bt))/J - a ω
    t = 0.059
    exact = ((1 - math.exp(-a * t)) / a - (math.exp(-b * t) - math.exp(-a * t)) / (a - b)) / plan.inertia
    assert motor.omega == pytest.approx(exact, rel=5e-3)


def test_encoder() -> None:
    plan = motor_plan(encoder_counts=1000)
    motor = Motor(plan)
    motor.set_speed(0, 2 * math.pi * 1.2345)
    motor.advance(10 * MS)
    assert (motor.counts, motor.position) == (12, 0.012)
    assert motor.velocity == pytest.approx(1.2)
    motor.advance(1000 * MS)
    assert motor.counts == 1234
    motor.set_speed(1000 * MS, -2 * math.pi)
    motor.advance(3000 * MS)
    assert motor.counts == pytest.approx(-766, abs=1)
    assert motor.velocity == pytest.approx(-1.0, abs=0.11)
    assert motor.torque == 0.0


def test_a_lost_encoder_stands_still() -> None:
    motor = Motor(MOTOR)
    motor.set_speed(0, 10.0)
    motor.set_torque(0, 0.5)
    motor.inject(500 * MS, Fault.ENCODER_LOSS)
    assert motor.torque == 0.0
    counts = motor.counts
    assert counts == int(5.0 / (2 * math.pi) * 8192)
    motor.advance(1000 * MS)
    assert (motor.counts, motor.velocity) == (counts, 0.0)
    motor.mend(1000 * MS, Fault.ENCODER_LOSS)
    assert motor.counts == int(10.0 / (2 * math.pi) * 8192)


@pytest.mark.parametrize("fault", LATCHING)
def test_faults_on_demand(fault: Fault) -> None:
    motor = Motor(motor_plan(lag=0.01))
    motor.set_torque(0, 1.0)
    motor.inject(30 * MS, fault)
    assert (motor.torque, motor.setpoint, motor.causes) == (0.0, 0.0, {fault})
    motor.mend(40 * MS, fault)
    assert motor.causes == frozenset()
    assert motor.torque == 0.0


@pytest.mark.parametrize("lag", [0.0, 5e-3])
@pytest.mark.parametrize("slew", [50.0, math.inf])
def test_stuck_torque_stays_whatever_is_said(lag: float, slew: float) -> None:
    motor = Motor(motor_plan(lag=lag, torque_slew=slew))
    motor.set_torque(0, 0.8)
    motor.advance(10 * MS)
    stuck = motor.torque
    assert stuck > 0.2
    motor.inject(10 * MS, Fault.STUCK_TORQUE)
    motor.mean_torque(10 * MS)
    motor.set_torque(20 * MS, -1.0)
    motor.advance(100 * MS)
    assert (motor.torque, motor.setpoint) == (stuck, -1.0)
    motor.cut(100 * MS)
    motor.inject(110 * MS, Fault.OVER_TEMPERATURE)
    assert motor.torque == stuck
    assert motor.mean_torque(200 * MS) == pytest.approx(stuck)
    assert motor.causes == {Fault.OVER_TEMPERATURE}
    motor.mend(200 * MS, Fault.STUCK_TORQUE)
    assert motor.torque == 0.0


def test_torque_that_is_free_again_goes_to_the_setpoint() -> None:
    for lag in (0.0, 0.01):
        motor = Motor(motor_plan(lag=lag))
        motor.set_torque(0, 0.5)
        motor.inject(1000 * MS, Fault.STUCK_TORQUE)
        motor.set_torque(1000 * MS, -0.5)
        motor.mend(1010 * MS, Fault.STUCK_TORQUE)
        assert motor.torque == (0.5 if lag else -0.5)
        motor.advance(1020 * MS)
        assert motor.torque == pytest.approx(-0.5 + math.exp(-1.0) if lag else -0.5)


def test_refused() -> None:
    motor = Motor(MOTOR)
    motor.advance(10)
    for bad in (math.nan, math.inf):
        with pytest.raises(ValueError, match="torque must be finite"):
            motor.set_torque(10, bad)
        with pytest.raises(ValueError, match="speed must be finite"):
            motor.set_speed(10, bad)
    with pytest.raises(ValueError, match="9 ns after 10 ns"):
        motor.advance(9)
    for fault in (Fault.SILENT, Fault.WATCHDOG, Fault.ESTOP):
        with pytest.raises(ValueError, match=fault):
            motor.inject(10, fault)
    assert set(Fault) - set(ON_DEMAND) == {Fault.WATCHDOG, Fault.ESTOP}


@pytest.mark.parametrize(
    ("name", "value"),
    [("torque_constant", 0.0), ("inertia", -1.0), ("torque_slew", 0.0), ("lag", -1.0), ("friction", math.nan)],
)
def test_a_plan_that_is_none(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        Motor(replace(MOTOR, **{name: value}))  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="derating_from"):
        Motor(motor_plan(derating_from=121.0))
