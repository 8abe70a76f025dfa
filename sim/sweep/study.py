"""A finished sweep as a Python object, and how it is read from its folder."""

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from echelon.errors import UserError
from echelon.files import read_json, write_text
from echelon.sim.sweep.columns import point_columns, run_columns
from echelon.sim.sweep.search import Found
from echelon.sim.sweep.tables import Layout, SweepTable, read_csv

if TYPE_CHECKING:
    from pandas import DataFrame
    from xarray import Dataset

FORMAT: Final = 1
SWEEP: Final = "sweep.json"
FIND: Final = "find.json"
RUNS: Final = "runs"
POINTS: Final = "points"


@dataclass(frozen=True, slots=True, kw_only=True, repr=False)
class Sweep:
    """A sweep: a table of its runs, and one of its points (docs/sweep.md has the columns).

    sweep.runs["ise.inter"]       a column, a numpy array; missing numbers are NaN
    sweep.points["share"]         share of the runs of each point that hold
    sweep.find                    the boundaries of a search
    sweep.to_pandas()             the runs as a data frame
    sweep.to_xarray()             the same with an axis for each varied key, and one for the seeds
    """

    scenario: str
    """Name of the scenario"""
    layout: Layout
    seeds: tuple[int, ...]
    """The seeds at each point"""
    design: str
    """`grid`, `zip`, `random`, `sobol` or `find`"""
    runs: SweepTable
    points: SweepTable
    find: tuple[Found, ...] = ()
    folder: Path | None = None
    """None if nothing was written"""
    command: str = ""
    """The command that started the sweep; empty if it is not known"""

    @property
    def keys(self) -> tuple[str, ...]:
        """The varied keys."""
        return self.layout.keys

    @property
    def engine(self) -> str:
        """The engine that made the runs."""
        return self.layout.engine

    def to_pandas(self) -> "DataFrame":
        """Returns the runs as a data frame.  Raises ImportError without pandas, which this package does not install."""
        try:
            return self.runs.to_pandas()
        except ImportError:
            raise ImportError("data frames need pandas, which echelon does not install: pip install pandas") from None

    def to_xarray(self) -> "Dataset":
        """Returns the runs as a dataset.

        The axes of a grid are its keys and `seed`; those of other designs are `point` and `seed`, with the keys as coordinates
        of `point`.  Raises ImportError without xarray, which this package does not install, and UserError if the sweep is not
        finished."""
        try:
            import xarray
        except ImportError:
            raise ImportError("datasets need xarray, which echelon does not install: pip install xarray") from None
        points, seeds = len(self.points), len(self.seeds)
        if len(self.runs) != points * seeds:
            raise UserError(f"{len(self.runs)} of {points * seeds} runs are finished: no dataset before all are")
        described = {each.name: each for each in self.runs.described}
        values = {key: self.points[key] for key in self.keys}
        axes: dict[str, Any] = {"point": self.points["point"]}
        coordinates: dict[str, Any] = {key: ("point", column) for key, column in values.items()}
        if self.design == "grid" and self.keys:
            axes = {key: list(dict.fromkeys(column.tolist())) for key, column in values.items()}
            coordinates = {}
        shape = (*(len(axis) for axis in axes.values()), seeds)
        dimensions = (*axes, "seed")
        left_out = {"point", "seed", *self.keys}
        measured = {
            name: (dimensions, column.reshape(shape), {"units": described[name].unit} if described[name].unit else {})
            for name, column in self.runs.columns.items()
            if name not in left_out
        }
        return xarray.Dataset(measured, coords={**axes, "seed": np.array(self.seeds), **coordinates})

    def __repr__(self) -> str:
        where = f", {self.folder}" if self.folder is not None else ""
        what = f"{len(self.runs)} runs at {len(self.points)} points"
        return f"<Sweep of {self.scenario}: {what}, engine {self.engine}{where}>"


def open_sweep(folder: str | Path) -> Sweep:
    """Returns the sweep in a folder.  Raises UserError if it is not the folder of a sweep, or a file of it cannot be read."""
    folder = Path(folder)
    spec = read_spec(folder)
    try:
        first, count = spec["seeds"]
        find = spec["find"]
        keys = (*spec["keys"], *(() if find is None else (find["key"],)))
        header = _header(folder / f"{RUNS}.csv")
        blocks = tuple(name.partition(".")[2] for name in header if name.startswith("start_error."))
        channels = tuple(name.partition(".")[2] for name in header if name.startswith("loss."))
        layout = Layout(keys, blocks, channels, spec["version"], spec["engine"])
        return Sweep(
            scenario=spec["scenario"],
            layout=layout,
            seeds=tuple(range(first, first + count)),
            design=spec["design"] if find is None else "find",
            runs=read_csv(RUNS, run_columns, layout, folder / f"{RUNS}.csv"),
            points=read_csv(POINTS, point_columns, layout, folder / f"{POINTS}.csv"),
            find=_read_find(folder / FIND) if (folder / FIND).exists() else (),
            folder=folder,
            command=spec["command"],
        )
    except (KeyError, TypeError, ValueError) as error:
        raise UserError(f"{folder / SWEEP}: is damaged ({type(error).__name__}: {error})") from None


def read_spec(folder: Path) -> Mapping[str, Any]:
    """Returns the design in the folder of a sweep.  Raises UserError if there is none, or none of this format."""
    spec = _read_json(folder / SWEEP)
    if not isinstance(spec, dict) or spec.get("format") != FORMAT:
        raise UserError(f"{folder / SWEEP}: is not a sweep that this version can read")
    return spec


def _header(path: Path) -> list[str]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            return next(csv.reader(file), [])
    except FileNotFoundError:
        hint = f"`echelon sweep --resume {path.parent}` writes it"
        raise UserError(f"{path}: is not there; {hint}") from None
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from None


def _read_json(path: Path) -> Any:
    try:
        return read_json(path.read_bytes())
    except FileNotFoundError:
        raise UserError(f"{path.parent}: is not the folder of a sweep, there is no {path.name}") from None
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from None
    except ValueError as error:
        raise UserError(f"{path}: is not JSON: {error}") from None


def write_find(found: Sequence[Found], path: Path) -> None:
    """Writes boundaries as JSON.  Raises OSError."""
    entries = [asdict(each) | {"at": dict(each.at), "text": each.text} for each in found]
    write_text(path, json.dumps(entries, indent=1, ensure_ascii=False) + "\n")


def _read_find(path: Path) -> tuple[Found, ...]:
    entries = _read_json(path)
    return tuple(
        Found(
            **{name: value for name, value in entry.items() if name != "text"}
            | {name: tuple(entry[name]) for name in ("limited_by", "again")}
        )
        for entry in entries
    )
