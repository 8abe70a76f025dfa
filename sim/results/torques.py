"""Torques on a closed torque path: wanted by the robot, commanded on the bus, reported by the drive."""

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

Said = tuple[NDArray[np.int64], Array]
"""The instants [ns] at which a robot said its torques, (T,), and what it said, (T, len(TORQUE_FIELDS))"""


def torques_table(plan: Plan, said: Sequence[Said], frames: Iterable[BusFrame]) -> Table:
    """Returns a row for each torque period, robot and wheel, in this order; `t` is the period's beginning.

    `wanted` is what the robot asks for at `t`; NaN if it has nothing to go by.  `commanded` is what the bus carried in the
    period: what the drive hears.  `reported` is what the drive said in the period: its mean of the period before.  Of several
    in a period the last counts; NaN if there was none.  `said` is by robot, `frames` are in order of time."""
    assert plan.bridge is not None
    period_ns = plan.bridge.period_ns
    rows = [times_ns // period_ns for times_ns, _ in said]
    periods = min(max((int(row.max()) + 1 for row in rows if len(row)), default=0), plan.duration_ns // period_ns + 1)
    torques = np.full((len(WAYS), periods, len(plan.robots), len(WHEELS)), np.nan)
    for robot, (row, (_, values)) in enumerate(zip(rows, said, strict=True)):
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
    """Notes commands and reports on the buses, each in the period it came in."""
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
