"""Messages between roles: one header, then float64 values whose order the layouts below name.

A message says who sent it (the member's index in the plan), how many it sent before on this channel, and the run time
of its content.  A *null message* has no values: its source had nothing to say yet (it has not heard from everyone it
needs).  It keeps a lockstep going, and whoever receives it is as if nothing had come.
"""

from collections.abc import Sequence
from enum import IntEnum
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

NULL: Final[Values] = np.empty(0)
NULL.flags.writeable = False


class Channel(IntEnum):
    """What a message carries; the name in lower case is the last chunk of its key."""

    STATE = 1
    """Robot to leader: `STATE_FIELDS`."""
    GROUP_STATE = 2
    """Node to its parent: `GROUP_FIELDS`, then the error rates of every block below (where blocks are coupled), then
    the positions of every robot below (where robots avoid each other); `echelon.plan.layout` says where each stands."""
    REFERENCE = 3
    """Node to its child nodes: an acceleration (x, y) per child, then the error rates of all blocks (where coupled),
    then the avoidance force (x, y) on every robot below (where robots avoid each other)."""
    COMMAND = 4
    """Group leader to its robots: an acceleration (x, y) per child."""
    FRAMES = 5
    """Bridge and drives to each other and to those who watch: CAN frames with their times (bridge.frame_message)."""
    TORQUE = 6
    """Robot to bridge, on the closed torque path: `TORQUE_FIELDS`.  The drives take the speeds of their shafts from it."""
    WHEELS = 7
    """Bridge to robots, on the closed torque path: the torques of every robot's right and left wheel [N m], the mean over
    the torque period that ends at the message's time, as the drives reported them."""


STATE_FIELDS: Final = (
    "x", "y", "vx", "vy", "theta", "v", "omega",
    "ax", "ay",
    "tau_right", "tau_left",
    "tau_right_square", "tau_left_square",
    "tau_right_peak", "tau_left_peak",
    "saturated",
)  # fmt: skip
"""A robot's state at the message's time: position [m], velocity [m/s] of the reference point, heading [rad], forward
speed [m/s], yaw rate [rad/s]; and what it did in the period that ends there: the acceleration it was commanded [m/s²],
and of each wheel's torque the mean [N m], the mean square [N² m²] and the largest magnitude [N m] over the inner torque
periods, and how many of those were saturated."""

TORQUE_FIELDS: Final = ("tau_right", "tau_left", "commanded", "saturated", "speed_right", "speed_left")
"""What a robot wants of its wheels: torques [N m], 0 where `commanded` is 0, for then it has nothing to go by; whether
they were limited; and what its body does with the wheels meanwhile: their speeds [rad/s]."""

GROUP_FIELDS: Final = ("x", "y", "vx", "vy")
"""A group's centroid [m] and its velocity [m/s]."""


class Message(NamedTuple):
    """One message; `values` is float64, read-only when it was decoded.

    A named tuple, for one is made for every message of every tick, in a third of the time of a frozen dataclass.
    """

    channel: Channel
    source: int
    sequence: int
    time_ns: int
    values: Values

    @property
    def is_null(self) -> bool:
        """True if the source had nothing to say yet."""
        return not self.values.size


Heard = Message | None
"""What a role finds in one of its inputs: the message it is to use now, or None if none has come that says anything."""


def field_index(fields: Sequence[str], *names: str) -> list[int]:
    """Returns where `names` stand in a layout."""
    return [fields.index(name) for name in names]
