"""Largest ε and largest coupling against a second derivation, and Lyapunov bounds that never exceed what is exact."""

from dataclasses import replace
from math import inf, prod

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import eig, solve_continuous_lyapunov

from echelon.controller.prediction.linear_run import LinearRun
from echelon.controller.prediction.lyapunov import lyapunov_bounds
from echelon.controller.prediction.sampled_limits import coupling_limit, epsilon_range
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.controller.prediction.time_scales import (
    epsilon_counts,
    error_dynamics,
    largest_coupling,
    largest_epsilon,
    with_epsilon,
)
from echelon.planning.blocks import make_blocks
from echelon.sim.parts.loading import load
from support.runs import SCENARIOS
from support.trees import plan_of as plan_of_table
from support.trees import random_epsilon, scenario, with_random_gains

TREES = (((None, None), (None, None)), ((None,), (None, None), None), (((None, None), None), (None, None)))


def random_case(tree, seed: int, coupling: float, time_scales: str = "three"):
    """Returns the loop of a random plan with full gains and couplings, and its ε."""
    random = np.random.default_rng(seed)
    law = random_epsilon(tree, random, time_scales)
    law["epsilon"] = [float(each) for each in 10 ** random.uniform(-1.5, 0, len(law["epsilon"]))]
    plan = with_random_gains(plan_of_table(scenario(tree, random, law=law)), random, coupling)
    return plan, error_dynamics(plan, epsilon_counts(plan, time_scales)), law["epsilon"]


def kronecker_sum(matrix: np.ndarray) -> np.ndarray:
    unit = np.eye(len(matrix))
    return np.kron(matrix, unit) + np.kron(unit, matrix)


def exact_roots(fixed: np.ndarray, scaled: np.ndarray) -> np.ndarray:
    """Returns all x > 0 for which fixed + x scaled has two eigenvalues with the sum zero: where it may become unstable.

    det((fixed ⊕ fixed) + x (scaled ⊕ scaled)) = 0 is a generalised eigenvalue problem."""
    values = eig(kronecker_sum(fixed), -kronecker_sum(scaled), right=False)
    real = values[np.isfinite(values) & (np.abs(values.imag) < 1e-7 * np.abs(values))].real
    return np.sort(real[real > 0])


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("tree", TREES[:2])
def test_largest_epsilon_and_coupling_are_the_roots_of_the_kronecker_sum(tree, seed):
    """A second derivation: the abscissa changes its sign only where eigenvalues of a matrix add up to zero."""
    _, loop, epsilon = random_case(tree, seed, 1.5)
    own = loop.A / loop.sigma[:, None]
    for number in (1, 2):
        found = largest_epsilon(loop, epsilon, number) / epsilon[number - 1]
        fast = loop.count >= number
        slow_part, fast_part = np.where(fast[:, None], 0.0, own) + loop.C, np.where(fast[:, None], own, 0.0)
        check_first(found, 1 / exact_roots(slow_part, fast_part)[::-1], lambda by, at=number: loop.abscissa(at, by))
    check_first(largest_coupling(loop), exact_roots(own, loop.C), lambda by: loop.abscissa(coupling=by))


def check_first(found: float, roots: np.ndarray, abscissa) -> None:
    """Checks that `found` is the first of some candidates beyond which the abscissa is positive."""
    crossing = [root for root in roots if 1e-4 < root < 1e4 and abscissa(root * (1 + 1e-5)) > 0]
    if found == 0:
        assert abscissa(1e-4) >= 0
    elif crossing:
        assert found == pytest.approx(crossing[0], rel=1e-6)
    else:
        assert found == inf


@pytest.mark.slow
@settings(derandomize=True, deadline=None, max_examples=60)
@given(
    st.sampled_from(TREES),
    st.integers(0, 2**32 - 1),
    st.sampled_from([0.02, 0.3, 2.0]),
    st.sampled_from(["three", "multi"]),
)
def test_lyapunov_bounds_never_exceed_what_is_exact(tree, seed, coupling, time_scales):
    _, loop, epsilon = random_case(tree, seed, coupling, time_scales)
    for at, bounds in enumerate(lyapunov_bounds(loop, epsilon)):
        exact = largest_epsilon(loop.up_to(at + 1), epsilon, at + 1)
        assert 0 <= bounds.by_norms <= bounds.corrected * (1 + 1e-6)
        assert bounds.corrected <= exact * (1 + 1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_at_the_bound_the_derivative_of_v_loses_its_sign_for_every_d(seed):
    """V̇ from scratch: P A + Aᵀ P of the whole, for many d, just below the bound and just above it."""
    _, loop, epsilon = random_case(TREES[0], seed, 0.7)
    bounds = lyapunov_bounds(loop, epsilon)
    for at in (0, 1):
        part = loop.up_to(at + 1)
        fast = part.count == at + 1
        own = part.A / part.sigma[:, None] + part.C
        P_x, P_f = lyapunov(own[np.ix_(~fast, ~fast)]), lyapunov(part.A[np.ix_(fast, fast)])

        def falls(epsilon_at: float, part=part, fast=fast, P_x=P_x, P_f=P_f, at=at) -> bool:
            sigma = np.where(fast, prod(epsilon[:at]) * epsilon_at, part.sigma)
            A = part.A / sigma[:, None] + part.C
            for log in np.linspace(-12, 12, 1201):
                d = 1 / (1 + np.exp(-log))
                P = np.zeros_like(A)
                P[np.ix_(~fast, ~fast)], P[np.ix_(fast, fast)] = (1 - d) * P_x, d * P_f
                scale = 1 / np.sqrt(np.diag(P))
                if np.linalg.eigvalsh(scale[:, None] * (P @ A + A.T @ P) * scale)[-1] < 0:
                    return True
            return False

        bound = bounds[at].corrected
        assert falls(0.995 * bound)
        assert not falls(1.005 * bound)


def lyapunov(A: np.ndarray) -> np.ndarray:
    return solve_continuous_lyapunov(A.T, -np.eye(len(A)))


def test_the_papers_formula_is_computed_as_it_is_printed():
    """(be1) for the paper's scenario, with determinants of the matrices written out, over a fine grid of d."""
    scenario_, plan = load(SCENARIOS / "paper.toml", [])
    loop = error_dynamics(plan, epsilon_counts(plan, "three"))
    of_r, of_c = np.flatnonzero(loop.count == 1), np.flatnonzero(loop.count == 0)
    A_rc, P_r = loop.C[np.ix_(of_r, of_c)], lyapunov(loop.A[np.ix_(of_r, of_r)])
    values = []
    for d in np.linspace(0, 1, 4002)[1:-1]:
        A, B, C = (1 - d) * np.eye(4), -d * A_rc.T @ P_r, d * np.eye(len(of_r))
        schur = C - B.T @ np.linalg.inv(A) @ B
        if np.linalg.eigvalsh(schur)[0] > 0:
            values.append(np.linalg.det(A) * np.linalg.det(schur))
    assert lyapunov_bounds(loop, scenario_.law.epsilon)[0].literal == pytest.approx(max(values), rel=1e-4)


def test_epsilon_of_the_paper():
    scenario_, plan = load(SCENARIOS / "paper.toml", [])
    epsilon = scenario_.law.epsilon
    loop = error_dynamics(plan, epsilon_counts(plan, "three"))
    assert [largest_epsilon(loop, epsilon, at) for at in (1, 2)] == pytest.approx([0.3121402, 1.8858372], rel=1e-6)
    first, second = lyapunov_bounds(loop, epsilon)
    assert first.corrected == pytest.approx(0.027864, rel=1e-4)
    assert second.corrected == pytest.approx(0.059340, rel=1e-4)
    assert largest_coupling(loop) == pytest.approx(3.3367546, rel=1e-6)


def test_without_coupling_every_epsilon_is_stable():
    _, plan = load(SCENARIOS / "lab.toml", [])
    loop = error_dynamics(plan, epsilon_counts(plan, "three"))
    assert largest_epsilon(loop, [0.5, 0.5], 1) == largest_coupling(loop) == inf
    assert lyapunov_bounds(loop, [0.5, 0.5])[1].corrected == inf


@pytest.mark.parametrize("name", ["paper", "multi", "three_levels"])
def test_time_scales_are_multiplied_as_planning_does(name):
    scenario_, plan = load(SCENARIOS / f"{name}.toml", [])
    changed = [0.9 * each for each in scenario_.law.epsilon]
    counts = epsilon_counts(plan, scenario_.law.time_scales)
    law = scenario_.law.model_copy(update={"epsilon": changed})
    expected = [block.sigma for block in make_blocks(law, plan.nodes)]
    assert [block.sigma for block in with_epsilon(plan, counts, changed).blocks] == pytest.approx(expected)


def test_the_sampled_limits_are_where_the_map_becomes_unstable():
    scenario_, plan = load(SCENARIOS / "paper.toml", [])
    epsilon, counts = scenario_.law.epsilon, epsilon_counts(plan, "three")

    def radius(changed: list[float], coupling: float = 1.0) -> float:
        late = replace(with_epsilon(plan, counts, changed), coupling=coupling * plan.coupling)
        return spectral_radius(LinearRun(late).map())

    low, high = epsilon_range(plan, counts, epsilon, 1)
    assert high == pytest.approx(0.31214, rel=2e-3)  # the period is short, so it is that of continuous time
    for edge, outwards in ((low, 0.999), (high, 1.001)):
        assert radius([edge, 0.1]) < 1 < radius([edge * outwards, 0.1])
    limit = coupling_limit(plan)
    assert radius(list(epsilon), limit) < 1 < radius(list(epsilon), 1.001 * limit)


def test_fast_blocks_do_not_overflow():
    plan, _, epsilon = random_case(TREES[0], 3, 0.5)
    counts, fast = epsilon_counts(plan, "three"), [1e-6 for _ in epsilon]
    tiny = error_dynamics(with_epsilon(plan, counts, fast), counts)
    assert np.isfinite(tiny.abscissa())
    assert largest_epsilon(tiny, fast, 2) > 1e-6
