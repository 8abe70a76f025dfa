"""VMAS beside the batch engine: points in the place of robots, moved by PyTorch in float32, under the law of all blocks.

PyTorch is large, and its builds for processors alone are not on every index.  So VMAS is no dependency of `make bench`: it has
an environment of its own, `.venv-vmas`, which `make bench-vmas` makes.  `bench.peers.vmas_points` runs there.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any, Final

import numpy as np

from echelon.controller.laws.central import CentralLaw
from echelon.plan.plan import Array, Plan

ROOT: Final = Path(__file__).resolve().parent.parent
PYTHON: Final = Path(sys.prefix).with_name(Path(sys.prefix).name + "-vmas") / "bin" / "python"
"""The interpreter that has VMAS: of the environment that the Makefile makes beside this one"""
MISSING: Final = "not installed; `make bench-vmas` makes .venv-vmas for it"
ENVIRONMENTS: Final = 16384
"""Runs at once in each of its processes, of which there is one for each core"""
TIMEOUT_S: Final = 300.0
ROUNDING: Final = 1e-5
"""Largest distance [m] from `euler`, the same steps in float64.  Positions of some metres have 2 · 10⁻⁷ m in float32, and the
law pulls points back, so that roundings do not add up.  A gain that is wrong by a hundredth makes more than ten times this"""
STEPPING: Final = 0.002
"""Largest distance [m] from the robots of the batch engine.  VMAS moves a point with its speed at the end of a step, half a
step too far: h/2 times the change of its speed, 0.005 s · 0.3 m/s"""


def law_of(plan: Plan) -> dict[str, Any]:
    """Returns the law of all blocks for points, as plain numbers, and where they start.

    With the errors e = Φ p - z_d and ė = Φ v - ż_d, the central law (docs/architecture.md, 2.4) gives the forces

        m a = m Φ⁻¹ (-K_1 e - K_2 ė + z̈_d + W/σ Φ Dᵀ f) = matrix [p; v] + moving(t) + push f

    D takes positions to the differences of all pairs, f has the force of each pair along its difference.  So all that does not
    depend on states is multiplied out here, once: the step itself is a product with one matrix."""
    law, robot, avoidance = CentralLaw(plan), plan.robots[0], plan.avoidance
    phi, back = law.transformation.matrix, robot.mass * law.transformation.inverse
    gains = [plan.law.made.linear(block) for block in law._blocks]
    K_1, K_2 = (np.concatenate([np.diag(getattr(each, name))[::2] for each in gains]) for name in ("K_1", "K_2"))
    W = np.concatenate([np.diag(g.weight)[::2] / b.sigma for g, b in zip(gains, law._blocks, strict=True)])
    first, second = np.triu_indices(len(plan.robots), 1)
    apart = np.eye(len(plan.robots))[first] - np.eye(len(plan.robots))[second]
    wanted = []
    for time_ns in range(0, plan.duration_ns, plan.root.period_ns):
        z_cd = law.trajectory.at(time_ns * 1e-9)
        z = K_1[:, None] * law.transformation.desired(z_cd[0])
        z[-1] += K_2[-1] * z_cd[1] + law.trajectory.at(time_ns * 1e-9 + law._ahead_s)[2]
        wanted.append(back @ z)
    return {
        "start": [robot.start for robot in plan.robots],
        "mass": robot.mass,
        "period_s": plan.root.period_ns * 1e-9,
        "matrix": np.hstack([-back * K_1 @ phi, -back * K_2 @ phi]).tolist(),
        "moving": np.array(wanted).tolist(),
        "apart": apart.tolist(),
        "push": (back * W @ phi @ apart.T).tolist(),
        "sensing_radius": avoidance.sensing_radius if avoidance.enabled else 0.0,
        "avoidance_radius": avoidance.avoidance_radius,
        "force_limit": avoidance.force_limit,
    }


def euler(plan: Plan) -> Array:
    """Returns where points end in float64 under the central law, (N, 2): each step changes the speed first, as VMAS does."""
    law, h = CentralLaw(plan), plan.root.period_ns * 1e-9
    p: Array = np.array([robot.start for robot in plan.robots], dtype=float)
    v = np.zeros_like(p)
    for time_ns in range(0, plan.duration_ns, plan.root.period_ns):
        v = v + h * law(time_ns * 1e-9, p, v)
        p = p + h * v
    return p


class Vmas:
    """Points of VMAS under the law of a plan, in a process of their own."""

    def __init__(self, plan: Plan, robots: Array, python: Path = PYTHON) -> None:
        """`robots` are the places at which the batch engine's robots end, (N, 2) [m]."""
        self.law, self._points, self._robots, self._python = law_of(plan), euler(plan), robots, python

    @property
    def installed(self) -> bool:
        """Whether there is an environment with VMAS."""
        return self._python.exists()

    def rates(self, environments: int = ENVIRONMENTS) -> dict[str, float]:
        """Runs all ways once; returns the rate of each [10⁶ steps/s].

        Raises RuntimeError, with a line that says why, if that fails, or if the points do not end where they should."""
        given = self.law | {"environments": environments, "processes": len(os.sched_getaffinity(0))}
        command = [str(self._python), "-O", "-m", "bench.peers.vmas_points"]
        try:
            done = subprocess.run(
                command, input=json.dumps(given), cwd=ROOT, capture_output=True, text=True, timeout=TIMEOUT_S
            )
        except (OSError, subprocess.TimeoutExpired) as error:
            raise RuntimeError(f"{error}") from error
        if done.returncode:
            raise RuntimeError((done.stderr.strip().splitlines() or [f"exit code {done.returncode}"])[-1])
        return self.checked(done.stdout)

    def checked(self, text: str) -> dict[str, float]:
        """Returns the rates that the process printed.  Raises RuntimeError as `rates` does."""
        try:
            found = json.loads(text.strip().splitlines()[-1])
            rates = {str(way): float(rate) for way, rate in found["rates"].items()}
            places = {way: np.array(found["places"][way]) for way in ("env.step", "world.step")}
        except (IndexError, KeyError, TypeError, ValueError, AttributeError) as error:
            raise RuntimeError(f"printed {text[-80:]!r}, which is no result") from error
        for way, where in places.items():
            for what, wanted, bound in (("points", self._points, ROUNDING), ("robots", self._robots, STEPPING)):
                if where.shape[1:] != wanted.shape or not np.abs(where - wanted).max() <= bound:
                    raise RuntimeError(f"{way}: its points end more than {bound:g} m from {what} under the same law")
        return rates
