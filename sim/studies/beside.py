"""A sweep as one more line in the figures of another sweep."""

from dataclasses import replace

import numpy as np

from echelon.errors import UsageError
from echelon.sim.report.drawing import Array
from echelon.sim.report.studies.results import Columns, Key, Predicted, StudyResults


def with_line(host: StudyResults, other: StudyResults, name: str) -> StudyResults:
    """Returns the results of a sweep with the points of another one as a line with this name.

    The one key of the other sweep counts as the axis of the host, whatever its name is; at its points all other keys of the
    host have the name of the line as their value.  Raises UsageError where there is no axis."""
    axis, own = host.axis, other.axis
    if axis is None or own is None:
        raise UsageError(f"sweeps: {name}: beside: what varies must be numbers in both sweeps")
    x = np.concatenate([_numbers(axis), _numbers(own)])
    count, more = len(host.points["point"]), len(other.points["point"])

    def longer(key: Key) -> Key:
        if key.name == axis.name:
            return replace(key, texts=key.texts + own.texts, numbers=x)
        return replace(key, texts=key.texts + (name,) * more, numbers=None)

    def joined(first: Columns, second: Columns, rows: int) -> Columns:
        found = {**second, **{key.name: np.full(rows, name, dtype=object) for key in host.keys}}
        found |= {"point": second["point"] + count, axis.name: second.get(own.name, found[axis.name])}
        return {column: np.concatenate([first[column], found[column]]) for column in first if column in found}

    def both(first: Columns, second: Columns) -> Columns:
        blocks = dict.fromkeys([*first, *second])
        gaps = np.full(count, np.nan), np.full(more, np.nan)
        return {block: np.concatenate([first.get(block, gaps[0]), second.get(block, gaps[1])]) for block in blocks}

    at = {key.name: name for key in host.others(axis)}
    bounds = [replace(one, at=at) for one in other.predicted.boundaries]
    return replace(
        host,
        command=f"{host.command}; {name}: {other.command}",
        keys=tuple(longer(key) for key in host.keys),
        points=joined(host.points, other.points, more),
        runs=joined(host.runs, other.runs, len(other.runs["point"])),
        predicted=Predicted(
            (*host.predicted.boundaries, *bounds),
            both(host.predicted.rates, other.predicted.rates),
            both(host.predicted.costs, other.predicted.costs),
        ),
    )


def _numbers(key: Key) -> Array:
    assert key.numbers is not None
    return key.numbers
