"""Points of VMAS under the law of all blocks: `python -O -m bench.peers.vmas_points < law.json` prints rates and places.

The input is that of `bench.vmas.law_of`, with `processes` and the number of `environments` in each.  One environment is one
run of the plan.  Every robot is a holonomic point: no wheels, no drag, no collisions, no sensors, no limits.  Three ways are
measured:

- `env.step`: the law gives the actions of a step, as a policy would; observations and rewards are empty,
- `world.step`: the law sets the points' forces, and the physics of VMAS is called directly,
- `points alone`: the same without a law.

All is float32, without gradients.  `-O` takes out VMAS's checks of shapes and ranges, which are assertions.  Each process has
one thread: PyTorch divides hardly any tensor of this size, and with a second thread one process was no faster.
"""

from __future__ import annotations

import json
import multiprocessing
import sys
import time
from collections.abc import Callable
from importlib.metadata import version
from multiprocessing.connection import Connection
from multiprocessing.synchronize import Barrier
from typing import Any

import torch
from vmas.simulator.core import Agent, World
from vmas.simulator.environment import Environment
from vmas.simulator.scenario import BaseScenario

WARM_UP = 10  # steps before those that are measured
TIMEOUT_S = 60.0  # for which a process waits for the others
LARGEST_FORCE = 1e6  # [N]; actions have a range in VMAS, forces have none


class Points(BaseScenario):
    """The robots of a plan as points, at their starts."""

    def make_world(self, batch_dim: int, device: torch.device, **kwargs: Any) -> World:
        """Returns a world with one point for each robot."""
        self._start = torch.tensor(kwargs["start"])
        self._empty, self._zero = torch.empty(batch_dim, 0), torch.zeros(batch_dim)
        world = World(batch_dim, device, dt=kwargs["period_s"], substeps=1, drag=0.0)
        for number in range(len(self._start)):
            point = Agent(
                f"r{number + 1}", mass=kwargs["mass"], collide=False, rotatable=False, drag=0.0, u_range=LARGEST_FORCE
            )
            world.add_agent(point)
        return world

    def reset_world_at(self, env_index: int | None = None) -> None:
        """Puts all points at their starts, at rest."""
        for point, start in zip(self.world.agents, self._start, strict=True):
            point.set_pos(start, batch_index=env_index)

    def observation(self, agent: Agent) -> torch.Tensor:
        """Returns an empty observation."""
        return self._empty

    def reward(self, agent: Agent) -> torch.Tensor:
        """Returns zero."""
        return self._zero


class Law:
    """Forces of all points from their positions and velocities, in all environments at once."""

    def __init__(self, given: dict[str, Any], environments: int) -> None:
        matrix, moving = torch.tensor(given["matrix"]), torch.tensor(given["moving"])
        # what depends on time alone is two more columns, which act on the unit vectors
        self._matrices = torch.cat([matrix.expand(len(moving), *matrix.shape), moving], dim=2)
        self._units = [torch.tensor(unit).repeat(environments, 1) for unit in ([1.0, 0.0], [0.0, 1.0])]
        self._apart, self._push = torch.tensor(given["apart"]), torch.tensor(given["push"])
        self._sensing, self._avoidance = given["sensing_radius"] ** 2, given["avoidance_radius"] ** 2
        self._limit = given["force_limit"]

    def __call__(self, step: int, points: list[Agent]) -> torch.Tensor:
        """Returns the forces [N], (points, environments, 2)."""
        states = [point.state for point in points]
        given = torch.stack([*(one.pos for one in states), *(one.vel for one in states), *self._units])
        forces = self._matrices[step] @ given.flatten(1)
        places = given[: len(points)]
        if self._nearest(places) < self._sensing:
            apart = (self._apart @ places.flatten(1)).unflatten(1, (-1, 2))
            q = apart.square().sum(-1)
            gap, distance = q - self._avoidance, q.sqrt()
            slope = 4 * distance * (self._sensing - q) * (self._sensing - self._avoidance) / gap**3
            push = torch.where(gap > 0, slope.clamp(max=self._limit), self._limit)
            push = torch.where(q < self._sensing, push, 0.0) / distance.clamp(min=1e-30)
            forces += self._push @ (push.unsqueeze(-1) * apart).flatten(1)
        return forces.unflatten(1, (-1, 2))

    @staticmethod
    def _nearest(places: torch.Tensor) -> float:
        """Returns the square of the smallest distance [m²] of two points of one environment."""
        x, y = (part.contiguous() for part in places.unbind(-1))
        squares = [
            (x[by:] - x[:-by]).square_().add_((y[by:] - y[:-by]).square_()).min() for by in range(1, len(places))
        ]
        return float(torch.stack(squares).min())


def measured(given: dict[str, Any], barrier: Barrier) -> dict[str, tuple[float, list[Any]]]:
    """Returns how long each way takes [s], all processes at once, and the least and largest coordinates of each point at the
    end in all environments [m], 2 × (points, 2)."""
    torch.set_num_threads(1)
    environments, steps = given["environments"], len(given["moving"])
    law = Law(given, environments)
    env = Environment(
        Points(), environments, start=given["start"], mass=given["mass"], period_s=given["period_s"], device="cpu"
    )
    points, world = env.world.agents, env.world

    def env_step(step: int) -> None:
        env.step(list(law(step, points)))

    def world_step(step: int) -> None:
        for point, force in zip(points, law(step, points), strict=True):
            point.state.force = force
        world.step()

    def alone(step: int) -> None:
        world.step()

    ways: dict[str, Callable[[int], None]] = {"env.step": env_step, "world.step": world_step, "points alone": alone}
    found = {}
    for name, act in ways.items():
        for count in (WARM_UP, steps):
            env.reset(return_observations=False)
            barrier.wait(TIMEOUT_S)
            begun_s = time.perf_counter()
            for step in range(count):
                act(step)
            took_s = time.perf_counter() - begun_s
        where = torch.stack([point.state.pos for point in points])
        found[name] = took_s, [where.amin(1).tolist(), where.amax(1).tolist()]
    return found


def work(given: dict[str, Any], barrier: Barrier, results: Connection) -> None:
    """Measures in one of the processes, and sends what it found, or the line that says why it failed."""
    try:
        with torch.inference_mode():
            results.send(measured(given, barrier))
    except Exception as error:
        barrier.abort()
        results.send(f"{type(error).__name__}: {error}")


def main() -> None:
    """Reads the law from standard input, and prints rates [10⁶ steps of a point per second] and places."""
    given = json.load(sys.stdin)
    context = multiprocessing.get_context("fork")
    barrier = context.Barrier(given["processes"])
    pipes = [context.Pipe(duplex=False) for _ in range(given["processes"])]
    for _, results in pipes:
        context.Process(target=work, args=(given, barrier, results), daemon=True).start()
        results.close()
    found = [receiver.recv() for receiver, _ in pipes]
    if why := [one for one in found if isinstance(one, str)]:
        sys.exit(next((one for one in why if not one.startswith("BrokenBarrierError")), why[0]))
    steps = given["processes"] * given["environments"] * len(given["moving"]) * len(given["start"])
    rates = {way: steps / max(one[way][0] for one in found) / 1e6 for way in found[0]}
    places = {way: [where for one in found for where in one[way][1]] for way in found[0]}
    print(json.dumps({"rates": rates, "places": places, "vmas": version("vmas"), "torch": torch.__version__}))


if __name__ == "__main__":
    main()
