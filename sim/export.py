"""Writes the tables of a run (`Run.tables`) into files: CSV, or Parquet where pyarrow is installed."""

import csv
import os
from pathlib import Path

from echelon.errors import UsageError
from echelon.files import replacing
from echelon.sim.finished_run import Run
from echelon.sim.results.tables import Table


def in_the_way(run: Run, folder: Path, kind: str) -> list[str]:
    """Returns the names in a folder that an export of a run as `kind` (csv or parquet) would overwrite."""
    names = (f"{name}.{kind}" for name in run.tables)
    return [name for name in names if os.path.lexists(folder / name)]


def export_csv(run: Run, folder: Path) -> list[Path]:
    """Writes each table of a run as a CSV file; returns the files.

    The folder is made if it does not exist; files of the same names are overwritten (`in_the_way`).  Numbers have all their
    digits: a float reads back as the same float.  There is one header line; times are in seconds.  Raises OSError."""
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, table in run.tables.items():
        files.append(folder / f"{name}.csv")
        with replacing(files[-1]) as partial, partial.open("w", encoding="utf-8", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(table.columns)
            writer.writerows(zip(*(column.tolist() for column in table.columns.values()), strict=True))
    return files


def export_parquet(run: Run, folder: Path) -> list[Path]:
    """Writes each table of a run as a Parquet file; returns the files.

    The folder is made if it does not exist; files of the same names are overwritten (`in_the_way`).  The unit of a column is in
    its metadata.  Raises UsageError without pyarrow, which this package does not install, and OSError."""
    try:
        from pyarrow import parquet
    except ImportError:
        raise UsageError("--parquet needs pyarrow, which is not installed: pip install pyarrow") from None
    folder.mkdir(parents=True, exist_ok=True)
    files = []
    for name, table in run.tables.items():
        files.append(folder / f"{name}.parquet")
        with replacing(files[-1]) as partial:
            parquet.write_table(_arrow(table), partial)
    return files


def _arrow(table: Table) -> object:
    import pyarrow

    units, columns, described = table.units, [], []
    for name, values in table.columns.items():
        text = values.dtype == object
        columns.append(pyarrow.array(values, pyarrow.string() if text else None))
        described.append(
            pyarrow.field(name, columns[-1].type, metadata={"unit": units[name]} if name in units else None)
        )
    return pyarrow.table(columns, schema=pyarrow.schema(described))
