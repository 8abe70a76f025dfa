"""Cyclic protocols, the simplest kind: one drive for both wheels, one command and one feedback per cycle.

A command contains the wanted torques, which wheels are enabled, and whether to clear faults or to make an emergency stop.
Feedback contains the torques, states and faults of the wheels.  Drive, host and observer here do all that does not depend on
the bytes.  A protocol of this kind derives its classes from them and adds the bytes.
"""

from echelon.bridge.protocols.cyclic.drive import CyclicDrive
from echelon.bridge.protocols.cyclic.frames import Command, Feedback, WheelState
from echelon.bridge.protocols.cyclic.host import CyclicHost
from echelon.bridge.protocols.cyclic.observe import CyclicObserver

__all__ = ["Command", "CyclicDrive", "CyclicHost", "CyclicObserver", "Feedback", "WheelState"]
