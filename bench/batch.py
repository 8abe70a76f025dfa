"""Many runs of lab.toml at once, in robot steps per second: the batch engine, beside loops of the same laws in numpy and in
plain Python, and beside VMAS.  `python -m bench.batch` measures them alone.

The batch engine and the loops compute the law of all blocks with avoidance, each robot's inverse and limits, and its motion.
The loops have no tree, no links and no measures.  Their runs must end where the batch engine's do.  `bench.vmas` says what VMAS
computes.  Beside them are the batch engine on a GPU, where there is one, with more robots, and a whole sweep with its tables.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from itertools import count
from pathlib import Path
from typing import Final

import numpy as np

from bench import vmas
from bench.product import Row, table
from echelon.agents.plant import make_step, state_at
from echelon.agents.torque import TorqueLimits, make_inverse
from echelon.controller.laws.central import CentralLaw
from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import Transformation
from echelon.plan.plan import Array, Plan
from echelon.shipped import shipped
from echelon.sim.batch.batch import Device, run_many
from echelon.sim.batch.refusals import gpu_refusal
from echelon.sim.parts.loading import load

LATE: Final = (
    'links=[{source="*/*", receiver="**", channel="state", loss=0.1, delay={min=0.01, max=0.05}}, '
    '{source="**", receiver="**", channel="command", loss=0.1}]'
)
"""States come 10 to 50 ms late, a tenth of them is lost, and a tenth of the commands"""
RUNS: Final = {"batch": 400, "numpy": 400, "python": 1, "gpu": 65_536, "sweep": 8000, "spread": 43_200}
"""Runs at once; `spread`: robots of all runs together"""
SECONDS: Final = {"batch": 30, "numpy": 2, "python": 5, "vmas": 2, "gpu": 30, "sweep": 30, "spread": 3}
SWEEPS: Final = 1
"""Whole sweeps, at most: one alone takes as long as most of the rest"""
SPREAD: Final = {9: (3, 3), 90: (10, 3, 3), 900: (10, 10, 3, 3)}
"""Formations of several sizes: by the number of robots how many children there are in each layer, from the coordinator down"""


def lab(seconds: float, *changes: str) -> Plan:
    """Returns the plan of lab.toml."""
    return load(shipped()["lab"], [f"duration={seconds}", *changes])[1]


def spread(sizes: Sequence[int], seconds: float) -> Plan:
    """Returns the plan of a formation of lab.toml's robots, in rows of rows, with this number of children in each layer."""
    numbers = count()

    def group(layer: int, x: float, y: float) -> str:
        """Returns the TOML of a group whose first child is at a place: rows along x and along y in turn."""
        size, apart = sizes[layer], 0.8 * 4.0 ** (len(sizes) - 1 - layer)
        kind, along = ("column", (-apart, 0.0)) if layer % 2 else ("line", (0.0, -apart))
        places = [(x + at * along[0], y + at * along[1]) for at in range(size)]
        if layer + 1 < len(sizes):
            children = "groups={" + ",".join(f"g{next(numbers)}={group(layer + 1, *place)}" for place in places)
        else:
            children = "robots={" + ",".join(f"r{next(numbers)}={{start=[{x}, {y}]}}" for x, y in places)
        return f'{{shape={{kind="{kind}", spacing={apart}}},{children}}}}}'

    changes = f"formation={group(0, 0.0, 0.0)}", f"law.epsilon={[0.5] * len(sizes)}"
    return lab(seconds, *changes, "claims=[]", "can.enabled=false", "avoidance.enabled=false")


def batch(plan: Plan, runs: int, device: Device = "processor") -> Array:
    """Runs the batch engine; returns the robots' positions at the end of the first run, (N, 2)."""
    wanted = runs == 1
    traces = run_many(plan, range(runs), device=device, traces=wanted, say=lambda text: None).traces
    return np.empty(0) if traces is None else np.asarray(traces[0, -1, :, :2])


def on_gpu(plan: Plan, runs: int) -> Array:
    """Runs the batch engine on a GPU."""
    return batch(plan, runs, "gpu")


def sweep_s() -> float:
    """Makes a sweep of lab.toml by the command line, start and tables included; returns how long it takes [s]."""
    with tempfile.TemporaryDirectory(prefix="bench-") as folder:
        command = [sys.executable, "-m", "echelon", "sweep", "lab", "--set", f"duration={SECONDS['sweep']}"]
        command += ["--seeds", str(RUNS["sweep"]), "--quiet", "--out", folder]
        begun_s = time.perf_counter()
        subprocess.run(command, cwd=vmas.ROOT, stdout=subprocess.DEVNULL, check=True)
        return time.perf_counter() - begun_s


def plain_python(plan: Plan, runs: int) -> Array:
    """Runs the central law, and robots one after the other, in plain Python; returns the positions at the end."""
    positions: Array = np.empty((0, 2))
    h = plan.robots[0].torque_period_ns * 1e-9
    for _ in range(runs):
        law = CentralLaw(plan)
        states = [state_at(*robot.start, robot.heading, 0.0, 0.0) for robot in plan.robots]
        steps, inverses = [make_step(robot) for robot in plan.robots], [make_inverse(robot) for robot in plan.robots]
        limits = [
            TorqueLimits(r.torque_limit, r.torque_rate_limit, r.wheel_speed_limit, r.wheel_radius, r.arm)
            for r in plan.robots
        ]
        for time_ns in range(0, plan.duration_ns, plan.root.period_ns):
            positions = np.array([(s.x, s.y) for s in states])
            across = [robot.offset * s.omega for robot, s in zip(plan.robots, states, strict=True)]
            velocities = np.array([
                (s.v * s.cos_theta - w * s.sin_theta, s.v * s.sin_theta + w * s.cos_theta)
                for s, w in zip(states, across, strict=True)
            ])  # fmt: skip
            accelerations = law(time_ns * 1e-9, positions, velocities).tolist()
            for at, (ax, ay) in enumerate(accelerations):
                state = states[at]
                right, left = inverses[at](state, ax, ay, 0.5 * h)
                right, left, _ = limits[at].apply(right, left, state.v, state.omega, h)
                states[at] = steps[at](state, right, left, h)
        positions = np.array([(s.x, s.y) for s in states])
    return positions


def plain_numpy(plan: Plan, runs: int) -> Array:
    """Runs all runs at once as numpy arrays; returns the positions at the end of the first one."""
    robot, transformation, avoidance = plan.robots[0], Transformation(plan), plan.avoidance
    law, trajectory = CentralLaw(plan), make_trajectory(plan.trajectory)
    ahead = plan.lead * plan.root.period_ns * 1e-9
    blocks = [plan.law.made.linear(block) for block in law._blocks]
    K_1, K_2 = (np.concatenate([np.diag(getattr(gains, name))[::2] for gains in blocks]) for name in ("K_1", "K_2"))
    W = np.concatenate([np.diag(g.weight)[::2] / b.sigma for g, b in zip(blocks, law._blocks, strict=True)])
    h = robot.torque_period_ns * 1e-9
    m, d, r, arm, J = (
        robot.mass,
        robot.offset,
        robot.wheel_radius,
        robot.arm,
        robot.inertia - robot.mass * robot.offset**2,
    )
    shape = runs, len(plan.robots)
    p = np.tile([each.start for each in plan.robots], (runs, 1, 1))
    theta, v, omega = np.full(shape, robot.heading), np.zeros(shape), np.zeros(shape)
    last = np.zeros((2, *shape))
    first, second = np.triu_indices(shape[1], 1)
    apart_of = np.zeros((len(first), shape[1]))
    apart_of[np.arange(len(first)), first], apart_of[np.arange(len(first)), second] = 1.0, -1.0
    inner = (1 - np.sqrt(1 / 5)) / 2
    for time_ns in range(0, plan.duration_ns, plan.root.period_ns):
        c, s = np.cos(theta), np.sin(theta)
        z_cd = trajectory.at(time_ns * 1e-9)
        velocity = np.stack([v * c - d * omega * s, v * s + d * omega * c], axis=-1)
        e, e_dot = transformation.forward(p) - transformation.desired(z_cd[0]), transformation.forward(velocity)
        e_dot[:, -1] -= z_cd[1]
        nu = -K_1[:, None] * e - K_2[:, None] * e_dot
        nu[:, -1] += trajectory.at(time_ns * 1e-9 + ahead)[2]
        apart = apart_of @ p
        q = np.square(apart).sum(axis=-1)
        if (q < avoidance.sensing_radius**2).any():
            gap = q - avoidance.avoidance_radius**2
            with np.errstate(all="ignore"):
                far = 4 * np.sqrt(q) * (avoidance.sensing_radius**2 - q)
                push = far * (avoidance.sensing_radius**2 - avoidance.avoidance_radius**2) / gap**3
            push = np.where(gap > 0, np.minimum(push, avoidance.force_limit), avoidance.force_limit)
            push = np.where(q < avoidance.sensing_radius**2, push, 0.0) / np.maximum(np.sqrt(q), 1e-300)
            nu += W[:, None] * transformation.forward(apart_of.T @ (push[..., None] * apart))
        a_x, a_y = np.moveaxis(transformation.backward(nu), -1, 0)
        v_dot = c * a_x + s * a_y + d * omega * omega
        omega_dot = (c * a_y - s * a_x - v * omega) / d
        turned = theta + h / 2 * (omega + h / 4 * omega_dot)
        faster, turning = v + h / 2 * v_dot, omega + h / 2 * omega_dot
        cos, sin = np.cos(turned), np.sin(turned)
        total = m * r / 2 * (cos * a_x + sin * a_y + d * turning**2)
        difference = J * r / (2 * d * arm) * (cos * a_y - sin * a_x - faster * turning)
        wanted = np.stack([total + difference, total - difference])
        change = robot.torque_rate_limit * h
        torque = np.clip(np.clip(wanted, last - change, last + change), -robot.torque_limit, robot.torque_limit)
        speed = np.stack([v + arm * omega, v - arm * omega]) / r
        torque[(np.abs(speed) > robot.wheel_speed_limit) & (torque * speed > 0)] = 0.0
        last = torque
        v_dot, half = (torque[0] + torque[1]) / (m * r), arm * (torque[0] - torque[1]) / (2 * J * r)
        after = theta + h * (omega + h * half)
        p = p + d * np.stack([np.cos(after) - c, np.sin(after) - s], axis=-1)
        for weight, part in ((1 / 12, 0.0), (5 / 12, inner), (5 / 12, 1 - inner), (1 / 12, 1.0)):
            t = part * h
            angle, along = theta + t * (omega + half * t), weight * h * (v + v_dot * t)
            p += along[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        theta, v, omega = after, v + h * v_dot, omega + 2 * h * half
    return np.asarray(p[0])


def rate(run: Callable[[Plan, int], Array], plan: Plan, runs: int) -> float:
    """Returns robot steps per second, all cores together."""
    begun_s = time.perf_counter()
    run(plan, runs)
    ticks = plan.duration_ns / plan.robots[0].period_ns
    return runs * ticks * len(plan.robots) / (time.perf_counter() - begun_s) / 1e6


def measure(
    repeats: int, environments: Sequence[int] = (vmas.ENVIRONMENTS,), python: Path = vmas.PYTHON
) -> tuple[list[Row], dict[str, str]]:
    """Measures all, in turn, VMAS with each number of environments; returns the rows, and why VMAS or a GPU has none.

    Raises RuntimeError if a loop's runs do not end where they should."""
    short = lab(SECONDS["vmas"])
    where = batch(short, 1)  # compiles
    for loop in (plain_numpy, plain_python):
        if not np.allclose(loop(short, 1), where, rtol=0, atol=1e-9):
            raise RuntimeError(f"{loop.__name__} ends elsewhere")
    peer = vmas.Vmas(short, where, python)
    failures = {} if peer.installed else {"vmas": vmas.MISSING}
    kinds: dict[str, tuple[Callable[[Plan, int], Array], Plan, int]] = {
        "lab.toml, many runs: batch engine": (batch, lab(SECONDS["batch"]), RUNS["batch"]),
        "lab.toml, many runs: the same, late and lossy": (batch, lab(SECONDS["batch"], LATE), RUNS["batch"]),
        "lab.toml, many runs: late and lossy, time-driven": (
            batch,
            lab(SECONDS["batch"], LATE, 'timing="time_driven"'),
            RUNS["batch"],
        ),
        "lab.toml, many runs: loop of numpy arrays": (plain_numpy, lab(SECONDS["numpy"]), RUNS["numpy"]),
        "lab.toml, one run: loop in plain Python": (plain_python, lab(SECONDS["python"]), RUNS["python"]),
    }
    for robots, sizes in SPREAD.items():
        kinds[f"{robots} robots, many runs: batch engine"] = (
            batch,
            spread(sizes, SECONDS["spread"]),
            1 + RUNS["spread"] // robots,
        )
    if why := gpu_refusal():
        failures["gpu"] = why
    else:
        kinds["lab.toml, many runs: batch engine on the GPU"] = on_gpu, lab(SECONDS["gpu"]), RUNS["gpu"]
        on_gpu(short, 1)  # compiles
    found: dict[str, list[float]] = {what: [] for what in kinds}
    points: dict[str, list[float]] = {}
    for _ in range(repeats):
        for what, kind in kinds.items():
            found[what].append(rate(*kind))
        for number in environments if "vmas" not in failures else ():
            try:
                rates = peer.rates(number)
            except RuntimeError as error:
                failures["vmas"] = f"failed: {error}"
                break
            for way, value in rates.items():
                points.setdefault(f"points in VMAS, {number} runs a core: {way}", []).append(value)
    found |= points if "vmas" not in failures else {}
    rows = [Row(what, "10⁶ steps/s", tuple(rates)) for what, rates in found.items()]
    sweeps = tuple(sweep_s() for _ in range(min(repeats, SWEEPS)))
    rows.append(Row(f"sweep: {RUNS['sweep']:,} runs of lab, {SECONDS['sweep']} s each, tables written", "s", sweeps))
    return rows, failures


def told(failures: dict[str, str]) -> str:
    """Returns a line for each peer that has no row."""
    return "".join(f"{name}: {text}\n" for name, text in failures.items())


def main() -> int:
    """Measures all and prints it; returns the exit code: 1 if a peer failed, otherwise 0."""
    parser = argparse.ArgumentParser(prog="python -m bench.batch", description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--repeat", type=int, default=5, help="runs of each kind (default 5)")
    parser.add_argument(
        "--environments",
        type=int,
        nargs="+",
        default=[vmas.ENVIRONMENTS],
        help=f"numbers of runs that VMAS makes at once on each core (default {vmas.ENVIRONMENTS})",
    )
    parser.add_argument("--json", action="store_true", help="print JSON instead of a table")
    options = parser.parse_args()
    rows, failures = measure(options.repeat, options.environments)
    if options.json:
        print(json.dumps({"failures": failures, "runs": [asdict(row) for row in rows]}))
    else:
        print(table(rows), told(failures), sep="\n", end="")
    return 1 if any(text.startswith("failed") for text in failures.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
