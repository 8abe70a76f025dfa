"""The tables of a run, which notebooks, CSV and Parquet share: names, columns, units and the order of rows.

table      a row for each
robots     state of a robot, with its desired position, ordered by time, then robot
blocks     instant at which all robots have a state, block, and component of the block
links      link, with the counts of its messages
torques    torque period, robot and wheel on a closed torque path (results.torques)
frames     frame on a bus, decoded (results.frames)
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
from echelon.sim.results.measure_records import LinkResult
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
    "latency": "s", "latency_mean": "s", "latency_p50": "s", "latency_p95": "s", "latency_p99": "s", "latency_max": "s",
    "jitter": "s",
    "wanted": "N m", "commanded": "N m", "reported": "N m",
})  # fmt: skip
"""The units of all columns of numbers in all tables"""
DESIRED: Final = ("x_desired", "y_desired")
LINK_KEYS: Final = ("source", "receiver", "channel")
AGE_KEYS: Final = ("age_mean", "age_p50", "age_p95", "age_p99", "age_max")
PARTS: Final = ("value", "desired", "error", "rate", "error_rate")
"""The columns of a block's component, fields of `BlockSeries`"""


@dataclass(frozen=True, slots=True)
class Table:
    """A table: columns of the same length by name, numbers or text.  No two rows have the same values in all columns of `keys`,
    except in the table `frames`, where two frames may have the same time and identifier."""

    name: str
    keys: tuple[str, ...]
    columns: Mapping[str, NDArray[Any]]

    @property
    def units(self) -> dict[str, str]:
        """The units of the columns of numbers, by column."""
        return {column: UNITS[column] for column in self.columns if column in UNITS}

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def to_pandas(self) -> "DataFrame":
        """Returns the table as a data frame with `keys` as index.  Raises ImportError if pandas is not installed; this package
        does not install it."""
        from pandas import DataFrame

        return DataFrame(dict(self.columns)).set_index(list(self.keys))


def robots_table(trace: Trace) -> Table:
    """Returns all states of all robots with their desired positions, ordered by time, then robot."""
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
    """Returns for each robot its desired positions [m], (T_i, 2), at its T_i instants: its part of Φ_M⁻¹ Z_d(t), where Z_d has
    the desired shapes and the desired trajectory of the centroid (docs/architecture.md, 2.3)."""
    transformation = Transformation(trace.plan)
    trajectory = make_trajectory(trace.plan.trajectory)
    shape, centroid = transformation.inverse[:, :-1] @ transformation.desired_shape, transformation.inverse[:, -1]
    sampled: dict[bytes, Array] = {}  # most robots have the same instants
    places = []
    for robot, times_ns in enumerate(trace.times_ns):
        key = times_ns.tobytes()
        if key not in sampled:
            sampled[key] = sample(trajectory, times_ns / 1e9)[:, 0]
        places.append(shape[robot] + centroid[robot] * sampled[key])
    return places


def blocks_table(blocks: Blocks) -> Table:
    """Returns all components of all blocks, ordered by time, block and component."""
    names = [(series.block.name, component) for series in blocks.series for component in component_names(series.block)]
    instants = len(blocks.times_ns)
    block, component = (np.tile(np.array(column, dtype=object), instants) for column in zip(*names, strict=True))
    columns = {"t": np.repeat(blocks.seconds, len(names)), "block": block, "component": component}
    for part in PARTS:
        columns[part] = np.concatenate([getattr(series, part) for series in blocks.series], axis=1).reshape(-1)
    return Table("blocks", ("t", "block", "component"), columns)


def links_table(links: Sequence[LinkResult]) -> Table:
    """Returns a row for each link: the fields of `LinkResult`."""
    kinds = dict.fromkeys(LINK_KEYS, object) | dict.fromkeys(AGE_KEYS, float)
    columns = {
        field.name: np.array([getattr(link, field.name) for link in links], dtype=kinds.get(field.name, int))
        for field in fields(LinkResult)
    }
    return Table("links", LINK_KEYS, columns)
