"""From runs to rows of a sweep's table: what was measured of each run, by the names of `columns`."""

from collections.abc import Iterable, Sequence
from math import isfinite, nan
from typing import Any, Final

import numpy as np

from echelon.messages import Channel
from echelon.plan.plan import Plan
from echelon.runtime.admission import rows_within
from echelon.sim.batch.outcomes import BatchRuns
from echelon.sim.results.block_series import block_series
from echelon.sim.results.ending import growth_of, levels
from echelon.sim.results.measure_records import LinkResult
from echelon.sim.results.rates import amplitude
from echelon.sim.results.records import Summary
from echelon.sim.results.trace import Trace
from echelon.sim.sweep.verdicts import word_of, words_of

Rows = dict[str, list[Any]]
"""The values of some runs by column; numbers that are missing are NaN"""
_AGES: Final = ("age_mean", "age_p50", "age_p95", "age_max")


def blocks_of(plan: Plan) -> list[str]:
    """Returns the names of a plan's blocks that have variables."""
    return [block.name for block in plan.blocks if block.size]


def channels_of(plan: Plan) -> list[str]:
    """Returns the names of the channels of a plan's links, in the order of channels."""
    return [channel.name.lower() for channel in Channel if any(link.channel == channel for link in plan.links)]


def rows_of_batch(runs: BatchRuns) -> Rows:
    """Returns the rows of the runs of a batch."""
    plan, words = runs.plan, words_of(runs)
    lost_at = runs.runs["diverged"]
    lost = ~np.isnan(lost_at)
    rows: Rows = {
        "verdict": [word.word for word in words],
        "holds": [int(word.word != "FAILS") for word in words],
        "reason": [word.reason for word in words],
        "lost_at": lost_at.tolist(),
        "smallest_distance": runs.runs["smallest"].tolist(),
        "violations": runs.runs["violations"].tolist(),
        "saturation": runs.robots["saturation_share"].max(axis=1).tolist(),
        "peak_torque": np.where(lost, np.nan, runs.robots["peak"].max(axis=1)).tolist(),
    }
    for number, block in enumerate(plan.blocks):
        if not block.size:
            continue
        found = runs.blocks[:, number]
        names = ("start_error", "settling_5", "settling_2", "residual", "peak_error", "peak_time", "ise", "iae", "itae")
        rows |= {f"{name}.{block.name}": found[name].tolist() for name in names}
        before, last = (np.where(lost, np.nan, found[name]).tolist() for name in ("earlier", "level"))
        rows |= _late(block.name, before, last)
        rows[f"decay_rate.{block.name}"] = [nan] * len(words)
    for channel in channels_of(plan):
        links = runs.links[:, [link.channel.name.lower() == channel for link in plan.links]]
        sent, gone = links["sent"].sum(axis=1), links["lost"].sum(axis=1)
        rows[f"loss.{channel}"] = (gone / np.maximum(sent, 1)).tolist()
        for name in _AGES:
            ages = links[name] if name in (links.dtype.names or ()) else np.full(links.shape, np.nan)
            largest = np.where(np.isnan(ages), -np.inf, ages).max(axis=1)
            rows[f"{name}.{channel}"] = np.where(np.isfinite(largest), largest, np.nan).tolist()
    return rows


def _late(block: str, before: Sequence[float], last: Sequence[float]) -> Rows:
    growth = [
        growth_of(late, early) if isfinite(late) and isfinite(early) else nan
        for early, late in zip(before, last, strict=True)
    ]
    return {f"amplitude_before.{block}": [*before], f"amplitude_last.{block}": [*last], f"growth.{block}": growth}


def row_of_run(trace: Trace, summary: Summary) -> Rows:
    """Returns the row of a single run."""
    plan = trace.plan
    word = word_of(summary.verdict.checks, bool(plan.claims))
    lost_at = _lost_at(trace)
    torques = summary.torque
    row: dict[str, Any] = {
        "verdict": word.word,
        "holds": int(word.word != "FAILS"),
        "reason": word.reason,
        "lost_at": lost_at,
        "smallest_distance": _number(summary.distance.smallest),
        "violations": len(summary.distance.violations),
        "saturation": max((_number(each.saturation_share) for each in torques), default=nan),
        "peak_torque": nan if isfinite(lost_at) else max((_number(each.peak) for each in torques), default=nan),
    }
    late = {}
    blocks = block_series(trace)
    for series in blocks.series:
        empty = isfinite(lost_at) or not len(blocks.times_ns) or not np.isfinite(series.norm).all()
        _, before, last = (nan, nan, nan) if empty else levels(amplitude(series), blocks.times_ns)
        late[series.block.name] = _late(series.block.name, [before], [last])
    for block in summary.blocks:
        if block.name not in blocks_of(plan):
            continue
        names = ("start_error", "settling_5", "settling_2", "residual", "peak_error", "peak_time", "ise", "iae", "itae")
        row |= {f"{name}.{block.name}": _number(getattr(block, name)) for name in names}
        row |= {name: values[0] for name, values in late[block.name].items()}
        row[f"decay_rate.{block.name}"] = _number(block.decay_rate)
    for channel in channels_of(plan):
        row |= _link_row(channel, [link for link in summary.links if link.channel == channel])
    return {name: [value] for name, value in row.items()}


def _link_row(channel: str, links: Sequence[LinkResult]) -> dict[str, float]:
    sent, lost = sum(link.sent for link in links), sum(link.lost for link in links)
    row = {f"loss.{channel}": lost / sent if sent else 0.0}
    return row | {f"{name}.{channel}": _largest(getattr(link, name) for link in links) for name in _AGES}


def _largest(values: Iterable[float | None]) -> float:
    return max((value for value in values if value is not None), default=nan)


def _lost_at(trace: Trace) -> float:
    """Returns the first instant at which a robot's state is not finite or beyond all bounds [s]; NaN if there is
    none."""
    first = [times_ns[~rows_within(states)][:1] for times_ns, states in zip(trace.times_ns, trace.states, strict=True)]
    found = [int(times_ns[0]) for times_ns in first if len(times_ns)]
    return min(found) / 1e9 if found else nan


def _number(value: float | None) -> float:
    return nan if value is None else float(value)
