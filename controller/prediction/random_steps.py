"""Steps of a linear run with random links: how its state changes, and how the second moment of its state does
(docs/architecture.md, 2.11).

The state x are numbers in *registers*: positions and velocities, messages on their way, and for each link the value in use at
its receiver.  A run is a sequence of steps.  Each takes x, or the second moment X = E[x xᵀ], through a part of a hyperperiod:

    step      x⁺                                                   X⁺
    --------  ---------------------------------------------------  -------------------------------------------------
    Linear    F x                                                  F X Fᵀ
    Choice    each link by itself takes a message, x_d ← x_s,      X̄ + p (1 - p) Δ X Δᵀ for each link, X̄ = C X Cᵀ,
              or loses it, with the probability p                  C = E[x⁺ of x],  Δ = x_d ← x_s - x_d
    Jump      one link whose chances depend on a Markov chain      for each mode: the sum over modes it comes from

Two further steps contain steps (`random_branches`).

Losses of different links are independent, as are the losses of one link at different times; so X⁺ depends on X alone, and is
exact.  With a chain there is an X for each of its modes, E[x xᵀ; mode].
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Protocol, Self

import numpy as np
from numpy.random import Generator
from numpy.typing import NDArray
from scipy.sparse import csr_array, eye_array

from echelon.plan.plan import Array

Bits = NDArray[np.bool_]
Indices = NDArray[np.intp]
DENSE: Final = 0.15
"""Share of numbers that are not zero from which a matrix is multiplied as a dense one"""


@dataclass(frozen=True, slots=True, eq=False)
class Chances:
    """The probabilities of a run."""

    losses: Array
    """Loss of each kind of link, (kinds,)"""
    chain: Array
    """Probabilities of the Markov chain, (outcomes, modes, modes): that mode i is followed by mode j while message number
    `outcome` of a `Jump` is taken; with the last outcome no message is"""

    @classmethod
    def of(cls, losses: Array, chain: Array | None = None) -> Self:
        """Returns chances; without a chain there is one mode."""
        return cls(losses, np.ones((1, 1, 1)) if chain is None else chain)

    @property
    def modes(self) -> int:
        """Number of modes of the chain."""
        return int(self.chain.shape[1])

    def after(self, outcome: int, X: Array) -> Array:
        """Returns moments, or means, by the mode after a step of the chain, as far as it has an outcome; `X` is by the mode
        before."""
        return np.asarray(np.einsum("ij,iab->jab", self.chain[outcome], X))

    def draw(self, modes: Indices, random: Generator) -> tuple[Indices, Indices]:
        """Draws a step of the chain for runs in some modes; returns their outcomes, and the modes that follow."""
        count, outcomes = self.modes, len(self.chain)
        edges = np.cumsum(self.chain.transpose(1, 0, 2).reshape(count, -1), axis=1)[modes]
        drawn = np.minimum((random.random((len(modes), 1)) >= edges).sum(axis=1), outcomes * count - 1)
        return drawn // count, drawn % count

    def without_loss(self) -> Self:
        """Returns the chances with which every message comes; the chain goes on as it does."""
        chain = np.zeros_like(self.chain)
        chain[0] = self.chain.sum(axis=0)
        return type(self)(np.zeros_like(self.losses), chain)

    def stationary(self) -> Array:
        """Returns the stationary probabilities of the modes, (modes,)."""
        step = self.chain.sum(axis=0)
        equations = np.vstack([step.T - np.eye(self.modes), np.ones(self.modes)])
        found = np.linalg.lstsq(equations, np.r_[np.zeros(self.modes), 1.0], rcond=None)[0]
        return np.asarray(found)


class Step(Protocol):
    """A step of a run; registers are numbered from 0 on."""

    def needs(self, live: Bits) -> Bits:
        """Returns the registers that matter before the step, if those in `live` matter after it."""

    def edges(self) -> Iterable[tuple[Indices, Indices]]:
        """Yields pairs of registers of which one acts on the other."""

    def cut(self, live: Bits) -> tuple[list["Step"], Bits]:
        """Returns the step for the registers alone that matter, and which matter before it."""

    def moment(self, X: Array, chances: Chances) -> Array:
        """Returns the second moments after the step; `X` is (modes, registers, registers)."""

    def mean(self, x: Array, chances: Chances) -> Array:
        """Returns the means of states after the step; `x` is (modes, registers, runs)."""

    def sample(self, x: Array, modes: Indices, chances: Chances, random: Generator) -> tuple[Array, Indices, Bits]:
        """Returns the states and modes of runs after the step, and in which runs all messages came; `x` is (registers,
        runs)."""


@dataclass(frozen=True, slots=True, eq=False)
class Linear:
    """A linear map F."""

    F: csr_array
    full: Array | None = None
    """F as a full matrix, if that is faster"""

    @classmethod
    def of(cls, F: csr_array) -> Self:
        """Returns the map in the form that is faster."""
        return cls(F, F.toarray() if F.nnz > DENSE * F.shape[0] * F.shape[1] else None)

    def needs(self, live: Bits) -> Bits:
        found = np.zeros(self.F.shape[1], dtype=bool)
        found[self.F.indices[np.repeat(live, np.diff(self.F.indptr))]] = True
        return found

    def edges(self) -> Iterable[tuple[Indices, Indices]]:
        rows, columns = self.F.nonzero()
        yield rows.astype(np.intp), columns.astype(np.intp)

    def cut(self, live: Bits) -> tuple[list["Step"], Bits]:
        before = self.needs(live)
        return [Linear(csr_array(self.F[live][:, before]))], before

    def moment(self, X: Array, chances: Chances) -> Array:
        if self.full is not None:
            return np.asarray(self.full @ X @ self.full.T)
        return np.stack([(self.F @ (self.F @ each).T).T for each in X])

    def mean(self, x: Array, chances: Chances) -> Array:
        return np.stack([self.F @ each for each in x])

    def sample(self, x: Array, modes: Indices, chances: Chances, random: Generator) -> tuple[Array, Indices, Bits]:
        return self.F @ x, modes, np.ones(x.shape[1], dtype=bool)


@dataclass(frozen=True, slots=True, eq=False)
class Choice:
    """Messages that are lost or not, each by itself.  `dest`, `source` are the registers in use and those of the messages;
    those with the same number in `draw` share their fate.  `kind` are the kinds of link of each draw.

    `came`: X is counted only as far as all messages come."""

    dest: Indices
    source: Indices
    draw: Indices
    kind: Indices
    came: bool = False
    pairs: tuple[Indices, Indices] = (np.zeros(0, dtype=np.intp), np.zeros(0, dtype=np.intp))
    """Pairs of places in `dest` that share their fate"""

    @classmethod
    def of(cls, dest: Indices, source: Indices, draw: Indices, kind: Indices, *, came: bool = False) -> Self:
        """Returns the step."""
        one, other = np.nonzero(draw[:, None] == draw)
        return cls(dest, source, draw, kind, came, (one, other))

    def needs(self, live: Bits) -> Bits:
        found = live.copy()
        found[self.source[live[self.dest]]] = True
        return found

    def edges(self) -> Iterable[tuple[Indices, Indices]]:
        yield self.dest, self.source

    def cut(self, live: Bits) -> tuple[list[Step], Bits]:
        before = self.needs(live)
        number, used = np.cumsum(before) - 1, live[self.dest]
        dest, source = number[self.dest[used]], number[self.source[used]]
        cut = Choice.of(dest, source, self.draw[used], self.kind, came=self.came)
        return [cut, prune(before, live)], before

    def moment(self, X: Array, chances: Chances) -> Array:
        loss = chances.losses[self.kind]
        if self.came:
            X = float(np.prod(1 - loss)) * X
            X[:, self.dest] = X[:, self.source]
            X[:, :, self.dest] = X[:, :, self.source]
            return X
        d, s, p = self.dest, self.source, loss[self.draw]
        found = X.copy()
        found[:, d] = p[:, None] * X[:, d] + (1 - p)[:, None] * X[:, s]
        found[:, :, d] = p * found[:, :, d] + (1 - p) * found[:, :, s]
        i, j = self.pairs
        q = p[i]
        found[:, d[i], d[j]] += (q * (1 - q)) * (
            X[:, s[i], s[j]] - X[:, s[i], d[j]] - X[:, d[i], s[j]] + X[:, d[i], d[j]]
        )
        return found

    def mean(self, x: Array, chances: Chances) -> Array:
        loss = chances.losses[self.kind]
        if self.came:
            found = float(np.prod(1 - loss)) * x
            found[:, self.dest] = found[:, self.source]
            return found
        p, found = loss[self.draw][:, None], x.copy()
        found[:, self.dest] = p * x[:, self.dest] + (1 - p) * x[:, self.source]
        return found

    def sample(self, x: Array, modes: Indices, chances: Chances, random: Generator) -> tuple[Array, Indices, Bits]:
        comes = random.random((len(self.kind), x.shape[1])) >= chances.losses[self.kind][:, None]
        x = x.copy()
        x[self.dest] = np.where(comes[self.draw], x[self.source], x[self.dest])
        return x, modes, np.all(comes, axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class Jump:
    """A step of the Markov chain.  With outcome k the registers `dest` take those of `sources[k]`; with the last outcome, one
    more than there are sources, they keep what they have.

    `came`: X is counted only as far as a message is taken."""

    dest: Indices
    sources: tuple[Indices, ...]
    came: bool = False

    def needs(self, live: Bits) -> Bits:
        found = live.copy()
        for source in self.sources:
            found[source[live[self.dest]]] = True
        return found

    def edges(self) -> Iterable[tuple[Indices, Indices]]:
        for source in self.sources:
            yield self.dest, source

    def cut(self, live: Bits) -> tuple[list[Step], Bits]:
        before = self.needs(live)
        number, used = np.cumsum(before) - 1, live[self.dest]
        cut = Jump(number[self.dest[used]], tuple(number[source[used]] for source in self.sources), self.came)
        return [cut, prune(before, live)], before

    def moment(self, X: Array, chances: Chances) -> Array:
        found = np.zeros_like(X) if self.came else chances.after(-1, X)
        for outcome, source in enumerate(self.sources):
            taken = chances.after(outcome, X)
            taken[:, self.dest] = taken[:, source]
            taken[:, :, self.dest] = taken[:, :, source]
            found += taken
        return found

    def mean(self, x: Array, chances: Chances) -> Array:
        found = np.zeros_like(x) if self.came else chances.after(-1, x)
        for outcome, source in enumerate(self.sources):
            taken = chances.after(outcome, x)
            taken[:, self.dest] = taken[:, source]
            found += taken
        return found

    def sample(self, x: Array, modes: Indices, chances: Chances, random: Generator) -> tuple[Array, Indices, Bits]:
        (outcome, after), x = chances.draw(modes, random), x.copy()
        for number, source in enumerate(self.sources):
            x[self.dest] = np.where(outcome == number, x[source], x[self.dest])
        return x, after, outcome < len(self.sources)


def prune(before: Bits, after: Bits) -> Linear:
    """Returns the step from the registers in `before` to those of them that are in `after`."""
    return Linear(csr_array(eye_array(len(before), format="csr")[after][:, before]))
