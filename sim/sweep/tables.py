"""The tables of a sweep: runs and points, their files, and how they are read back."""

import csv
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from echelon.errors import UserError
from echelon.files import replacing
from echelon.scenario.toml_text import toml_value
from echelon.sim.results.statistics import MomentGrowth, median, moment_growth, wilson
from echelon.sim.sweep.columns import NOT_MEDIAN, Column, measures, point_columns, run_columns
from echelon.sim.sweep.rows import Rows

if TYPE_CHECKING:
    from pandas import DataFrame


@dataclass(frozen=True, slots=True)
class SweepTable:
    """A table of a sweep: columns of the same length by name.  Numbers that are missing are NaN; text is of type object."""

    name: str
    """`runs` or `points`"""
    described: tuple[Column, ...]
    columns: Mapping[str, NDArray[Any]]

    @property
    def units(self) -> dict[str, str]:
        """The units of the columns that have one, by column."""
        return {each.name: each.unit for each in self.described if each.unit}

    def __len__(self) -> int:
        return len(next(iter(self.columns.values())))

    def __getitem__(self, name: str) -> NDArray[Any]:
        return self.columns[name]

    def to_pandas(self) -> "DataFrame":
        """Returns the table as a data frame.  Raises ImportError without pandas, which this package does not install."""
        from pandas import DataFrame

        return DataFrame(dict(self.columns))


@dataclass(frozen=True, slots=True)
class PointFacts:
    """A point: the values of the varied keys, and what its runs have in common."""

    number: int
    values: tuple[Any, ...]
    scenario: str
    """Hash of its scenario"""
    rows: Rows
    """Its finished runs, by seed in ascending order"""
    seeds: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Layout:
    """What decides the columns of a sweep."""

    keys: tuple[str, ...]
    blocks: tuple[str, ...]
    channels: tuple[str, ...]
    version: str
    engine: str


def runs_table(layout: Layout, points: Sequence[PointFacts]) -> SweepTable:
    """Returns the table of runs, sorted by point and seed."""
    described = run_columns(layout.keys, layout.blocks, layout.channels)
    counts = [len(point.seeds) for point in points]
    columns: dict[str, NDArray[Any]] = {
        "point": np.repeat(np.array([point.number for point in points], dtype=np.int64), counts),
        "seed": np.array([seed for point in points for seed in point.seeds], dtype=np.int64),
    }
    for number, key in enumerate(layout.keys):
        columns[key] = np.repeat(_values([point.values[number] for point in points]), counts)
    columns["scenario"] = np.repeat(_texts([point.scenario for point in points]), counts)
    columns["version"] = _texts([layout.version] * sum(counts))
    columns["engine"] = _texts([layout.engine] * sum(counts))
    for column in measures(layout.blocks, layout.channels):
        missing: list[Any] = ["" if column.text else nan]
        values = [value for point in points for value in point.rows.get(column.name, missing * len(point.seeds))]
        columns[column.name] = _typed(column, values)
    return SweepTable("runs", tuple(described), columns)


def points_table(layout: Layout, points: Sequence[PointFacts]) -> SweepTable:
    """Returns the table of points."""
    described = point_columns(layout.keys, layout.blocks, layout.channels)
    rows = [_point_row(layout, point) for point in points]
    columns = {}
    for column in described:
        values = [row[column.name] for row in rows]
        columns[column.name] = _values(values) if column.name in layout.keys else _typed(column, values)
    return SweepTable("points", tuple(described), columns)


def _point_row(layout: Layout, point: PointFacts) -> dict[str, Any]:
    rows, runs = point.rows, len(point.seeds)
    holds, lost = sum(rows["holds"]), runs - sum(map(isnan, rows["lost_at"]))
    low, high = wilson(holds, runs)
    row: dict[str, Any] = {"point": point.number, **dict(zip(layout.keys, point.values, strict=True))}
    row |= {"scenario": point.scenario, "runs": runs, "holds": holds, "share": holds / runs}
    row |= {"share_low": low, "share_high": high, "lost": lost}
    for column in measures(layout.blocks, layout.channels):
        if column.name not in NOT_MEDIAN:
            row[column.name] = median(np.array(rows.get(column.name, [nan] * runs)))
    for block in layout.blocks:
        for name in ("ise", "itae"):
            row[f"{name}_mean.{block}"] = float(np.mean(rows.get(f"{name}.{block}", [nan])))
        growth = growth_of_point(point, block)
        row[f"moment_growth.{block}"], row[f"heaviest.{block}"] = growth.ratio, growth.heaviest
        row[f"moment_growth_low.{block}"], row[f"moment_growth_high.{block}"] = growth.low, growth.high
    return row


def growth_of_point(point: PointFacts, block: str) -> MomentGrowth:
    """Returns the growth of the second moment of a block over the runs of a point."""
    nothing = [nan] * len(point.seeds)
    before, last = (
        np.array(point.rows.get(f"{name}.{block}", nothing)) for name in ("amplitude_before", "amplitude_last")
    )
    return moment_growth(before, last, len(point.seeds) - sum(map(isnan, point.rows["lost_at"])))


def _typed(column: Column, values: Sequence[Any]) -> NDArray[Any]:
    if column.text:
        return _texts(values)
    return np.array(values, dtype=np.int64 if column.whole else np.float64)


def _values(values: Sequence[Any]) -> NDArray[Any]:
    """Returns the values of a varied key: numbers where all are numbers, otherwise text."""
    if all(isinstance(value, (int, float)) and not isinstance(value, bool) for value in values):
        return np.array(values, dtype=np.float64)
    return _texts([value if isinstance(value, str) else toml_value(value) for value in values])


def _texts(values: Sequence[str]) -> NDArray[Any]:
    texts = np.empty(len(values), dtype=object)
    texts[:] = values
    return texts


def write_csv(table: SweepTable, path: Path) -> None:
    """Writes a table as CSV.  A float reads back as the same float; what is missing is empty.  Raises OSError."""
    columns = [_cells(values) for values in table.columns.values()]
    with replacing(path) as partial, partial.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(table.columns)
        writer.writerows(zip(*columns, strict=True))


def _cells(values: NDArray[Any]) -> list[Any]:
    cells: list[Any] = values.tolist()
    if values.dtype == np.float64 and np.isnan(values).any():
        return ["" if cell != cell else cell for cell in cells]
    return cells


def write_parquet(table: SweepTable, path: Path) -> bool:
    """Writes a table as Parquet, the units in the columns' metadata; returns False if pyarrow is not installed.

    Raises OSError."""
    try:
        import pyarrow
        from pyarrow import parquet
    except ImportError:
        return False
    units, columns, fields = table.units, [], []
    for name, values in table.columns.items():
        text = values.dtype == object
        # Not by `from_pandas`, which imports pandas.
        array = (
            pyarrow.array(values.tolist(), pyarrow.string()) if text else pyarrow.array(values, mask=np.isnan(values))
        )
        columns.append(array)
        metadata = {"unit": units[name]} if name in units else None
        fields.append(pyarrow.field(name, array.type, metadata=metadata))
    with replacing(path) as partial:
        parquet.write_table(pyarrow.table(columns, schema=pyarrow.schema(fields)), partial)
    return True


def read_csv(name: str, described: Callable[..., Sequence[Column]], layout: Layout, path: Path) -> SweepTable:
    """Reads a table that `write_csv` wrote.  Raises UserError if it is not one, or not there."""
    columns = described(layout.keys, layout.blocks, layout.channels)
    try:
        with path.open(encoding="utf-8", newline="") as file:
            header, *rows = csv.reader(file)
    except OSError as error:
        raise UserError(f"{path}: {error.strerror}") from None
    except (ValueError, csv.Error) as error:
        raise UserError(f"{path}: {error}") from None
    wanted = [column.name for column in columns]
    if header != wanted or any(len(row) != len(wanted) for row in rows):
        raise UserError(f"{path}: is not the table that this version writes; `echelon sweep --resume` writes it anew")
    cells = list(zip(*rows, strict=True)) or [()] * len(wanted)
    try:
        read = {
            column.name: _read_values(values) if column.name in layout.keys else _read(column, values)
            for column, values in zip(columns, cells, strict=True)
        }
    except ValueError as error:
        raise UserError(f"{path}: {error}") from None
    return SweepTable(name, tuple(columns), read)


def _read(column: Column, cells: Sequence[str]) -> NDArray[Any]:
    if column.text:
        return _texts(cells)
    if column.whole:
        return np.array([int(cell) for cell in cells], dtype=np.int64)
    return np.array([float(cell) if cell else nan for cell in cells])


def _read_values(cells: Sequence[str]) -> NDArray[Any]:
    try:
        return np.array([float(cell) for cell in cells])
    except ValueError:
        return _texts(cells)


def values_text(values: Sequence[Any]) -> str:
    """Returns a point's values as one text that tells it from all other points."""
    return json.dumps(list(values), ensure_ascii=False)
