"""Messages between roles: a header, then float64 values in the order of the layouts below.

The header holds the source (the member's index in the plan), the sequence number (how many messages the source sent before
on this channel) and the run time of the content.  A *null message* has no values: its source lacks an input, so it has
nothing to send.  Null messages keep a lockstep going; a receiver acts as if no message had come.
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
    """The kind of a message's content.  Its name in lower case is the last chunk of the message's key."""

    STATE = 1
    """Robot to leader: `STATE_FIELDS`."""
    GROUP_STATE = 2
    """Node to its parent: `GROUP_FIELDS`, then the error rates of every block below (where blocks are coupled), then
    the positions of every robot below (where robots avoid each other).  `echelon.plan.layout` gives their places."""
    REFERENCE = 3
    """Node to its child nodes: an acceleration (x, y) per child, then the error rates of all blocks (where coupled),
    then the avoidance force (x, y) on every robot below (where robots avoid each other)."""
    COMMAND = 4
    """Group leader to its robots: an acceleration (x, y) per child."""
    FRAMES = 5
    """Bridge to drives and drives to bridge, with copies for the recorder: CAN frames with their instants
    (bridge.frame_message)."""
    TORQUE = 6
    """Robot to bridge, on the closed torque path: `TORQUE_FIELDS`.  The virtual drives receive it too, for the speeds of
    their shafts."""
    WHEELS = 7
    """Bridge to robots, on the closed torque path: the torques of the right and the left wheel of every robot [N m], as the
    drives reported them: the mean over the torque period that ends at the message's time."""


STATE_FIELDS: Final = (
    "x", "y", "vx", "vy", "theta", "v", "omega",
    "ax", "ay",
    "tau_right", "tau_left",
    "tau_right_square", "tau_left_square",
    "tau_right_peak", "tau_left_peak",
    "saturated",
)  # fmt: skip
"""Values of a STATE message.

At the message's time: position [m] and velocity [m/s] of the reference point, heading [rad], forward speed [m/s], yaw rate
[rad/s].  Over the period that ends at this time: the commanded acceleration [m/s²]; for the torque of each wheel its mean
[N m], its mean square [N² m²] and its largest magnitude [N m] over the torque periods; the number of torque periods in
which a torque was saturated."""

TORQUE_FIELDS: Final = ("tau_right", "tau_left", "commanded", "saturated", "speed_right", "speed_left")
"""Values of a TORQUE message: the wanted wheel torques [N m]; `commanded`, 1 if the robot has an acceleration to follow, else
0, and then the torques are 0; `saturated`, 1 if the robot's limits cut a torque; the wheel speeds [rad/s]."""

GROUP_FIELDS: Final = ("x", "y", "vx", "vy")
"""A group's centroid [m] and its velocity [m/s]."""


class Message(NamedTuple):
    """One message.  `values` is float64, and read-only if the message was decoded from bytes.

    This is a named tuple because every tick makes many messages: it takes a third of the time of a frozen dataclass.
    """

    channel: Channel
    source: int
    sequence: int
    time_ns: int
    values: Values

    @property
    def is_null(self) -> bool:
        """True if the message has no values: its source had nothing to send."""
        return not self.values.size


Heard = Message | None
"""One input of a stage: the message in use, or None if no message with values is in use."""


def field_index(fields: Sequence[str], *names: str) -> list[int]:
    """Returns the positions of `names` in a layout."""
    return [fields.index(name) for name in names]
