"""The motor behind a virtual drive: how the torque on one wheel's shaft follows what the protocol asks for.

Setpoint: limited (torque limit, derated by temperature), then ramped with the slew limit.  Shaft torque follows it as a
first-order lag, τ' = (setpoint - τ)/lag, in closed form between two events; without lag it is the setpoint.
"""

from enum import StrEnum

from echelon.plan import MotorPlan


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


class Motor:
    """One wheel's motor; instants in ns, SI units."""

    def __init__(self, plan: MotorPlan) -> None:
        self.plan = plan

    def advance(self, time_ns: int) -> Fault | None:
        """Lets time pass; returns a fault that its physics caused by then (over-temperature, brown-out)."""
        raise NotImplementedError

    def set_torque(self, time_ns: int, torque: float) -> None:
        """Sets the wanted shaft torque [N m]."""
        raise NotImplementedError

    def cut(self, time_ns: int) -> None:
        """Takes all torque away at once, without ramp or lag: the power stage is off."""
        raise NotImplementedError

    def mean_torque(self, time_ns: int) -> float:
        """Returns the mean of the shaft torque since the last call [N m], and begins a new mean."""
        raise NotImplementedError
