"""The motor behind a virtual drive: how the torque on one wheel's shaft follows what the protocol asks for.

Setpoint: limited (torque limit, derated by temperature), then ramped with the slew limit.  Shaft torque follows it as a
first-order lag, τ' = (setpoint - τ)/lag, in closed form between two events; without lag it is the setpoint:

    setpoint = s + k t  gives  τ = s + k (t - lag) + (τ0 - s + k lag) e^(-t/lag)

What is slow is looked at every 10 ms, at multiples of `STEP_NS`, so that it does not depend on when anyone asks:

- winding: thermal_time T' = ambient + thermal_resistance · resistance · I² - T, I = τ/torque_constant, exact for the mean
  of I² in a step, since thermal times are seconds and more;
- bus voltage V: power P = τ ω + resistance · I², its mean in the step, comes as P/V through the supply's resistance;
  V = supply_voltage - supply_resistance · P/V is a quadratic equation, of which the larger root is the stable one.
  Where there is none, the supply cannot give P; V is then half the supply voltage, where it gives most;
- velocity: encoder counts in the step.

A wheel on a bench, inertia ω' = τ - friction ω, moves by the mean torque between two events: exact while torque is
constant, and as good as the rest needs while it lags, for events are milliseconds apart.
"""

from enum import StrEnum
from math import exp, expm1, floor, isfinite, sqrt, tau
from typing import Final

from echelon.plan.can_plan import MotorPlan

STEP_NS: Final = 10_000_000
STEP: Final = STEP_NS * 1e-9
"""Temperature, bus voltage and velocity are measured at multiples of this [s]."""


class Fault(StrEnum):
    """What can go wrong with a drive; each latches, and takes the torque away, but `STUCK_TORQUE` and `SILENT`."""

    OVER_TEMPERATURE = "over_temperature"
    ENCODER_LOSS = "encoder_loss"
    BROWN_OUT = "brown_out"
    STUCK_TORQUE = "stuck_torque"
    """The shaft torque stays what it is, whatever is commanded, for as long as the fault lasts."""
    SILENT = "silent"
    """The drive neither hears nor says anything, and its torque is zero, for as long as the fault lasts."""
    WATCHDOG = "watchdog"
    ESTOP = "estop"


LATCHING: Final = (Fault.OVER_TEMPERATURE, Fault.ENCODER_LOSS, Fault.BROWN_OUT)
"""Faults that can be made to happen, and that the drive latches."""
ON_DEMAND: Final = (*LATCHING, Fault.STUCK_TORQUE, Fault.SILENT)
"""Faults that can be made to happen; the others come of what the bus says, or does not."""


class Motor:
    """One wheel's motor; instants in ns, SI units.  The first call sets the time; it never runs backwards.

    Raises ValueError for a plan that is none, time that runs backwards, and numbers that are not finite.
    """

    def __init__(self, plan: MotorPlan) -> None:
        _check(plan)
        self.plan = plan
        self._thermal_decay = exp(-STEP / plan.thermal_time) if plan.thermal_time else 0.0
        self._now_ns: int | None = None
        self._next_ns = self._window_ns = 0  # the next step; where the mean begins
        self._wanted = self._target = self._setpoint = self._torque = 0.0
        self._limit = plan.torque_limit
        self._slew = 0.0  # of the setpoint at present, with its sign
        self._off = True
        self._area = self._square = self._work = 0.0  # integrals of τ (since _window_ns), of τ² and τ ω (since a step)
        self._temperature, self._voltage = plan.ambient, plan.supply_voltage
        self._omega = self._turned = self._velocity = 0.0  # [rad/s], [rad], [rev/s]
        self._counts = 0  # at the last step
        self._counts_lost = 0  # what the encoder said when it was lost
        self._driven = self._stuck = False
        self._injected: set[Fault] = set()
        self._tripped: Fault | None = None
        self._derate()

    @property
    def torque(self) -> float:
        """Shaft torque now [N m]"""
        return self._torque

    @property
    def setpoint(self) -> float:
        """What the current loop is told: limited and ramped [N m]"""
        return self._setpoint

    @property
    def limit(self) -> float:
        """Largest torque at this temperature [N m]"""
        return self._limit

    @property
    def current(self) -> float:
        """[A]"""
        return self._torque / self.plan.torque_constant

    @property
    def current_setpoint(self) -> float:
        """[A]"""
        return self._setpoint / self.plan.torque_constant

    @property
    def temperature(self) -> float:
        """Of the winding, at the last step [°C]"""
        return self._temperature

    @property
    def bus_voltage(self) -> float:
        """Mean in the last step [V]"""
        return self._voltage

    @property
    def counts(self) -> int:
        """Encoder counts since the start; what they were, while the encoder is lost"""
        return self._counts_lost if Fault.ENCODER_LOSS in self._injected else self._encoder()

    @property
    def position(self) -> float:
        """As the encoder has it [rev]"""
        return self.counts / self.plan.encoder_counts

    @property
    def velocity(self) -> float:
        """Encoder counts in the last step, per second [rev/s]"""
        return self._velocity

    @property
    def omega(self) -> float:
        """The wheel's true speed [rad/s]"""
        return self._omega

    @property
    def causes(self) -> frozenset[Fault]:
        """Faults whose cause is there now, on demand or by physics: those a drive cannot clear."""
        found = self._injected - {Fault.STUCK_TORQUE}
        if self._temperature >= self.plan.temperature_limit:
            found.add(Fault.OVER_TEMPERATURE)
        if self._voltage < self.plan.brown_out:
            found.add(Fault.BROWN_OUT)
        return frozenset(found)

    def advance(self, time_ns: int) -> Fault | None:
        """Lets time pass; returns a fault that its physics caused by then (over-temperature, brown-out).

        The torque is cut when that happens, even if it is noticed later.
        """
        self._go(time_ns)
        fault, self._tripped = self._tripped, None
        return fault

    def set_torque(self, time_ns: int, torque: float) -> None:
        """Sets the wanted shaft torque [N m]."""
        if not isfinite(torque):
            raise ValueError(f"torque must be finite, not {torque!r}")
        self._go(time_ns)
        self._wanted = torque
        self._off = False
        self._aim()

    def cut(self, time_ns: int) -> None:
        """Takes all torque away at once, without ramp or lag: the power stage is off."""
        self._go(time_ns)
        self._cut()

    def set_speed(self, time_ns: int, omega: float) -> None:
        """Sets the wheel's speed [rad/s]: a robot turns it.  A motor that is never told so has a wheel on a bench."""
        if not isfinite(omega):
            raise ValueError(f"speed must be finite, not {omega!r}")
        self._go(time_ns)
        self._driven, self._omega = True, omega

    def mean_torque(self, time_ns: int) -> float:
        """Returns the mean of the shaft torque since the last call [N m], and begins a new mean."""
        self._go(time_ns)
        duration_ns = time_ns - self._window_ns
        mean = self._area / (duration_ns * 1e-9) if duration_ns else self._torque
        self._window_ns, self._area = time_ns, 0.0
        return mean

    def inject(self, time_ns: int, fault: Fault) -> None:
        """Makes a fault happen: one of `LATCHING` cuts the torque, `STUCK_TORQUE` freezes it.

        The others concern the drive: ValueError.
        """
        self._go(time_ns)
        if fault not in (*LATCHING, Fault.STUCK_TORQUE):
            raise ValueError(f"no fault of a motor: {fault!r}; there are {', '.join(LATCHING)}, {Fault.STUCK_TORQUE}")
        if fault is Fault.STUCK_TORQUE:
            self._stuck = True
        elif fault not in self._injected:
            self._counts_lost = self._encoder() if fault is Fault.ENCODER_LOSS else self._counts_lost
            self._injected.add(fault)
            self._cut()

    def mend(self, time_ns: int, fault: Fault) -> None:
        """Takes the cause of a fault away; the torque then is what it would be."""
        self._go(time_ns)
        self._injected.discard(fault)
        if fault is Fault.STUCK_TORQUE and self._stuck:
            self._stuck = False
            if self._off:
                self._torque = 0.0
            elif not self.plan.lag:
                self._torque = self._setpoint

    def _go(self, time_ns: int) -> None:
        now_ns = self._now_ns
        if now_ns is None:
            self._now_ns = self._window_ns = time_ns
            self._next_ns = (time_ns // STEP_NS + 1) * STEP_NS
        elif time_ns > now_ns:
            while self._next_ns <= time_ns:
                self._run(self._next_ns)
                self._step()
            if self._now_ns != time_ns:
                self._run(time_ns)
        elif time_ns < now_ns:
            raise ValueError(f"time must not run backwards: {time_ns} ns after {now_ns} ns")

    def _run(self, to_ns: int) -> None:
        """Follows the setpoint until an instant that is not after the next step."""
        assert self._now_ns is not None
        h = (to_ns - self._now_ns) * 1e-9
        self._now_ns = to_ns
        before = self._area
        if self._setpoint != self._target:
            ramp = min(h, (self._target - self._setpoint) / self._slew)
            self._follow(ramp, self._slew)
            if ramp < h:
                self._setpoint, self._slew = self._target, 0.0
                if not (self.plan.lag or self._stuck):
                    self._torque = self._setpoint
                self._follow(h - ramp, 0.0)
        else:
            self._follow(h, 0.0)
        area = self._area - before
        self._work += area * self._omega
        if self._driven:
            self._turned += self._omega * h
        else:
            self._turn(area / h, h)

    def _follow(self, h: float, slew: float) -> None:
        """Integrates the shaft torque over `h` while the setpoint goes with `slew`."""
        torque, setpoint, lag = self._torque, self._setpoint, self.plan.lag
        if self._stuck or (not slew and torque == setpoint):
            self._area += torque * h
            self._square += torque * torque * h
            self._setpoint += slew * h
            return
        # τ = a + k t + b e^(-t/lag)
        a, b = setpoint - slew * lag, 0.0
        self._setpoint = setpoint + slew * h
        self._area += (a + slew * h / 2) * h
        self._square += (a * a + (a + slew * h / 3) * slew * h) * h
        if lag:
            b = torque - a
            gone = -expm1(-h / lag)
            self._area += b * lag * gone
            self._square += 2 * b * lag * (a * gone + slew * (lag * gone - h * (1 - gone)))
            self._square += b * b * lag / 2 * gone * (2 - gone)
            b *= 1 - gone
        self._torque = a + slew * h + b

    def _turn(self, torque: float, h: float) -> None:
        """Turns a wheel on a bench with a constant torque, exactly."""
        x = self.plan.friction * h / self.plan.inertia
        part = -expm1(-x) / x if x else 1.0
        rest = (1 - part) / x if x > 1e-5 else 0.5 - x / 6  # the difference of equal numbers is none
        gain = torque * h / self.plan.inertia
        self._turned += (self._omega * part + gain * rest) * h
        self._omega = self._omega * exp(-x) + gain * part

    def _step(self) -> None:
        """Measures what is slow, at a multiple of STEP_NS."""
        plan = self.plan
        self._next_ns += STEP_NS
        copper = plan.resistance * self._square / (STEP * plan.torque_constant * plan.torque_constant)
        if plan.supply_resistance:
            root = plan.supply_voltage**2 / 4 - plan.supply_resistance * (self._work / STEP + copper)
            self._voltage = plan.supply_voltage / 2 + (sqrt(root) if root > 0 else 0.0)
        self._square = self._work = 0.0
        warm = plan.ambient + plan.thermal_resistance * copper
        temperature = warm + (self._temperature - warm) * self._thermal_decay
        if temperature != self._temperature:
            self._temperature = temperature
            self._derate()
        if self._temperature >= plan.temperature_limit:
            self._trip(Fault.OVER_TEMPERATURE)
        elif self._voltage < plan.brown_out:
            self._trip(Fault.BROWN_OUT)
        counts = self.counts
        self._velocity = (counts - self._counts) / (STEP * plan.encoder_counts)
        self._counts = counts

    def _derate(self) -> None:
        plan = self.plan
        limit = plan.torque_limit
        if self._temperature > plan.derating_from:
            span = plan.temperature_limit - plan.derating_from
            limit *= max(plan.temperature_limit - self._temperature, 0.0) / span if span else 0.0
        if limit != self._limit:
            self._limit = limit
            self._aim()

    def _aim(self) -> None:
        """Sets out for the wanted torque within the limit."""
        limit, slew, target = self._limit, self.plan.torque_slew, self._wanted
        target = limit if target > limit else -limit if target < -limit else target
        self._target = target
        if target == self._setpoint:
            return
        if isfinite(slew):
            self._slew = slew if target > self._setpoint else -slew
        else:
            self._setpoint = target
            if not (self.plan.lag or self._stuck):
                self._torque = target

    def _cut(self) -> None:
        self._off = True
        self._wanted = self._target = self._setpoint = 0.0
        if not self._stuck:
            self._torque = 0.0

    def _trip(self, fault: Fault) -> None:
        self._tripped = fault
        self._cut()

    def _encoder(self) -> int:
        return floor(self._turned / tau * self.plan.encoder_counts)


def _check(plan: MotorPlan) -> None:
    for name in ("torque_limit", "torque_slew", "torque_constant", "supply_voltage", "encoder_counts", "inertia"):
        if not getattr(plan, name) > 0:
            raise ValueError(f"{name} must be positive, not {getattr(plan, name)!r}")
    for name in ("lag", "resistance", "thermal_resistance", "thermal_time", "supply_resistance", "friction"):
        if not getattr(plan, name) >= 0:
            raise ValueError(f"{name} must not be negative, nor nan, but is {getattr(plan, name)!r}")
    if not plan.derating_from <= plan.temperature_limit:
        raise ValueError(
            f"derating_from must be at most temperature_limit {plan.temperature_limit!r}, not {plan.derating_from!r}"
        )
