"""Faults of a drive, and which of them a scenario can cause."""

from enum import StrEnum
from typing import Final


class Fault(StrEnum):
    """Faults of a drive.  Except for `STUCK_TORQUE` and `SILENT`, a fault cuts the torque and latches: the drive stays in the
    fault state until the fault is cleared."""

    OVER_TEMPERATURE = "over_temperature"
    ENCODER_LOSS = "encoder_loss"
    BROWN_OUT = "brown_out"
    STUCK_TORQUE = "stuck_torque"
    """The shaft torque does not change while the fault lasts, whatever is commanded."""
    SILENT = "silent"
    """The drive receives and sends nothing while the fault lasts; its torque is zero."""
    WATCHDOG = "watchdog"
    """No valid torque command came in time."""
    ESTOP = "estop"
    """An emergency stop came over the bus."""


LATCHING: Final = (Fault.OVER_TEMPERATURE, Fault.ENCODER_LOSS, Fault.BROWN_OUT)
"""The faults of a scenario that the drive latches"""
ON_DEMAND: Final = (*LATCHING, Fault.STUCK_TORQUE, Fault.SILENT)
"""The faults that a scenario can cause; the others come from frames on the bus, or from their absence"""
