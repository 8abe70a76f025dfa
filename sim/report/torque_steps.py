"""Torques that step up and down by the resolution of their frames, so that a figure shows a band instead of a line."""

from typing import Final

import numpy as np

from echelon.bridge.protocols.registry import protocol_of
from echelon.sim.report.axes import TAUS
from echelon.sim.results.can_lines import some
from echelon.sim.results.trace import Trace

SHARE: Final = 0.1
"""Share of the periods in which a torque must change by one or two steps to be mentioned"""


def steps_text(trace: Trace) -> str:
    """Returns sentences that name the robots whose torques step by the resolution of their frames, and the step [N m].

    Returns an empty text if there are none, and on the mirrored torque path: only on a closed path the wheels get their torques
    from frames."""
    if not trace.plan.can.closed:
        return ""
    found: dict[float, list[str]] = {}
    for robot, states in zip(trace.plan.robots, trace.states, strict=True):
        step = protocol_of(robot).resolution(robot.drive)
        with np.errstate(invalid="ignore"):
            change = np.abs(np.diff(states[:, TAUS], axis=0))
            stepped = (change > 0.2 * step) & (change < 2.2 * step)
        if step > 0 and len(stepped) and stepped.mean(axis=0).max() > SHARE:
            found.setdefault(step, []).append(robot.name)
    return " ".join(
        f"The frames of {some(names)} carry torque in steps of {step:.3g} N m: where it is small it goes up and down by a step "
        "or two, and its line becomes a band."
        for step, names in found.items()
    )
