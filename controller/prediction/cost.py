"""The expected cost of a run with losses (docs/architecture.md, 2.11): the integral of each block's squared error.

    J_b = E ∫ |e_b|² dt,   by the trapezoidal rule over hyperperiods H:   H (Σ_n tr(W_b X_n) - tr(W_b X_0)/2)

with |e_b|² = xᵀ W_b x, and X_n the second moment after n hyperperiods.  The sum to infinity is the solution S of S = L(S) + X.
Under white noise in the accelerations errors do not vanish: then X = L(X) + Q, with what the noise of intensity q adds in a
hyperperiod, for each robot and axis

    q [[H³/3, H²/2], [H²/2, H]]    in (position, velocity)

JitterTime and Jitterbug compute the same kinds of cost for one loop.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np

from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.linear_run import lags
from echelon.controller.prediction.mean_square import Losses, of_bursts
from echelon.controller.prediction.random_branches import mean, moment
from echelon.controller.prediction.random_delays import varies
from echelon.controller.prediction.random_run import Part
from echelon.controller.prediction.random_steps import Chances
from echelon.controller.prediction.second_moment import SecondMoment
from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import Transformation
from echelon.messages import Channel
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, Plan

LONGEST: Final = 4000
"""Longest wait that is looked at [hyperperiods]"""
NEGLIGIBLE: Final = 1e-9
"""Probability of longer waits that are left out"""
_UP = (Channel.STATE, Channel.GROUP_STATE)


@dataclass(frozen=True, slots=True)
class BlockCost:
    """The expected squared error of one block."""

    name: str
    value: float
    """Over a run: J_b [m² s]; under noise: the mean of |e_b|² [m²]"""
    share: float
    """Its share of the sum over all blocks"""


@dataclass(frozen=True, slots=True)
class Cost:
    """Expected squared errors of a plan."""

    blocks: tuple[BlockCost, ...]
    total: float
    """Sum over the blocks"""

    @classmethod
    def of(cls, plan: Plan, values: Array) -> "Cost":
        """Returns the cost with the values of the plan's blocks, in their order."""
        total = float(values.sum())
        shares = values / total if total > 0 else values
        return cls(
            tuple(
                BlockCost(block.name, float(value), float(share))
                for block, value, share in zip(plan.blocks, values, shares, strict=True)
                if block.size
            ),
            total,
        )


def expected_cost(plan: Plan) -> Cost | None:
    """Returns the expected cost of a plan from the start that the scenario has until all errors have vanished, with its losses;
    None if errors do not vanish in the mean square.

    Raises PredictionError if nothing exact can be said of the plan."""
    if lags(plan):
        raise PredictionError(
            'with law.reference = "now" and late states errors of a moving formation do not vanish: their cost has no limit'
        )
    losses = Losses(plan, (), None)
    if losses.gain(0.0) >= 1:
        return None
    run, waits = losses.run, waiting(plan)
    chances = losses.chances(0.0)
    pi = chances.stationary()[:, None, None]
    starts = [registers_at_rest(losses, tick) for tick in range(len(waits))]
    longer = 1 - np.cumsum(waits)  # probability that the wait is longer than n hyperperiods
    # The wait ends with a hyperperiod in which all comes, or with one in which only what was missing comes.
    up = np.array([link.channel in _UP for link in plan.links])
    all_come = np.concatenate(([1.0], longer[:-1])) * float(np.prod(1 - chances.losses[up])) * (waits > 0)
    in_bursts = any(link.bursts and link.channel in _UP for link in plan.links)
    ends = [
        (
            shares,
            Chances(np.where(up, loss, chances.losses), _certain(chances.chain, loss) if in_bursts else chances.chain),
        )
        for shares, loss in ((all_come, 0.0), (np.maximum(waits - all_come, 0.0), 1.0))
    ]

    def of_part(part: Part) -> Array:
        rests = [np.outer(x[part.registers], x[part.registers]) for x in starts]
        before = rests[0] / 2 + sum(share * rest for share, rest in zip(longer[:-1], rests[1:], strict=True))
        after = np.zeros((chances.modes, *rests[0].shape))
        for shares, first in ends:
            X = sum(share * rest for share, rest in zip(shares, rests, strict=True))
            after += moment(part.steps, pi * X, first)
        return np.asarray(before + SecondMoment(part, chances).sum(after).sum(axis=0))

    return Cost.of(plan, run.hyperperiod_ns * 1e-9 * _weighted(plan, losses, of_part))


def steady_cost(plan: Plan, intensity: float) -> Cost | None:
    """Returns the mean squared errors that a plan keeps, with its losses, under white noise in the accelerations of all robots;
    None if they grow.  `intensity` is that of the noise for each axis [m²/s³].

    Raises PredictionError if nothing exact can be said of the plan, ValueError if the intensity is negative."""
    if not intensity >= 0:
        raise ValueError(f"intensity {intensity}: must not be negative")
    losses = Losses(plan, (), None)
    if losses.gain(0.0) >= 1:
        return None
    run, H = losses.run, losses.run.hyperperiod_ns * 1e-9
    units, count = run.registers.units, run.registers.count
    Q = np.zeros((count, count))
    for number in range(len(plan.robots)):
        own = run.registers.memory(number)
        Q[np.ix_(own, own)] = intensity * np.kron([[H**3 / 3, H**2 / 2], [H**2 / 2, H]], np.eye(2))
    Q *= np.outer(units, units)
    chances = losses.chances(0.0)

    def of_part(part: Part) -> Array:
        at = part.registers
        added = chances.stationary()[:, None, None] * Q[np.ix_(at, at)]
        return np.asarray(SecondMoment(part, chances).sum(added).sum(axis=0))

    return Cost.of(plan, _weighted(plan, losses, of_part))


def waiting(plan: Plan) -> Array:
    """Returns the probabilities that robots stay at rest for 0, 1, 2, .. hyperperiods: until the coordinator has heard, through
    all nodes between, of every robot.  Until then nodes know nothing to command.

    Raises PredictionError if delays on the way up vary, or if periods differ and this takes time."""
    links = {(link.source, link.receiver): link for link in plan.links if link.channel in _UP}
    if any(map(varies, links.values())):
        raise PredictionError("the cost of a run from its start is computed for states whose delays do not vary")
    if all(link.ideal for link in links.values()):
        return np.ones(1)
    T_ns = plan.root.period_ns
    if any(each.period_ns != T_ns for each in plan.formation):
        raise PredictionError("the cost of late or lost states is computed where all acceleration periods are equal")
    times = np.arange(LONGEST)
    of_node: dict[int, Array] = {}
    for node in plan.nodes:
        heard = np.ones(LONGEST)  # probability that the node has heard of all children by each tick
        for child in node.children:
            link = links[child, node.index]
            late = -(-link.delay_min_ns // T_ns) if not node.event_driven else link.delay_min_ns // T_ns
            tries = times - late + 1
            comes = np.where(tries > 0, 1 - _none_of(link, LONGEST)[np.maximum(tries, 0)], 0.0)
            known = np.diff(of_node[child], prepend=0.0) if child in of_node else np.eye(1, LONGEST)[0]
            heard *= np.convolve(known, comes)[:LONGEST]
        of_node[node.index] = heard
    found = np.diff(of_node[plan.root.index], prepend=0.0)
    return np.asarray(found[: int(np.argmax(np.cumsum(found) > 1 - NEGLIGIBLE)) + 1])


def _none_of(link: LinkPlan, most: int) -> Array:
    """Returns the probabilities that none of 0, 1, .. `most` messages comes, (most + 1,)."""
    if link.bursts is None:
        return np.asarray(link.loss ** np.arange(most + 1))
    chain, found = of_bursts(link), np.ones(most + 1)
    modes = Chances.of(np.zeros(0), chain).stationary()
    for count in range(1, most + 1):
        modes = modes @ chain[-1]
        found[count] = modes.sum()
    return found


def _certain(chain: Array, loss: float) -> Array:
    """Returns a chain whose message comes for certain, or is lost for certain."""
    step = chain.sum(axis=0)
    return np.stack([(1 - loss) * step, loss * step])


def registers_at_rest(losses: Losses, tick: int) -> Array:
    """Returns the registers after some hyperperiods in which robots rested where they start and states came."""
    run, plan = losses.run, losses.run.plan
    rest = np.zeros(run.registers.count)
    down = np.zeros(run.registers.count, dtype=bool)
    for number, motion in enumerate(_start(plan, tick * run.hyperperiod_ns * 1e-9)):
        rest[run.registers.memory(number)] = motion
    rest *= run.registers.units
    own = np.concatenate([run.registers.memory(number) for number in range(len(run.registers.roles))])
    down[run.registers.commanded()] = True
    x, always = rest, losses.chances(0.0).without_loss()
    for _ in range(run.registers.oldest):
        x = mean(run.steps, np.tile(x[None, :, None] / always.modes, (always.modes, 1, 1)), always).sum(axis=0)[:, 0]
        x = np.where(down, 0.0, x)
        x[own] = rest[own]
    return np.asarray(x)


def _start(plan: Plan, t: float) -> Array:
    """Returns (x, y, vx, vy) of robots that rest where they start, relative to the desired motion at t, (robots, 4)."""
    transformation = Transformation(plan)
    z_cd, rate = make_trajectory(plan.trajectory).at(t)[:2]
    p = np.array([robot.start for robot in plan.robots]) - transformation.backward(transformation.desired(z_cd))
    return np.hstack((p, np.tile(-rate, (len(p), 1))))


def block_rows(plan: Plan, losses: Losses) -> Array:
    """Returns the errors of all blocks as rows over the registers, (2 robots, registers)."""
    robots, count = len(plan.robots), losses.run.registers.count
    places = np.concatenate([losses.run.registers.memory(number)[:2] for number in range(robots)])
    unit = np.eye(2 * robots).reshape(2 * robots, robots, 2)
    transformation = Transformation(plan)
    phi = np.stack([transformation.forward(each).ravel() for each in unit], axis=1)
    rows = np.zeros((2 * robots, count))
    rows[:, places] = phi
    return rows


def _weighted(plan: Plan, losses: Losses, of_part: Callable[[Part], Array]) -> Array:
    """Returns tr(W_b X) of each block, with the X of each part."""
    rows, values = block_rows(plan, losses), np.zeros(len(plan.blocks))
    for part in losses.parts:
        X, own = of_part(part), rows[:, part.registers]
        squares = np.einsum("ia,ab,ib->i", own, X, own)
        values += [squares[block.offset : block.offset + block.size].sum() for block in plan.blocks]
    return values
