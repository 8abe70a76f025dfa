"""The motor behind a virtual drive: how the torque τ on a wheel's shaft follows the wanted torque.

*Torque.*  The wanted torque is limited (torque limit, derated by temperature), then ramped with the slew limit.  This gives the
setpoint of the current loop.  The shaft torque follows with a first-order lag, τ' = (setpoint - τ)/lag; without lag it is
the setpoint.  Between two events the setpoint is s + k t, and the solution is exact:

    τ = s + k (t - lag) + (τ0 - s + k lag) e^(-t/lag)

*Slow quantities* are updated every 10 ms, at multiples of `STEP_NS`, so they do not depend on when the motor is called: the
winding temperature and the supply voltage at the drive (equations in `protocols.motor_physics`), by the means over the step of
the copper loss resistance · I² with I = τ/torque_constant, and of the power τ ω + resistance · I²; and the velocity, by the
encoder counts of the step.

*A wheel on a bench*, which no robot turns, moves by inertia ω' = τ - friction ω with the mean torque between two events: exact
while τ is constant, and with a small error while it lags, since events are milliseconds apart.
"""

from math import exp, expm1, floor, isfinite, tau

from echelon.bridge.protocols.faults import LATCHING, Fault
from echelon.bridge.protocols.motor_physics import (
    STEP,
    STEP_NS,
    check,
    supply_voltage,
    torque_limit,
    turned_freely,
    winding_temperature,
)  # fmt: skip
from echelon.plan.can_plan import MotorPlan


class Motor:
    """The motor of one wheel.  Instants are integers [ns], temperatures are in °C, the encoder's position and velocity in rev
    and rev/s, all else in SI units.  The first call sets the time.
    Raises ValueError for an impossible value in the plan, for time that runs backwards, and for a torque or a speed that is not
    finite."""

    def __init__(self, plan: MotorPlan) -> None:
        check(plan)
        self.plan = plan
        self._thermal_decay = exp(-STEP / plan.thermal_time) if plan.thermal_time else 0.0
        self._now_ns: int | None = None
        self._next_ns = self._window_ns = 0  # time of the next step; start of the mean torque
        # wanted by the drive; within the limit; ramped; on the shaft
        self._wanted = self._target = self._setpoint = self._torque = 0.0
        self._limit = plan.torque_limit
        self._slew = 0.0  # present slope of the setpoint [N m/s]
        self._off = True
        self._area = self._square = self._work = 0.0  # integrals: τ since _window_ns; τ² and τ ω since the last step
        self._temperature, self._voltage = plan.ambient, plan.supply_voltage
        self._omega = self._turned = self._velocity = 0.0  # [rad/s], [rad], [rev/s]
        self._counts = 0  # at the last step
        self._counts_lost = 0  # encoder counts at the instant at which the encoder was lost
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
        """Setpoint of the current loop, limited and ramped [N m]"""
        return self._setpoint

    @property
    def limit(self) -> float:
        """Largest torque at this temperature [N m]"""
        return self._limit

    @property
    def current(self) -> float:
        """Current at the shaft torque [A]"""
        return self._torque / self.plan.torque_constant

    @property
    def current_setpoint(self) -> float:
        """Current at the setpoint [A]"""
        return self._setpoint / self.plan.torque_constant

    @property
    def temperature(self) -> float:
        """Winding temperature at the last step [°C]"""
        return self._temperature

    @property
    def bus_voltage(self) -> float:
        """Supply voltage at the drive, mean over the last step [V]"""
        return self._voltage

    @property
    def counts(self) -> int:
        """Encoder counts since the start; they stay constant while the encoder is lost"""
        return self._counts_lost if Fault.ENCODER_LOSS in self._injected else self._encoder()

    @property
    def position(self) -> float:
        """Position by the encoder [rev]"""
        return self.counts / self.plan.encoder_counts

    @property
    def velocity(self) -> float:
        """Velocity by the encoder, mean over the last step [rev/s]"""
        return self._velocity

    @property
    def omega(self) -> float:
        """The wheel's true speed [rad/s]"""
        return self._omega

    @property
    def causes(self) -> frozenset[Fault]:
        """The faults whose cause is present: caused by a scenario, or by temperature or voltage.  A drive cannot clear them."""
        found = self._injected - {Fault.STUCK_TORQUE}
        if self._temperature >= self.plan.temperature_limit:
            found.add(Fault.OVER_TEMPERATURE)
        if self._voltage < self.plan.brown_out:
            found.add(Fault.BROWN_OUT)
        return frozenset(found)

    def advance(self, time_ns: int) -> Fault | None:
        """Lets time pass; returns the fault that the motor itself has had since the last call, or None: over-temperature or
        brown-out.  The torque is cut at the instant of the fault, even if `advance` is called later."""
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
        """Switches the power stage off: the torque is zero at once, without ramp or lag."""
        self._go(time_ns)
        self._cut()

    def set_speed(self, time_ns: int, omega: float) -> None:
        """Sets the speed at which the robot turns the wheel [rad/s].  If it is never called, the wheel is on a bench."""
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
        Raises ValueError for all others, which are faults of the drive, not of the motor."""
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
        """Removes the cause of a fault.  After `STUCK_TORQUE` the torque follows the commands again."""
        self._go(time_ns)
        self._injected.discard(fault)
        if fault is Fault.STUCK_TORQUE and self._stuck:
            self._stuck = False
            if self._off:
                self._torque = 0.0
            elif not self.plan.lag:
                self._torque = self._setpoint

    def _go(self, time_ns: int) -> None:
        """Moves the motor to an instant, step by step."""
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
        """Integrates to an instant, at most up to the next step."""
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
            self._omega, angle = turned_freely(self.plan, self._omega, area / h, h)
            self._turned += angle

    def _follow(self, h: float, slew: float) -> None:
        """Integrates the shaft torque over `h` [s] while the setpoint changes by `slew` [N m/s]."""
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

    def _step(self) -> None:
        """Updates the slow quantities, at a multiple of STEP_NS."""
        plan = self.plan
        self._next_ns += STEP_NS
        copper = plan.resistance * self._square / (STEP * plan.torque_constant * plan.torque_constant)
        self._voltage = supply_voltage(plan, self._work / STEP + copper)
        self._square = self._work = 0.0
        temperature = winding_temperature(plan, self._temperature, copper, self._thermal_decay)
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
        """Updates the torque limit to the temperature."""
        limit = torque_limit(self.plan, self._temperature)
        if limit != self._limit:
            self._limit = limit
            self._aim()

    def _aim(self) -> None:
        """Starts the ramp to the wanted torque, cut to the limit."""
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
        """Switches the power stage off at the present instant."""
        self._off = True
        self._wanted = self._target = self._setpoint = 0.0
        if not self._stuck:
            self._torque = 0.0

    def _trip(self, fault: Fault) -> None:
        """Cuts the torque because of a fault, which the next `advance` returns."""
        self._tripped = fault
        self._cut()

    def _encoder(self) -> int:
        """Returns the counts of an encoder that works."""
        return floor(self._turned / tau * self.plan.encoder_counts)
