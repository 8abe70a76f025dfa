"""The folder of a sweep: its design, which tells it from other sweeps, and its tables."""

import json
import os
import shlex
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal
from pathlib import Path
from typing import Final

from echelon.errors import UsageError
from echelon.files import lock, write_text
from echelon.planning.loading import effective_toml
from echelon.shipped import EFFECTIVE
from echelon.sim.kept_parts import keep_parts
from echelon.sim.sweep import journal
from echelon.sim.sweep.origin import Origin
from echelon.sim.sweep.preparing import SHARE, Prepared, Request
from echelon.sim.sweep.search import Search
from echelon.sim.sweep.study import FIND, POINTS, RUNS, SWEEP, Sweep, read_spec, write_find
from echelon.sim.sweep.tables import write_csv, write_parquet
from echelon.sim.sweep.values import Span, Vary

TABLES: Final = tuple(f"{name}.{kind}" for name in (RUNS, POINTS) for kind in ("csv", "parquet"))
FILES: Final = (SWEEP, EFFECTIVE, journal.NAME, FIND, *TABLES)
"""The files of a sweep, without copies of those that its scenario names"""


def open_folder(prepared: Prepared, out: Path) -> int:
    """Makes and locks the folder of a sweep, and writes its design into it; returns the lock.

    Raises UsageError if another sweep or something else is there."""
    try:
        out.mkdir(parents=True, exist_ok=True)
        held = lock(out)
    except FileExistsError:
        raise UsageError(f"--out {out}: is a file, and must be a folder") from None
    except BlockingIOError:
        raise UsageError(f"--out {out}: a sweep is going on there; give another folder") from None
    except OSError as error:
        raise UsageError(f"--out {out}: {error.strerror}") from None
    try:
        _claim(prepared, out)
    except BaseException:
        os.close(held)
        raise
    return held


def _claim(prepared: Prepared, out: Path) -> None:
    spec, path = prepared.spec(), out / SWEEP
    if path.exists():
        there = read_spec(out)
        if different := [name for name, value in spec.items() if there.get(name) != value]:
            raise UsageError(
                f"--out {out}: holds another sweep (different: {', '.join(different)}); give another folder"
            )
        return
    if file := next((name for name in FILES if os.path.lexists(out / name)), None):
        raise UsageError(f"--out {out}: {file} is there, but no {SWEEP}; give another folder")
    kept = keep_parts(prepared.nominal.scenario, out, FILES)
    write_text(out / EFFECTIVE, effective_toml(prepared.nominal.scenario, kept.names))
    origin, request = prepared.request.origin, prepared.request
    again = {
        "command": shlex.join(sys.argv),
        "begun": datetime.now(UTC).isoformat(timespec="seconds"),
        "origin": {
            "text": origin.text,
            "name": origin.name,
            "folder": str(origin.folder.resolve()),
            "overrides": list(origin.overrides),
        },
        "request": {
            "varied": [{"key": each.key, "values": list(each.values), "span": _span(each)} for each in request.varied],
            "samples": request.samples,
            "seeds": len(prepared.seeds),
            "engine": prepared.engine,
        },
    }
    write_text(path, json.dumps(spec | again, indent=1, ensure_ascii=False) + "\n")


def _span(varied: Vary) -> list[str | None] | None:
    span = varied.span
    return None if span is None else [str(span.low), str(span.high), None if span.step is None else str(span.step)]


def resumed(folder: Path) -> Request:
    """Returns the request of the sweep in a folder, to go on with it.  Raises UserError."""
    spec = read_spec(folder)
    try:
        origin, request, find = spec["origin"], spec["request"], spec["find"]
        varied = tuple(Vary(each["key"], tuple(each["values"]), _read_span(each["span"])) for each in request["varied"])
        return Request(
            origin=Origin(origin["text"], origin["name"], Path(origin["folder"]), tuple(origin["overrides"])),
            varied=varied,
            kind=spec["design"],
            samples=request["samples"],
            search=None
            if find is None
            else Search(find["key"], Span(*(Decimal(find[end]) for end in ("low", "high", "step")))),
            share=SHARE if find is None else find["share"],
            seeds=request["seeds"],
            engine=request["engine"],
            allow_unstable=True,
        )
    except (KeyError, TypeError, ValueError, ArithmeticError):
        raise UsageError(f"{folder / SWEEP}: is damaged") from None


def _read_span(ends: Sequence[str | None] | None) -> Span | None:
    return None if ends is None else Span(*(None if end is None else Decimal(end) for end in ends))  # type: ignore[arg-type]


def write(sweep: Sweep, out: Path) -> None:
    """Writes the tables of a sweep, and its boundaries."""
    for name, table in ((RUNS, sweep.runs), (POINTS, sweep.points)):
        write_csv(table, out / f"{name}.csv")
        write_parquet(table, out / f"{name}.parquet")
    if sweep.find:
        write_find(sweep.find, out / FIND)
