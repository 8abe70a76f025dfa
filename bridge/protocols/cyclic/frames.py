"""The content of the frames of a cyclic protocol, without their bytes.  Pairs are the right and the left wheel."""

from enum import IntEnum
from typing import Final, NamedTuple

from echelon.bridge.protocols.faults import Fault

REMOTE: Final = "remote"
"""The reason to refuse a remote frame: cyclic protocols do not answer them."""


class WheelState(IntEnum):
    """State of a wheel (bridge.protocols.cyclic.drive)."""

    DISABLED = 0
    ENABLED = 1
    FAULT = 2


class Command(NamedTuple):
    """The content of a command."""

    torques: tuple[float, float]
    """Wanted wheel torques [N m]; 0 for a wheel that is not enabled"""
    enable: tuple[bool, bool]
    clear: bool
    """Clear faults whose cause is gone; a wheel in a fault is not enabled by the same command"""
    estop: bool
    """Emergency stop: both wheels enter the fault state"""


class Feedback(NamedTuple):
    """The content of a feedback."""

    torques: tuple[float, float]
    """Mean shaft torques since the last feedback [N m]"""
    states: tuple[WheelState, WheelState]
    faults: tuple[Fault | None, Fault | None]
    """Fault of each wheel; None: no fault, or not reported"""


def fault_text(fault: Fault | None) -> str:
    """Returns a fault in words; "" for None."""
    return "" if fault is None else fault.replace("_", " ")
