"""CSV files of a run: numbers in full (a float reads back as the same float), one header line, times in seconds."""

from collections.abc import Iterable, Sequence
from itertools import repeat
from pathlib import Path
from typing import Final

import numpy as np

from echelon.messages import STATE_FIELDS, field_index
from echelon.sim.results.blocks import block_series, component_names
from echelon.sim.results.run import Run
from echelon.sim.results.trace import Trace

ROBOT_FIELDS: Final = ("x", "y", "theta", "v", "omega", "ax", "ay", "tau_right", "tau_left")
LINK_FIELDS: Final = (
    "source", "receiver", "channel", "sent", "delivered", "lost", "in_flight", "used", "held", "age_mean", "age_max",
)  # fmt: skip


def export_csv(run: Run, folder: Path) -> list[Path]:
    """Writes `robots.csv`, `blocks.csv` and `links.csv` into a folder, which is made if need be; returns them.

    Robots: every state of every robot, by time, then robot.  Blocks: at the instants at which every robot has a state,
    by time, block and component.  Links: one row each, ages in seconds.  Raises OSError.
    """
    folder.mkdir(parents=True, exist_ok=True)
    files = [folder / name for name in ("robots.csv", "blocks.csv", "links.csv")]
    _write(files[0], ("t", "robot", *ROBOT_FIELDS), _robots(run.trace))
    _write(files[1], ("t", "block", "component", "value", "desired", "error", "rate"), _blocks(run.trace))
    _write(files[2], LINK_FIELDS, (",".join(str(getattr(row, field)) for field in LINK_FIELDS) for row in run.links))
    return files


def _robots(trace: Trace) -> Iterable[str]:
    fields = field_index(STATE_FIELDS, *ROBOT_FIELDS)
    times = np.concatenate(trace.times_ns)
    robots = np.repeat(np.arange(len(trace.times_ns)), [len(times_ns) for times_ns in trace.times_ns])
    order = np.lexsort((robots, times))
    names = [robot.name for robot in trace.plan.robots]
    columns = np.concatenate(trace.states)[:, fields][order].T
    return map(
        ",".join,
        zip(
            map(repr, (times[order] / 1e9).tolist()),
            (names[robot] for robot in robots[order].tolist()),
            *(map(repr, column.tolist()) for column in columns),
            strict=True,
        ),
    )


def _blocks(trace: Trace) -> Iterable[str]:
    blocks = block_series(trace)
    names = [
        f"{series.block.name},{component}" for series in blocks.series for component in component_names(series.block)
    ]
    parts = ("value", "desired", "error", "rate")
    columns = [
        np.concatenate([getattr(series, part) for series in blocks.series], axis=1).reshape(-1) for part in parts
    ]
    return map(
        ",".join,
        zip(
            (time for time in map(repr, blocks.seconds.tolist()) for _ in names),
            (name for same in repeat(names, len(blocks.times_ns)) for name in same),
            *(map(repr, column.tolist()) for column in columns),
            strict=True,
        ),
    )


def _write(path: Path, header: Sequence[str], rows: Iterable[str]) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(",".join(header) + "\n")
        file.writelines(f"{row}\n" for row in rows)
