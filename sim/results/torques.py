"""The table of torques on a closed torque path: wanted by the robot, commanded on the bus, reported by the drive."""

from collections.abc import Iterable, Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.bridge.protocols.frame import WHEELS
from echelon.bridge.protocols.registry import make_observer
from echelon.messages import TORQUE_FIELDS, field_index
from echelon.plan.plan import Plan
from echelon.sim.results.frames import BusFrame
from echelon.sim.results.tables import Table
from echelon.sim.results.trace import Array

TAUS: Final = field_index(TORQUE_FIELDS, "tau_right", "tau_left")
COMMAND: Final = TORQUE_FIELDS.index("commanded")
WAYS: Final = ("wanted", "commanded", "reported")

Wanted = tuple[NDArray[np.int64], Array]
"""The instants of a robot's torque messages [ns], (T,), and their values, (T, len(TORQUE_FIELDS))"""


def torques_table(plan: Plan, wanted: Sequence[Wanted], frames: Iterable[BusFrame]) -> Table:
    """Returns a row for each torque period, robot and wheel, in this order; `t` is the beginning of the period [s].

    column       torque [N m]; NaN if there is none in the period, the last one if there are several
    wanted       computed by the robot at `t`; NaN as well if the robot has no command to compute it from
    commanded    in the frame on the bus that commands the drive
    reported     in the frame on the bus from the drive: with most protocols its mean over the period before

    `wanted` has the messages of each robot, in the order of the plan; `frames` must be in order of time."""
    assert plan.bridge is not None
    period_ns = plan.bridge.period_ns
    rows = [times_ns // period_ns for times_ns, _ in wanted]
    periods = min(max((int(row.max()) + 1 for row in rows if len(row)), default=0), plan.duration_ns // period_ns + 1)
    torques = np.full((len(WAYS), periods, len(plan.robots), len(WHEELS)), np.nan)
    for robot, (row, (_, values)) in enumerate(zip(rows, wanted, strict=True)):
        asked, inside = np.where(values[:, [COMMAND]] == 1.0, values[:, TAUS], np.nan), (row >= 0) & (row < periods)
        torques[0, row[inside], robot] = asked[inside]
    _listen(plan, frames, period_ns, torques)
    names = np.array([robot.name for robot in plan.robots], dtype=object)
    columns = {
        "t": np.repeat(np.arange(periods) * period_ns / 1e9, len(names) * len(WHEELS)),
        "robot": np.tile(np.repeat(names, len(WHEELS)), periods),
        "wheel": np.tile(np.array(WHEELS, dtype=object), periods * len(names)),
    }
    return Table(
        "torques", ("t", "robot", "wheel"), columns | dict(zip(WAYS, torques.reshape(len(WAYS), -1), strict=True))
    )


def _listen(plan: Plan, frames: Iterable[BusFrame], period_ns: int, torques: Array) -> None:
    """Fills in the commanded and reported torques, each in the period in which its frame was on the bus."""
    _, commanded, reported = torques
    listeners: dict[tuple[int, int], list[int]] = {}
    observers = [make_observer(robot, plan.can.closed) for robot in plan.robots]
    for robot, observer in zip(plan.robots, observers, strict=True):
        for can_id in observer.identifiers:
            listeners.setdefault((robot.drive.bus, can_id), []).append(robot.index)
    for time_ns, bus, frame in frames:
        row = time_ns // period_ns
        for index in listeners.get((bus, frame.can_id), ()):
            observers[index].observe(time_ns, frame)
            if not 0 <= row < len(commanded):
                continue
            for wheel, reading in enumerate(observers[index].wheels):
                if reading.commanded_ns == time_ns and reading.commanded is not None:
                    commanded[row, index, wheel] = reading.commanded
                if reading.reported_ns == time_ns and reading.reported is not None:
                    reported[row, index, wheel] = reading.reported
