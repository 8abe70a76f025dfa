"""A finished run for people who compute: its summary, and its states and errors as numpy arrays with named fields."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from echelon.messages import STATE_FIELDS
from echelon.plan import Plan
from echelon.sim.results.blocks import Blocks, BlockSeries, block_series, component_names
from echelon.sim.results.records import LinkResult, Summary
from echelon.sim.results.trace import Trace

if TYPE_CHECKING:
    from pandas import DataFrame

    from echelon.sim.figures import Picture

UNITS: Final[Mapping[str, str]] = {
    "t": "s",
    "x": "m", "y": "m", "vx": "m/s", "vy": "m/s",
    "theta": "rad", "v": "m/s", "omega": "rad/s",
    "ax": "m/s²", "ay": "m/s²",
    "tau_right": "N m", "tau_left": "N m",
    "tau_right_square": "N² m²", "tau_left_square": "N² m²",
    "tau_right_peak": "N m", "tau_left_peak": "N m",
    "saturated": "torque periods",
    "value": "m", "desired": "m", "error": "m", "norm": "m",
    "rate": "m/s", "error_rate": "m/s",
}  # fmt: skip
"""Units of all fields of `Run.robots` and `Run.blocks`"""
Table = NDArray[np.void]


@dataclass(frozen=True, slots=True)
class Frames:
    """A run as pandas data frames: robots by (t, robot), blocks by (t, block, component), links by their ends."""

    robots: "DataFrame"
    blocks: "DataFrame"
    links: "DataFrame"


class Run:
    """A finished run.  The summary's keys are attributes (`run.verdict`, `run.claims`, `run.distance`, `run.trace_digest` …).

        run.robots["g1/r1"]["x"]         position of a robot at every instant of its own [m]
        run.blocks["inter"]["norm"]      |e| of a block at the instants that all robots share [m]
        run.figure("errors")             a figure of the report

    `robots` and `blocks` hold structured numpy arrays: one record per instant, fields as in `run.units`.
    """

    units = UNITS

    def __init__(self, trace: Trace, summary: Summary, folder: Path | None = None) -> None:
        self.trace, self.summary, self.folder = trace, summary, folder
        self.report_failure = ""
        """Why there is no report, if one was to be written and could not be"""

    @property
    def plan(self) -> Plan:
        """What was run, every default filled in."""
        return self.trace.plan

    @property
    def holds(self) -> bool:
        """True if the run claimed something, and all claims and checks passed."""
        return self.summary.verdict.word == "HOLDS"

    @property
    def failure(self) -> str | None:
        """Why the run broke off, None if it did not."""
        return self.summary.run.failure

    @cached_property
    def robots(self) -> "Named":
        """By robot, its states: `t` and the fields of a state message (echelon.messages.STATE_FIELDS)."""
        names = {robot.name: robot.index for robot in self.plan.robots}
        return Named("robot", names, lambda number: _states(self.trace, number))

    @cached_property
    def blocks(self) -> "Named":
        """By block, its variables: `t`, `value`, `desired`, `error`, `rate`, `error_rate` (a number for each component)
        and `norm`, which is |error|."""
        series = self._blocks.series
        names = {one.block.name: number for number, one in enumerate(series)}
        return Named("block", names, lambda number: _variables(self._blocks, series[number]))

    @cached_property
    def _blocks(self) -> Blocks:
        return block_series(self.trace)

    @property
    def links(self) -> tuple[LinkResult, ...]:
        """What became of the messages of every link."""
        return self.summary.links

    def figure(self, name: str) -> "Picture":
        """Returns a figure of the report: `trajectories`, `blocks`, `errors`, `distance` or `torques`.  Jupyter shows it;
        `save(path)` writes it as SVG.  Raises KeyError for another name."""
        from echelon.sim.figures import picture

        return picture(name, self.trace, self._blocks)

    def to_pandas(self) -> Frames:
        """Returns the run as data frames.  Raises ImportError without pandas, which this package does not install."""
        from pandas import DataFrame, concat

        robots = concat(
            [DataFrame(table).assign(robot=name) for name, table in self.robots.items()], ignore_index=True
        ).set_index(["t", "robot"])
        blocks = []
        for series in self._blocks.series:
            for number, component in enumerate(component_names(series.block)):
                columns = {part: getattr(series, part)[:, number] for part in _PARTS}
                names = {"block": series.block.name, "component": component}
                blocks.append(DataFrame({"t": self._blocks.seconds, **columns}).assign(**names))
        links = DataFrame([{field: getattr(link, field) for field in LinkResult.__slots__} for link in self.links])
        return Frames(
            robots=robots.sort_index(level="t", sort_remaining=False, kind="stable"),
            blocks=concat(blocks, ignore_index=True).set_index(["t", "block", "component"]),
            links=links.set_index(["source", "receiver", "channel"]) if len(links) else links,
        )

    def __getattr__(self, name: str) -> Any:
        if name in Summary.__slots__:
            return getattr(self.summary, name)
        raise AttributeError(f"a run has no {name!r}; its summary has {', '.join(Summary.__slots__)}")

    def __dir__(self) -> list[str]:
        return [*super().__dir__(), *Summary.__slots__]

    def __repr__(self) -> str:
        simulated = f"{self.summary.simulated:g} s" if self.summary.simulated else "nothing simulated"
        where = f", {self.folder}" if self.folder is not None else ""
        return f"<Run of {self.summary.scenario}: {self.summary.verdict.word}, {simulated}{where}>"


_PARTS: Final = ("value", "desired", "error", "rate", "error_rate")


class Named(Mapping[str, Table]):
    """Tables by name; each is made when it is first asked for."""

    def __init__(self, kind: str, numbers: Mapping[str, int], make: Any) -> None:
        self._kind, self._numbers, self._make = kind, numbers, make
        self._made: dict[str, Table] = {}

    def __getitem__(self, name: str) -> Table:
        if name not in self._numbers:
            raise KeyError(f"no {self._kind} {name!r}; there are {', '.join(self._numbers)}")
        if name not in self._made:
            self._made[name] = self._make(self._numbers[name])
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._numbers)

    def __len__(self) -> int:
        return len(self._numbers)

    def __repr__(self) -> str:
        return f"<tables of {', '.join(self._numbers)}>"


def _states(trace: Trace, robot: int) -> Table:
    table = np.empty(len(trace.times_ns[robot]), dtype=[("t", "f8"), *((name, "f8") for name in STATE_FIELDS)])
    table["t"] = trace.times_ns[robot] / 1e9
    for number, name in enumerate(STATE_FIELDS):
        table[name] = trace.states[robot][:, number]
    table.flags.writeable = False
    return table


def _variables(blocks: Blocks, series: BlockSeries) -> Table:
    parts = [(part, "f8", (series.block.size,)) for part in _PARTS]
    table = np.empty(len(blocks.times_ns), dtype=[("t", "f8"), *parts, ("norm", "f8")])
    table["t"], table["norm"] = blocks.seconds, series.norm
    for part in _PARTS:
        table[part] = getattr(series, part)
    table.flags.writeable = False
    return table
