"""Tables of studies in the layout of `echelon sweep`, with numbers that follow simple rules."""

from collections.abc import Mapping, Sequence
from itertools import product
from typing import Any

import numpy as np

from echelon.sim.report.studies.results import Key, Predicted, StudyResults

BLOCKS = ("g1", "inter", "centroid")


def study(
    values: Mapping[str, Sequence[Any]],
    holds: Any = lambda *point: 1.0,
    seeds: int = 8,
    predicted: Predicted | None = None,
    rates: bool = False,
    **more: Any,
) -> StudyResults:
    """Returns the results of a grid.  `holds` gives the share of runs that hold from a point's values."""
    points = list(product(*values.values()))
    share = np.array([holds(*point) for point in points])
    count = len(points)
    table: dict[str, Any] = {"point": np.arange(count), "runs": np.full(count, seeds), "holds": np.round(share * seeds)}
    table |= {"share": share, "share_low": np.maximum(share - 0.2, 0), "share_high": np.minimum(share + 0.2, 1)}
    runs: dict[str, Any] = {"point": np.repeat(np.arange(count), seeds), "seed": np.tile(np.arange(seeds), count)}
    for number, key in enumerate(values):
        column = [point[number] for point in points]
        table[key] = np.array(column, dtype=float if not isinstance(column[0], str) else object)
    for number, block in enumerate(BLOCKS, start=1):
        base = number * (1 + np.arange(count) / count)
        table[f"settling_5.{block}"] = np.where(share >= 0.5, base, np.nan)
        table[f"settling_2.{block}"] = np.where(share >= 0.5, 1.3 * base, np.nan)
        table[f"decay_rate.{block}"] = 1 / base if rates else np.full(count, np.nan)
        for name in ("ise", "itae", "peak_error"):
            table[f"{name}.{block}"] = table[f"{name}_mean.{block}"] = base
        table[f"moment_growth.{block}"] = np.where(share >= 0.5, 0.1, 10.0)
        table[f"moment_growth_low.{block}"], table[f"moment_growth_high.{block}"] = 0.5 * share, 2 - share
        runs[f"iae.{block}"] = np.repeat(base, seeds)
    table["age_mean.state"] = np.full(count, 0.01)
    late = np.linspace(0.01, 0.1, count * seeds)
    runs["age_p50.state"], runs["age_p95.state"] = (late, 2 * late) if rates else (np.full_like(late, np.nan),) * 2
    keys = tuple(Key.of(key, table[key].tolist()) for key in values)
    command = "echelon sweep lab --vary 'a & <b>'"
    return StudyResults("lab", command, keys, table, runs, seeds, predicted=predicted or Predicted(), **more)
