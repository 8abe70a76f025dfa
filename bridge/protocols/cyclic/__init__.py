"""Drive, host and observer of the simplest kind of protocol: one drive for both wheels, one command and one feedback per cycle.

A command says the wanted torques, which wheels are enabled, and whether to clear faults or to stop in an emergency; feedback
says the torques that the wheels had, and how they are.  What drives and hosts do with that is the same whatever the bytes are.
A protocol of this kind derives its classes from those here and adds the bytes.
"""

from echelon.bridge.protocols.cyclic.drive import CyclicDrive
from echelon.bridge.protocols.cyclic.frames import Command, Feedback, WheelState
from echelon.bridge.protocols.cyclic.host import CyclicHost
from echelon.bridge.protocols.cyclic.observe import CyclicObserver

__all__ = ["Command", "CyclicDrive", "CyclicHost", "CyclicObserver", "Feedback", "WheelState"]
