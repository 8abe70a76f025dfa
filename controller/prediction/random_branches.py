"""Sequences of steps of a linear run with random links, and the steps that branch into one sequence or another
(docs/architecture.md, 2.11).

    step      x⁺                                                   X⁺
    --------  ---------------------------------------------------  -------------------------------------------------
    Window    if all of its messages come, `early`, else `late`    late(all) - late(came) + early(came)
    Either    if its message comes, `comes`, else `lost`           (1 - p) comes(X) + p lost(X); of a chain for each mode

Each is a step, too (`random_steps.Step`).
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.random import Generator
from scipy.sparse import csr_array, eye_array

from echelon.controller.prediction.random_steps import Bits, Chances, Indices, Linear, Step, prune
from echelon.plan.plan import Array


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """The period of event-driven nodes: `up` are the steps until all that is waited for has come; if it comes, `early` follows,
    else `late`.  `came` are the steps of `up` as far as all messages come."""

    up: tuple[Step, ...]
    came: tuple[Step, ...]
    early: tuple[Step, ...]
    late: tuple[Step, ...]

    def needs(self, live: Bits) -> Bits:
        return needs(self.up, needs(self.early, live) | needs(self.late, live))

    def edges(self) -> Iterable[tuple[Indices, Indices]]:
        for part in (self.up, self.early, self.late):
            for step in part:
                yield from step.edges()

    def cut(self, live: Bits) -> tuple[list[Step], Bits]:
        middle = needs(self.early, live) | needs(self.late, live)
        before = needs(self.up, middle)
        early, late = (forced(part, middle, live) for part in (self.early, self.late))
        up, came = (forced(part, before, middle) for part in (self.up, self.came))
        return [Window(up, came, early, late)], before

    def moment(self, X: Array, chances: Chances) -> Array:
        came = moment(self.came, X, chances)
        missed = moment(self.up, X, chances) - came
        return moment(self.late, missed, chances) + moment(self.early, came, chances)

    def mean(self, x: Array, chances: Chances) -> Array:
        came = mean(self.came, x, chances)
        missed = mean(self.up, x, chances) - came
        return mean(self.late, missed, chances) + mean(self.early, came, chances)

    def sample(self, x: Array, modes: Indices, chances: Chances, random: Generator) -> tuple[Array, Indices, Bits]:
        x, modes, came = sample(self.up, x, modes, chances, random)
        early, _, _ = sample(self.early, x, modes, chances, random)
        late, _, _ = sample(self.late, x, modes, chances, random)
        return np.where(came, early, late), modes, came


@dataclass(frozen=True, slots=True, eq=False)
class Either:
    """A message of a link that decides about more than its value: if it comes, `comes` follows, else `lost`."""

    kind: int | None
    """The kind of link, which loses each message by itself; None: the Markov chain says, with outcome 0 the message comes"""
    comes: tuple[Step, ...]
    lost: tuple[Step, ...]

    def needs(self, live: Bits) -> Bits:
        return needs(self.comes, live) | needs(self.lost, live)

    def edges(self) -> Iterable[tuple[Indices, Indices]]:
        for part in (self.comes, self.lost):
            for step in part:
                yield from step.edges()

    def cut(self, live: Bits) -> tuple[list[Step], Bits]:
        before = self.needs(live)
        return [Either(self.kind, forced(self.comes, before, live), forced(self.lost, before, live))], before

    def moment(self, X: Array, chances: Chances) -> Array:
        if self.kind is None:
            return moment(self.comes, chances.after(0, X), chances) + moment(self.lost, chances.after(-1, X), chances)
        p = chances.losses[self.kind]
        comes = 0.0 if p == 1 else (1 - p) * moment(self.comes, X, chances)
        return np.asarray(comes if p == 0 else comes + p * moment(self.lost, X, chances))

    def mean(self, x: Array, chances: Chances) -> Array:
        if self.kind is None:
            return mean(self.comes, chances.after(0, x), chances) + mean(self.lost, chances.after(-1, x), chances)
        p = chances.losses[self.kind]
        return np.asarray((1 - p) * mean(self.comes, x, chances) + p * mean(self.lost, x, chances))

    def sample(self, x: Array, modes: Indices, chances: Chances, random: Generator) -> tuple[Array, Indices, Bits]:
        if self.kind is None:
            outcome, modes = chances.draw(modes, random)
            comes = outcome == 0
        else:
            comes = random.random(x.shape[1]) >= chances.losses[self.kind]
        with_it, _, _ = sample(self.comes, x, modes, chances, random)
        without, _, _ = sample(self.lost, x, modes, chances, random)
        return np.where(comes, with_it, without), modes, comes


def needs(steps: Sequence[Step], live: Bits) -> Bits:
    """Returns the registers that matter before steps, if those in `live` matter after them."""
    for step in reversed(steps):
        live = step.needs(live)
    return live


def moment(steps: Sequence[Step], X: Array, chances: Chances) -> Array:
    """Returns the second moments after steps, (modes, registers, registers)."""
    for step in steps:
        X = step.moment(X, chances)
    return X


def mean(steps: Sequence[Step], x: Array, chances: Chances) -> Array:
    """Returns the means of states after steps, (modes, registers, runs)."""
    for step in steps:
        x = step.mean(x, chances)
    return x


def sample(
    steps: Sequence[Step], x: Array, modes: Indices, chances: Chances, random: Generator
) -> tuple[Array, Indices, Bits]:
    """Returns states and modes of runs after steps, and in which runs all messages came."""
    came = np.ones(x.shape[1], dtype=bool)
    for step in steps:
        x, modes, its = step.sample(x, modes, chances, random)
        came &= its
    return x, modes, came


def cut(steps: Sequence[Step], live: Bits) -> tuple[tuple[Step, ...], Bits]:
    """Returns steps for the registers alone that matter, if those in `live` matter at the end, and which matter before them.
    Linear maps that follow each other are multiplied."""
    found: list[Step] = []
    for step in reversed(steps):
        parts, live = step.cut(live)
        found[:0] = parts
    return _multiplied(found), live


def forced(steps: Sequence[Step], before: Bits, after: Bits) -> tuple[Step, ...]:
    """Returns steps that take the registers in `before`, and lead to those in `after`."""
    found, live = cut(steps, after)
    return _multiplied([prune(before, live), *found])


def _multiplied(steps: Sequence[Step]) -> tuple[Step, ...]:
    """Returns steps with linear maps that follow each other multiplied, and maps that change nothing left out."""
    found: list[Step] = []
    for step in steps:
        if isinstance(step, Linear) and found and isinstance(found[-1], Linear):
            found[-1] = Linear(csr_array(step.F @ found[-1].F))
        else:
            found.append(step)
    return tuple(
        Linear.of(step.F) if isinstance(step, Linear) else step
        for step in found
        if not (isinstance(step, Linear) and _is_unit(step.F))
    )


def _is_unit(F: csr_array) -> bool:
    return F.shape[0] == F.shape[1] and csr_array(abs(F - eye_array(F.shape[0], format="csr"))).nnz == 0
