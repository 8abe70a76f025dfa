"""Runs that begin near their formation, so that they are nearly linear."""

from dataclasses import replace

import numpy as np

from echelon.controller.transformation import Transformation
from echelon.plan.plan import Plan
from support.trees import plan_of, scenario

T = 0.025
"""Acceleration period [s]"""
TREE = ((None, None), (None, None, None))


def near_formation(
    links: list[dict[str, object]], timing: str = "event_driven", duration: float = 16.0, reference: str = "message"
) -> Plan:
    """Returns robots of the paper's plant, 0.3 m from a formation that drives straight on."""
    table = scenario(
        TREE,
        np.random.default_rng(4),
        duration=duration,
        law={"epsilon": [0.5, 0.5], "lead": 0.5, "reference": reference},
        periods={"acceleration": T, "torque": T / 2},
        trajectory={"kind": "line", "velocity": (0.5, 0.0)},
        timing=timing,
        links=links,
    )
    plan = plan_of(table)
    transformation, random = Transformation(plan), np.random.default_rng(1)
    starts = transformation.backward(transformation.desired(np.zeros(2))) + random.normal(size=(5, 2), scale=0.3)
    robots = [
        replace(robot, start=tuple(start), heading=0.0)
        for robot, start in zip(plan.robots, starts.tolist(), strict=True)
    ]
    return replace(plan, robots=tuple(robots))
