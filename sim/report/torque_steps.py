"""Torques that step up and down by the resolution of their frames, so that a figure shows a band instead of a line."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from echelon.bridge.protocols.registry import protocol_of
from echelon.sim.report.axes import TAUS
from echelon.sim.report.thinning import pieces
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
            stepped = sum(
                (_stepped(states[part.start : part.stop + 1], step) for part in pieces(len(states))), np.zeros(2)
            )
        if step > 0 and len(states) > 1 and stepped.max() > SHARE * (len(states) - 1):
            found.setdefault(step, []).append(robot.name)
    return " ".join(
        f"The frames of {some(names)} carry torque in steps of {step:.3g} N m: where it is small it goes up and down by a step "
        "or two, and its line becomes a band."
        for step, names in found.items()
    )


def _stepped(states: NDArray[np.float64], step: float) -> NDArray[np.float64]:
    """Returns how often each wheel's torque changes by one or two steps [N m] from one state to the next, (2,)."""
    change = np.abs(np.diff(states[:, TAUS], axis=0))
    found: NDArray[np.float64] = np.sum((change > 0.2 * step) & (change < 2.2 * step), axis=0, dtype=np.float64)
    return found
