"""Random formations for tests of predictions: coupled blocks with full gain matrices, trees of up to four layers, periods of
different length; and how errors near the formation grow in runs of real robots."""

from dataclasses import replace

import numpy as np

from echelon.controller.trajectory import make_trajectory, sample
from echelon.controller.transformation import Transformation
from echelon.plan.plan import Array, Plan
from echelon.sim.batch.batch import run_many
from support.trees import Tree, count_layers, plan_of, random_epsilon, scenario, with_random_gains

TREES: tuple[Tree, ...] = (
    ((None, None), (None, None, None)),
    (((None, None), (None, None)), (None, None)),
    ((((None, None), None), (None, None)), None),
    ((None, None, None), None, ((None, None), (None,))),
    ((((None, None),), (None, None)), (None, None)),
)
FREE = ("avoidance.enabled=false", "robot.torque_limit=inf", "robot.torque_rate_limit=inf",
        "robot.wheel_speed_limit=inf", "claims=[]")  # fmt: skip
AT_REST = 'trajectory={kind="line", velocity=[0.0, 0.0]}'
OFF = 1e-4
"""How far robots start from their places [m]"""
ROUNDING = 1e-11
"""Errors up to this come from rounding [m]"""


def random_formation(seed: int) -> Plan:
    """Returns a random plan; the seeds from 0 on take the trees in turn.  The formation stands still."""
    random = np.random.default_rng(seed)
    tree = TREES[seed % len(TREES)]
    T = float(random.choice([0.02, 0.05]))
    law = random_epsilon(tree, random) | {"lead": float(random.choice([0.0, 0.5]))}
    table = scenario(
        tree,
        random,
        law=law,
        duration=8 * T,
        periods={"acceleration": T, "torque": T / 10},
        trajectory={"kind": "line", "velocity": (0.0, 0.0)},
        timing=str(random.choice(["event_driven", "time_driven"])),
    )
    _give_periods(table["formation"], T, random)
    return with_random_gains(plan_of(table), random, coupling=0.1)


def _give_periods(group: dict, T: float, random: np.random.Generator) -> float:
    """Gives the groups of a table periods: each is that of its slowest child group, or twice that."""
    slowest = max((_give_periods(child, T, random) for child in group["groups"].values()), default=T)
    group["period"] = slowest * int(random.choice([1, 2]))
    return float(group["period"])


def layers_of(seed: int) -> int:
    """Returns the number of layers of the tree of a random formation."""
    return count_layers(TREES[seed % len(TREES)])


def near_the_formation(plan: Plan, seconds: float) -> tuple[Array, Array]:
    """Runs a plan with robots that start near their places, at rest, heading along x; returns instants [s] and the largest
    |e| of a block at each of them [m].  Both end where a state is not finite."""
    duration_ns = round(seconds * 1e9) // plan.root.period_ns * plan.root.period_ns
    transformation = Transformation(plan)
    places = transformation.backward(transformation.desired(make_trajectory(plan.trajectory).at(0.0)[0]))
    starts = places + OFF * np.random.default_rng(1).normal(size=places.shape)
    robots = [
        replace(robot, start=(float(x), float(y)), heading=0.0)
        for robot, (x, y) in zip(plan.robots, starts, strict=True)
    ]
    runs = run_many(replace(plan, robots=tuple(robots), duration_ns=duration_ns), [1], traces=True, threads=1)
    assert runs.traces is not None
    z = transformation.forward(runs.traces[0, :, :, :2])
    desired = transformation.desired(sample(make_trajectory(plan.trajectory), runs.times)[:, 0])
    norms = np.linalg.norm(z - desired, axis=(1, 2))
    finite = np.isfinite(norms)
    return runs.times[finite], norms[finite]


def dies_away(plan: Plan, seconds: float) -> bool:
    """Returns whether errors near the formation die away: the largest in the last eighth of a run is smaller than in the
    fifth, or no more than rounding, and no state ceased to be finite."""
    times, norms = near_the_formation(plan, seconds)
    if times[-1] < 0.9 * seconds or not len(norms):
        return False
    part = len(norms) // 8
    return bool(norms[-part:].max() < max(ROUNDING, norms[4 * part : 5 * part].max()))
