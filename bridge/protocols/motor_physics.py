"""The equations behind a motor's slow quantities (`protocols.motor`), and of a wheel that turns freely.  Pure functions."""

from math import exp, expm1, sqrt
from typing import Final

from echelon.plan.can_plan import MotorPlan

STEP_NS: Final = 10_000_000
STEP: Final = STEP_NS * 1e-9
"""Temperature, supply voltage and velocity are updated at multiples of this [s]."""


def supply_voltage(plan: MotorPlan, power: float) -> float:
    """Returns the voltage V at a drive [V] that draws `power` P [W]: the larger root of V = supply_voltage - supply_resistance
    P/V.

    The smaller root is unstable.  If there is no root, the supply cannot deliver P, and V is half the supply voltage, at which
    it delivers most."""
    if not plan.supply_resistance:
        return plan.supply_voltage
    root = plan.supply_voltage**2 / 4 - plan.supply_resistance * power
    return plan.supply_voltage / 2 + (sqrt(root) if root > 0 else 0.0)


def winding_temperature(plan: MotorPlan, temperature: float, copper: float, decay: float) -> float:
    """Returns the winding temperature T [°C] at the end of a step that began at `temperature`.

    It solves thermal_time T' = ambient + thermal_resistance · copper - T exactly; `copper` is the mean power loss in the
    winding in the step [W], and `decay` is e^(-step/thermal_time)."""
    warm = plan.ambient + plan.thermal_resistance * copper
    return warm + (temperature - warm) * decay


def torque_limit(plan: MotorPlan, temperature: float) -> float:
    """Returns the largest torque [N m] at a winding temperature [°C]: it falls linearly from `torque_limit` at `derating_from`
    to zero at `temperature_limit`."""
    limit = plan.torque_limit
    if temperature > plan.derating_from:
        span = plan.temperature_limit - plan.derating_from
        limit *= max(plan.temperature_limit - temperature, 0.0) / span if span else 0.0
    return limit


def turned_freely(plan: MotorPlan, omega: float, torque: float, h: float) -> tuple[float, float]:
    """Returns speed [rad/s] and angle [rad] of a wheel that no robot turns, `h` [s] after it had the speed `omega`.

    It solves inertia ω' = torque - friction ω exactly for a constant torque [N m]."""
    x = plan.friction * h / plan.inertia
    part = -expm1(-x) / x if x else 1.0
    rest = (1 - part) / x if x > 1e-5 else 0.5 - x / 6  # a series, since 1 - part cancels for small x
    gain = torque * h / plan.inertia
    return omega * exp(-x) + gain * part, (omega * part + gain * rest) * h


def check(plan: MotorPlan) -> None:
    """Raises ValueError for an impossible value in a plan."""
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
