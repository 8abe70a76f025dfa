"""The tables of a run, one definition for notebook, CSV and Parquet: their names, columns, units and the order of rows.

robots     every state of every robot, and where the desired formation has it, by time, then robot
blocks     every component of every block at the instants that all robots share
links      what became of the messages of each link
torques    a closed torque path: what each wheel was asked for and did, by torque period (results.torques)
frames     what was on the buses, decoded (results.frames)
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from echelon.controller.trajectory import make_trajectory, sample
from echelon.controller.transformation import Transformation
from echelon.messages import STATE_FIELDS
from echelon.sim.results.block_series import Blocks, component_names
from echelon.sim.results.records import LinkResult
from echelon.sim.results.trace import Array, Trace

if TYPE_CHECKING:
    from pandas import DataFrame

UNITS: Final[Mapping[str, str]] = MappingProxyType({
    "t": "s",
    "x": "m", "y": "m", "vx": "m/s", "vy": "m/s",
    "theta": "rad", "v": "m/s", "omega": "rad/s",
    "ax": "m/s²", "ay": "m/s²",
    "tau_right": "N m", "tau_left": "N m",
    "tau_right_square": "N² m²", "tau_left_square": "N² m²",
    "tau_right_peak": "N m", "tau_left_peak": "N m",
    "saturated": "torque periods",
    "x_desired": "m", "y_desired": "m",
    "value": "m", "desired": "m", "error": "m", "norm": "m",
    "rate": "m/s", "error_rate": "m/s",
    "sent": "messages", "delivered": "messages", "lost": "messages", "in_flight": "messages",
    "duplicates": "messages", "used": "uses", "held": "uses",
    "age_mean": "s", "age_p50": "s", "age_p95": "s", "age_p99": "s", "age_max": "s",
    "wanted": "N m", "commanded": "N m", "reported": "N m",
})  # fmt: skip
"""Units of all columns that are numbers, of all tables"""
DESIRED: Final = ("x_desired", "y_desired")
LINK_KEYS: Final = ("source", "receiver", "channel")
AGE_KEYS: Final = ("age_mean", "age_p50", "age_p95", "age_p99", "age_max")
PARTS: Final = ("value", "desired", "error", "rate", "error_rate")
"""What a block says of each of its components"""


@dataclass(frozen=True, slots=True)
class Table:
    """A table: columns of the same length by name, numbers or text; `keys` are those that tell its rows apart."""

    name: str
    keys: tuple[str, ...]
    columns: Mapping[str, NDArray[Any]]

    @property
    def units(self) -> dict[str, str]:
        """The units of its columns that are numbers."""
        return {column: UNITS[column] for column in self.columns if column in UNITS}

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def to_pandas(self) -> "DataFrame":
        """Returns it as a data frame whose index is its keys.  Raises ImportError without pandas, which this package does not
        install."""
        from pandas import DataFrame

        return DataFrame(dict(self.columns)).set_index(list(self.keys))


def robots_table(trace: Trace) -> Table:
    """Returns all states of all robots by time, then robot."""
    times_ns = np.concatenate(trace.times_ns)
    robots = np.repeat(np.arange(len(trace.times_ns)), [len(times) for times in trace.times_ns])
    order = np.lexsort((robots, times_ns))
    states = np.concatenate(trace.states)[order]
    places = np.concatenate(desired_places(trace))[order]
    names = np.array([robot.name for robot in trace.plan.robots], dtype=object)
    columns = {"t": times_ns[order] / 1e9, "robot": names[robots[order]]}
    columns |= {field: states[:, number] for number, field in enumerate(STATE_FIELDS)}
    columns |= {field: places[:, axis] for axis, field in enumerate(DESIRED)}
    return Table("robots", ("t", "robot"), columns)


def desired_places(trace: Trace) -> list[Array]:
    """Returns of each robot where the desired formation has it at each of its instants [m], (T_i, 2): its part of
    Φ_M⁻¹ Z_d(t), with the desired shapes and the centroid's trajectory."""
    transformation = Transformation(trace.plan)
    trajectory = make_trajectory(trace.plan.trajectory)
    shape, centroid = transformation.inverse[:, :-1] @ transformation.desired_shape, transformation.inverse[:, -1]
    sampled: dict[bytes, Array] = {}  # robots mostly have the same instants
    places = []
    for robot, times_ns in enumerate(trace.times_ns):
        key = times_ns.tobytes()
        if key not in sampled:
            sampled[key] = sample(trajectory, times_ns / 1e9)[:, 0]
        places.append(shape[robot] + centroid[robot] * sampled[key])
    return places


def blocks_table(blocks: Blocks) -> Table:
    """Returns all components of all blocks by time, block and component."""
    names = [(series.block.name, component) for series in blocks.series for component in component_names(series.block)]
    instants = len(blocks.times_ns)
    block, component = (np.tile(np.array(column, dtype=object), instants) for column in zip(*names, strict=True))
    columns = {"t": np.repeat(blocks.seconds, len(names)), "block": block, "component": component}
    for part in PARTS:
        columns[part] = np.concatenate([getattr(series, part) for series in blocks.series], axis=1).reshape(-1)
    return Table("blocks", ("t", "block", "component"), columns)


def links_table(links: Sequence[LinkResult]) -> Table:
    """Returns one row for each link."""
    kinds = dict.fromkeys(LINK_KEYS, object) | dict.fromkeys(AGE_KEYS, float)
    columns = {
        field.name: np.array([getattr(link, field.name) for link in links], dtype=kinds.get(field.name, int))
        for field in fields(LinkResult)
    }
    return Table("links", LINK_KEYS, columns)
