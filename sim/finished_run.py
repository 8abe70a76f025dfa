"""A finished run as a Python object: its summary, and its states and errors as numpy arrays with named fields."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from echelon.bridge.referee.log import read_run_log
from echelon.errors import UserError
from echelon.messages import STATE_FIELDS
from echelon.plan.plan import Plan
from echelon.sim.results.block_series import Blocks, BlockSeries, block_series
from echelon.sim.results.measure_records import LinkResult
from echelon.sim.results.records import Summary
from echelon.sim.results.tables import (
    DESIRED,
    PARTS,
    UNITS,
    Table,
    blocks_table,
    desired_places,
    links_table,
    robots_table,
)
from echelon.sim.results.trace import Array, Trace

if TYPE_CHECKING:
    from pandas import DataFrame

    from echelon.sim.report.drawing import Picture
    from echelon.sim.results.latencies import Latencies

Value = TypeVar("Value")
Records = NDArray[np.void]


@dataclass(frozen=True)
class DataFrames:
    """The tables of a run as pandas data frames; each is made when it is first used.

    An attribute raises KeyError if the run does not have this table (see `Run.tables`)."""

    tables: Mapping[str, Table]

    @cached_property
    def robots(self) -> "DataFrame":
        """All states, by (t, robot)."""
        return self.tables["robots"].to_pandas()

    @cached_property
    def blocks(self) -> "DataFrame":
        """Shape variables, centroid and their errors, by (t, block, component)."""
        return self.tables["blocks"].to_pandas()

    @cached_property
    def links(self) -> "DataFrame":
        """Counts and ages of messages on each link, by (source, receiver, channel)."""
        return self.tables["links"].to_pandas()

    @cached_property
    def torques(self) -> "DataFrame":
        """Wanted, commanded and reported torques, by (t, robot, wheel); only with a closed torque path."""
        return self.tables["torques"].to_pandas()

    @cached_property
    def frames(self) -> "DataFrame":
        """CAN frames, decoded, by (t, bus, identifier)."""
        return self.tables["frames"].to_pandas()


class Run:
    """A finished run.  The summary's keys are attributes (`run.verdict`, `run.claims`, `run.distance`, `run.trace_digest` …).

        run.robots["g1/r1"]["x"]         x of a robot at each instant at which it sent its state [m]
        run.blocks["inter"]["norm"]      norm of a block's error at each instant at which all robots sent their states [m]
        run.figure("errors")             a figure of the report

    `robots` and `blocks` hold structured numpy arrays, one record per instant; `run.units` has the unit of each field.
    `tables` are the tables that `echelon export` writes.
    """

    units = UNITS

    def __init__(self, trace: Trace, summary: Summary, folder: Path | None = None) -> None:
        self.trace, self.summary, self.folder = trace, summary, folder
        self.report_failure = ""
        """Why the report could not be written; "" if it was, or was not asked for"""

    @property
    def plan(self) -> Plan:
        """The plan of the run."""
        return self.trace.plan

    @property
    def holds(self) -> bool:
        """True if the verdict is HOLDS: the scenario has claims, and all claims and checks passed."""
        return self.summary.verdict.word == "HOLDS"

    @property
    def ok(self) -> bool:
        """True unless the verdict is FAILS: no claim and no check failed."""
        return self.summary.verdict.word != "FAILS"

    @property
    def failure(self) -> str | None:
        """Why the run broke off; None if it did not."""
        return self.summary.run.failure

    @cached_property
    def robots(self) -> "Named[Records]":
        """The states of each robot, by its name: `t`, the fields of a state message (echelon.messages.STATE_FIELDS), and
        `x_desired` and `y_desired`, its place in the desired formation."""
        return Named("robot", {robot.name: partial(self._states, robot.index) for robot in self.plan.robots})

    @cached_property
    def blocks(self) -> "Named[Records]":
        """The variables of each block, by its name: `t`; `value`, `desired`, `error`, `rate`, `error_rate`, each with a number
        for every component; and `norm`, the norm of the error."""
        series = self._blocks.series
        return Named("block", {one.block.name: partial(_variables, self._blocks, one) for one in series})

    @cached_property
    def tables(self) -> "Named[Table]":
        """The tables of `echelon export`, by their names: `robots`, `blocks`, `links`; with a can.log in the run's folder also
        `frames`, and, if the torque path is closed, `torques`."""
        makers: dict[str, Callable[[], Table]] = {
            "robots": lambda: robots_table(self.trace),
            "blocks": lambda: blocks_table(self._blocks),
            "links": lambda: links_table(self.links),
        }
        if self.folder is not None and (log := self.folder / "can.log").exists():
            if self.plan.can.closed:
                makers["torques"] = lambda: self._torques(log)
            makers["frames"] = lambda: self._frames(log)
        return Named("table", makers)

    @cached_property
    def _blocks(self) -> Blocks:
        return block_series(self.trace)

    @cached_property
    def _places(self) -> list[Array]:
        return desired_places(self.trace)

    def _states(self, robot: int) -> Records:
        times_ns, states, places = self.trace.times_ns[robot], self.trace.states[robot], self._places[robot]
        table = np.empty(len(times_ns), dtype=[(name, "f8") for name in ("t", *STATE_FIELDS, *DESIRED)])
        table["t"] = times_ns / 1e9
        for fields, values in ((STATE_FIELDS, states), (DESIRED, places)):
            for number, name in enumerate(fields):
                table[name] = values[:, number]
        table.flags.writeable = False
        return table

    def _torques(self, log: Path) -> Table:
        from echelon.sim.recording.mcap_reader import read_torques
        from echelon.sim.results.torques import torques_table

        said = read_torques(log.with_name("run.mcap"), self.plan)
        return torques_table(self.plan, said, read_run_log(log, self.plan))

    def _frames(self, log: Path) -> Table:
        from echelon.sim.results.frames import frames_table

        return frames_table(self.plan, read_run_log(log, self.plan))

    @property
    def links(self) -> tuple[LinkResult, ...]:
        """Counts and ages of messages on each link."""
        return self.summary.links

    def latencies(self) -> "Latencies":
        """Returns how long the messages of each link took in a run on a wall clock: `run.latencies().table.to_pandas()`.

        Raises UserError if the run was in virtual time, or has no folder."""
        from echelon.sim.measured_links import measured

        if self.folder is None:
            raise UserError("this run has no folder, so the arrivals of its messages were not noted")
        return measured(self.folder)

    def figure(self, name: str) -> "Picture":
        """Returns a figure of the report: `trajectories`, `blocks`, `errors`, `distance` or `torques`.  Jupyter shows it; its
        method `save(path)` writes it as SVG, PDF or PNG.  Raises KeyError for any other name."""
        from echelon.sim.report.figures import picture

        return picture(name, self.trace, self._blocks)

    def to_pandas(self) -> DataFrames:
        """Returns the run's tables as data frames.  Raises ImportError without pandas, which this package does not install."""
        try:
            import pandas  # noqa: F401  here, rather than at the first table
        except ImportError:
            raise ImportError("data frames need pandas, which echelon does not install: pip install pandas") from None
        return DataFrames(self.tables)

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


class Named(Mapping[str, Value], Generic[Value]):
    """A mapping from names to values.  Each value is made when it is first asked for."""

    def __init__(self, kind: str, makers: Mapping[str, Callable[[], Value]]) -> None:
        self._kind, self._makers = kind, makers
        self._made: dict[str, Value] = {}

    def __getitem__(self, name: str) -> Value:
        if name not in self._makers:
            raise KeyError(f"no {self._kind} {name!r}; there are {', '.join(self._makers)}")
        if name not in self._made:
            self._made[name] = self._makers[name]()
        return self._made[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._makers)

    def __len__(self) -> int:
        return len(self._makers)

    def __repr__(self) -> str:
        return f"<{self._kind}s {', '.join(self._makers)}>"


def _variables(blocks: Blocks, series: BlockSeries) -> Records:
    """Returns the variables of a block, one record per instant."""
    parts = [(part, "f8", (series.block.size,)) for part in PARTS]
    table = np.empty(len(blocks.times_ns), dtype=[("t", "f8"), *parts, ("norm", "f8")])
    table["t"], table["norm"] = blocks.seconds, series.norm
    for part in PARTS:
        table[part] = getattr(series, part)
    table.flags.writeable = False
    return table
