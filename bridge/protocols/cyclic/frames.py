"""What the frames of a cyclic protocol say, whatever their bytes; right wheel, then left wheel."""

from enum import IntEnum
from typing import Final, NamedTuple

from echelon.bridge.protocols.motor import Fault

REMOTE: Final = "remote"
"""Why a remote frame is refused: nobody answers it."""


class WheelState(IntEnum):
    """What a wheel's drive does."""

    DISABLED = 0
    ENABLED = 1
    FAULT = 2


class Command(NamedTuple):
    """What a command says."""

    torques: tuple[float, float]
    """Wanted wheel torques [N m], 0 for a wheel that is not enabled"""
    enable: tuple[bool, bool]
    clear: bool
    """Leave faults whose cause is gone; a command that does so does not enable"""
    estop: bool
    """Emergency stop: both wheels fault"""


class Feedback(NamedTuple):
    """What a feedback says."""

    torques: tuple[float, float]
    """Mean shaft torques since the feedback before [N m]"""
    states: tuple[WheelState, WheelState]
    faults: tuple[Fault | None, Fault | None]
    """What is wrong with each wheel; None: nothing, or not told"""


def fault_text(fault: Fault | None) -> str:
    """Returns a fault in words; empty if it is none."""
    return "" if fault is None else fault.replace("_", " ")
