"""Whether what a process says to the supervisor is a message of that process: of the right types all the way down, with numbers
that can be used, about what is in the plan.

A process that is broken may say anything.  What its message says of the run, true or false, is not judged here."""

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from math import isfinite
from types import NoneType, UnionType
from typing import Any, Final, Union, get_args, get_origin, get_type_hints

import numpy as np

from echelon.bridge.referee_reports import RefereeReport
from echelon.bridge.reports import BridgeProgress, CanReport, DrivesReport
from echelon.messages import STATE_FIELDS
from echelon.plan.plan import Plan
from echelon.sim.processes.contract import ProcessSpec
from echelon.sim.processes.to_supervisor import (
    Done,
    Failed,
    LinksProgress,
    PartFailed,
    RecorderProgress,
    RecorderReport,
    Said,
    Waiting,
)
from echelon.sim.results.trace import Trace

LARGEST: Final = 1 << 63
"""Numbers in messages are smaller than this"""
LATEST_S: Final = 1e9
"""No instant of a run is this late [s]"""
LONGEST: Final = 100_000
"""How many characters a text has at most that is shown while the run goes on"""
_NOTHING: Final = object()
REPORTS: Final[Mapping[str, type]] = {
    "bridge": CanReport,
    "drives": DrivesReport,
    "referee": RefereeReport,
    "recorder": RecorderReport,
}
"""The reports of processes, by their kind; the others give none"""


def understood(said: object, spec: ProcessSpec, plan: Plan) -> bool:
    """Returns whether `said` is a message of the process with this specification."""
    if isinstance(said, LinksProgress | Waiting):  # more would take long to look at
        many = said.links if isinstance(said, LinksProgress) else said.sources
        if not (isinstance(many, tuple) and len(many) <= len(plan.links)):
            return False
    if not (isinstance(said, Said) and _fits(said, type(said))):
        return False
    roles = len(plan.all_roles)
    match said:
        case Failed() | PartFailed():
            return len(said.text) <= LONGEST
        case Waiting():
            return all(0 <= source < roles for source in said.sources)
        case LinksProgress():
            return all(0 <= end < roles for link in said.links for end in (link.source, link.receiver))
        case BridgeProgress():
            shown = (said.url, said.stopped, said.note, *said.faults)
            return spec.kind in ("bridge", "drives") and isfinite(said.load) and sum(map(len, shown)) <= LONGEST
        case RecorderProgress():
            of_plan = said.states is None or said.states.shape == (len(plan.robots), len(STATE_FIELDS))
            return spec.kind == "recorder" and of_plan and _has_robot(said, plan) and len(said.failure or "") <= LONGEST
        case Done():
            kind = REPORTS.get(spec.kind, NoneType)
            stopped = said.report.wheels_stopped if isinstance(said.report, CanReport) else None
            if stopped is not None and not abs(stopped) < LATEST_S:
                return False
            return said.name == spec.name and type(said.report) in (kind, NoneType) and _has_robot(said.report, plan)
    return True


def _has_robot(said: object, plan: Plan) -> bool:
    """Returns whether a recording is of as many robots as the plan, and the robot whose state was lost, if one was, in it."""
    if isinstance(said, RecorderReport) and len(said.trace.states) != len(plan.robots):
        return False
    lost = said.lost if isinstance(said, RecorderProgress | RecorderReport) else None
    return lost is None or 0 <= lost.robot < len(plan.robots)


def _fits(value: object, kind: Any) -> bool:
    """Returns whether a value is of a type, and all that is in it of the types that its records name."""
    named = getattr(get_origin(kind) or kind, "__value__", None)  # newer versions of numpy name the type of arrays
    kind = kind if named is None else named
    origin, parts = get_origin(kind), get_args(kind)
    if origin in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if kind is Trace:
        return isinstance(value, Trace) and _is_trace(value)
    if origin is np.ndarray:
        return isinstance(value, np.ndarray) and value.dtype == np.float64
    if isinstance(kind, type) and is_dataclass(kind):
        return isinstance(value, kind) and all(
            _fits(getattr(value, name, _NOTHING), part) for name, part in _parts(kind)
        )
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if len(parts) == 2 and parts[1] is Ellipsis:
            return all(_fits(each, parts[0]) for each in value)
        return len(value) == len(parts) and all(map(_fits, value, parts))
    if isinstance(origin, type) and issubclass(origin, Mapping):
        return isinstance(value, dict) and all(
            _fits(name, parts[0]) and _fits(each, parts[1]) for name, each in value.items()
        )
    if kind is float:
        return isinstance(value, float | np.floating) or _fits(value, int)
    if kind is int:
        return isinstance(value, int | np.integer) and -LARGEST < int(value) < LARGEST
    return isinstance(value, bool | np.bool_ if kind is bool else kind)


@cache
def _parts(kind: type) -> tuple[tuple[str, Any], ...]:
    """Returns the fields of a record, with their types."""
    types = get_type_hints(kind)
    return tuple((field.name, types[field.name]) for field in fields(kind))


def _is_trace(trace: Trace) -> bool:
    """Returns whether a trace has instants and states of each robot.  Its plan is not used (`outcome`)."""
    rows = trace.times_ns, trace.states
    if not all(isinstance(each, tuple) for each in rows):
        return False
    width = len(STATE_FIELDS)
    return len(trace.times_ns) == len(trace.states) and all(
        isinstance(times, np.ndarray)
        and isinstance(states, np.ndarray)
        and times.dtype == np.int64
        and states.dtype == np.float64
        and (times.ndim, states.shape) == (1, (len(times), width))
        for times, states in zip(trace.times_ns, trace.states, strict=True)
    )
