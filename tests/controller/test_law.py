"""The control law against the paper's equations, against the error dynamics, and with look-ahead against its definition."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import block_diag
from scipy.optimize import root

from echelon.controller.laws.central import CentralLaw
from echelon.controller.laws.in_tree import BlockGains
from echelon.controller.potential import PairForces, pairs_between
from echelon.plan.plan import Array, AvoidancePlan, Plan
from echelon.sim.parts.loading import load
from support.synthetic import PAPER
from support.trees import PAPER_TREE, plan_of, random_epsilon, random_law, scenario, trees, with_random_gains

SETTINGS = settings(derandomize=True, deadline=None, max_examples=25)
SEEDS = st.integers(0, 2**32 - 1)
EPSILON = (0.5, 0.4, 0.7, 0.6)


def paper_like(seed: int, time_scales: str, **tables) -> tuple[dict, Plan]:
    """Returns the table `[law]` and a plan of three groups of three robots; all gains and couplings are full matrices."""
    random = np.random.default_rng(seed)
    law = random_law(PAPER_TREE, random, time_scales)
    law["epsilon"] = list(EPSILON[:2] if time_scales == "three" else EPSILON)
    plan = plan_of(scenario(PAPER_TREE, random, law=law, **tables))
    return law, replace(plan, lead=0.0)


def errors(plan: Plan, t: float, x: Array, v: Array) -> tuple[list[Array], list[Array], Array]:
    """Returns the errors of Z_1, Z_2, Z_3, Z_r and z_c, their rates, and z̈_cd, written out for nine robots."""

    def shape(a, b, c):
        return np.array([(a - b) / np.sqrt(2), c - (a + b) / 2])

    def z(p):
        groups = [shape(*p[first : first + 3]) for first in (0, 3, 6)]
        means = [p[first : first + 3].mean(axis=0) for first in (0, 3, 6)]
        return [*groups, shape(*means), p.mean(axis=0)]

    wanted = [shape(*np.array(node.shape.points)) for node in plan.nodes]
    z_cd = np.array([t, 30 * np.sin(0.1 * t)]), np.array([1, 3 * np.cos(0.1 * t)])
    e = [(a - b).ravel() for a, b in zip(z(x), [*wanted, z_cd[0]], strict=True)]
    e_dot = [(a - b).ravel() for a, b in zip(z(v), [0, 0, 0, 0, z_cd[1]], strict=True)]
    return e, e_dot, np.array([0, -0.3 * np.sin(0.1 * t)])


def literal_nu(law: dict, sigma: list[float], e: list[Array], e_dot: list[Array], feed: Array) -> list[Array]:
    """Returns ν of every block (label eqnus), with the matrices of the table `[law]`."""
    names = ["g0", "g1", "g2", "inter", "centroid"]
    gains = {rule["block"]: (np.array(rule["k1"]), np.array(rule["k2"])) for rule in law["gains"]}
    coupling = {(rule["block"], rule["onto"]): np.array(rule["value"]) for rule in law["coupling"]}
    nu = []
    for b, name in enumerate(names):
        k_f1, k_f2 = gains[name]
        value = -k_f1 / sigma[b] ** 2 @ e[b] - k_f2 / sigma[b] @ e_dot[b]
        for other, onto in enumerate(names):
            if other != b:
                value = value - coupling[name, onto] @ e_dot[other]
        nu.append(value + (feed if name == "centroid" else 0))
    return nu


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("time_scales", ["three", "multi"])
def test_nu_is_the_law_of_the_paper(time_scales, seed):
    law, plan = paper_like(seed, time_scales)
    e1, e2, e3, e4 = EPSILON
    sigma = {"three": [e1 * e2] * 3 + [e1, 1], "multi": [e1 * e2 * e3 * e4, e1 * e2 * e3, e1 * e2, e1, 1]}[time_scales]
    random = np.random.default_rng(100 + seed)
    t, x, v = 3.7, random.normal(size=(9, 2), scale=9), random.normal(size=(9, 2), scale=5)
    central = CentralLaw(plan)
    nu = central.transformation.forward(central(t, x, v)).ravel()
    expected = literal_nu(law, sigma, *errors(plan, t, x, v))
    np.testing.assert_allclose(nu, np.concatenate(expected), rtol=1e-11, atol=1e-10)


def test_all_ones_couplings_of_the_paper():
    """With three time scales K̄_sr, K̄_sc, K̄_rs, K̄_rc, K̄_cs and K̄_cr are all ones; within Z_s there is no coupling."""
    _, plan = load(PAPER)
    s, r, c = 12, 4, 2
    ones = np.block(
        [
            [np.zeros((s, s)), np.ones((s, r)), np.ones((s, c))],
            [np.ones((r, s)), np.zeros((r, r)), np.ones((r, c))],
            [np.ones((c, s)), np.ones((c, r)), np.zeros((c, c))],
        ]
    )
    np.testing.assert_array_equal(plan.coupling, ones)
    assert [block.sigma for block in plan.blocks] == pytest.approx([0.01, 0.01, 0.01, 0.1, 1.0])


def slope(plan: Plan) -> Array:
    """Returns the matrix A of d(e, ė)/dt = A (e, ė) for Z̈ = ν, from the law's answers to unit errors, (4N, 4N)."""
    central = CentralLaw(plan)
    cbt, size = central.transformation, 2 * len(plan.robots)
    z_cd = central.trajectory.at(0.0)
    at_rest = cbt.backward(cbt.desired(z_cd[0]))
    moving = cbt.backward(np.vstack([np.zeros((len(plan.robots) - 1, 2)), z_cd[1]]))
    feed = cbt.forward(central(0.0, at_rest, moving)).ravel()
    a = np.zeros((2 * size, 2 * size))
    a[:size, size:] = np.eye(size)
    for column in range(size):
        unit = cbt.backward(np.eye(size)[column].reshape(-1, 2))
        a[size:, column] = cbt.forward(central(0.0, at_rest + unit, moving)).ravel() - feed
        a[size:, size + column] = cbt.forward(central(0.0, at_rest, moving + unit)).ravel() - feed
    return a


@SETTINGS
@given(trees(max_robots=9), SEEDS, st.sampled_from(["three", "multi"]))
def test_error_dynamics_are_linear_with_the_spectrum_of_their_matrices(tree, seed, time_scales):
    """Labels eq45 and eq207: ë = -K_1 e - (K_2 + K̄) ė for all blocks at once."""
    random = np.random.default_rng(seed)
    law = random_epsilon(tree, random, time_scales)
    plan = with_random_gains(plan_of(scenario(tree, random, law=law)), random)
    k_1 = block_diag(*[block.k1 / block.sigma**2 for block in plan.blocks])
    k_2 = block_diag(*[block.k2 / block.sigma for block in plan.blocks]) + plan.coupling
    size = len(k_1)
    expected = np.block([[np.zeros((size, size)), np.eye(size)], [-k_1, -k_2]])
    found = slope(plan)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    # The spectrum in two ways: the eigenvalues of the companion matrix make s² I + s K_2 + K_1 singular.
    for s in np.linalg.eigvals(found):
        pencil = s**2 * np.eye(size) + s * k_2 + k_1
        singular = np.linalg.svd(pencil, compute_uv=False)
        assert singular[-1] < 1e-7 * singular[0]
    # Superposition: the answer to a linear combination is the linear combination of the answers.
    central, n = CentralLaw(plan), len(plan.robots)
    one, two, three, four = random.normal(size=(4, n, 2))
    zero = central(0.0, one * 0, one * 0)
    mixed = central(0.0, 2 * one - 3 * two, 2 * three - 3 * four) - zero
    parts = 2 * (central(0.0, one, three) - zero) - 3 * (central(0.0, two, four) - zero)
    np.testing.assert_allclose(mixed, parts, atol=1e-9 * (1 + np.abs(parts).max()))


def test_uncoupled_spectrum_is_known():
    """With K_f1 = K_f2 = 1 each block has the eigenvalues (-1 ± i √3)/(2 σ), and no others."""
    random = np.random.default_rng(3)
    plan = plan_of(scenario(PAPER_TREE, random, law={"epsilon": [0.1, 0.2]}))
    expected = np.concatenate(
        [np.repeat([(-1 + 1j * np.sqrt(3)) / (2 * s), (-1 - 1j * np.sqrt(3)) / (2 * s)], n)
         for s, n in ((0.02, 12), (0.1, 4), (1.0, 2))]
    )  # fmt: skip
    found = np.linalg.eigvals(slope(plan))
    order = [np.lexsort((np.round(a.imag, 6), np.round(a.real, 6))) for a in (found, expected)]
    np.testing.assert_allclose(found[order[0]], expected[order[1]], rtol=1e-5)


@pytest.mark.parametrize("lead", [0.25, 0.5, 1.0])
@pytest.mark.parametrize("seed", range(3))
def test_lead_is_the_law_taken_at_the_error_to_come(seed, lead):
    """η solves its implicit equation: it is the paper's law for e(λT), with ė(λT) in the block's own damping, both under η."""
    law, plan = paper_like(seed, "three")
    law["epsilon"] = [0.1, 0.1]
    random = np.random.default_rng(seed)
    plan = replace(plan_of(scenario(PAPER_TREE, random, law=law)), lead=lead)
    e, e_dot = random.normal(size=(2, 18))
    ahead = lead * 0.001
    for block in plan.blocks:
        rows = slice(block.offset, block.offset + block.size)
        others = plan.coupling[rows] @ e_dot

        def implicit(eta, block=block, rows=rows, others=others):
            e_ahead = e[rows] + ahead * e_dot[rows] + ahead**2 / 2 * eta
            e_dot_ahead = e_dot[rows] + ahead * eta
            return eta + block.k1 / block.sigma**2 @ e_ahead + block.k2 / block.sigma @ e_dot_ahead + others

        solved = root(implicit, np.zeros(block.size), tol=1e-13).x
        gains = BlockGains.of(plan, block)
        found = -gains.K_1 @ e[rows] - gains.K_2 @ e_dot[rows] - gains.K_coupling @ e_dot
        np.testing.assert_allclose(found, solved, rtol=1e-8, atol=1e-9)


def test_lead_zero_is_the_law_without_look_ahead():
    _, plan = paper_like(1, "multi")
    for block in plan.blocks:
        gains = BlockGains.of(replace(plan, lead=0.0), block)
        np.testing.assert_allclose(gains.K_1, block.k1 / block.sigma**2, rtol=1e-14)
        np.testing.assert_allclose(gains.K_2, block.k2 / block.sigma, rtol=1e-14)
        np.testing.assert_array_equal(gains.K_coupling, plan.coupling[block.offset : block.offset + block.size])
        np.testing.assert_allclose(gains.K_pot, np.eye(block.size) / block.sigma, rtol=1e-14, atol=1e-14)


def test_lead_takes_each_nodes_own_period():
    random = np.random.default_rng(1)
    table = scenario(((None, None), (None, None)), random, duration=0.02, law={"epsilon": [0.5, 0.5], "lead": 0.5})
    table["formation"]["period"] = 0.02
    plan = plan_of(table)
    expected = [(0.001, 16, 4), (0.001, 16, 4), (0.02, 4, 2), (0.02, 1, 1)]
    for block, (period, k_1, k_2) in zip(plan.blocks, expected, strict=True):
        m = 1 / (1 + period / 2 * k_2 + (period / 2) ** 2 / 2 * k_1)
        np.testing.assert_allclose(BlockGains.of(plan, block).K_1, m * k_1 * np.eye(2), rtol=1e-12)


def with_avoidance(plan: Plan) -> Plan:
    return replace(plan, avoidance=AvoidancePlan(True, 0.3, 4.0, 50.0))


def test_avoidance_repels_and_leaves_the_centroid_alone():
    _, bare = paper_like(2, "three")
    bare = replace(bare, coupling=0 * bare.coupling)
    plan, random = with_avoidance(bare), np.random.default_rng(3)
    x, v = random.uniform(-3, 3, (9, 2)), random.normal(size=(9, 2))
    cbt = CentralLaw(plan).transformation
    more = cbt.forward(CentralLaw(plan)(0.0, x, v) - CentralLaw(bare)(0.0, x, v))
    forces = PairForces(*pairs_between([range(i, i + 1) for i in range(9)]), 9, plan.avoidance)(x)
    f_pot = cbt.matrix @ forces
    for block in plan.blocks:  # label pbc3t with the sign corrected: + k_b F_pot,b
        rows = slice(block.offset // 2, (block.offset + block.size) // 2)
        np.testing.assert_allclose(more[rows], f_pot[rows] / block.sigma, rtol=1e-9, atol=1e-9)
    assert np.abs(f_pot).max() > 1
    np.testing.assert_allclose(f_pot[-1], 0, atol=1e-12)
    np.testing.assert_allclose(more[-1], 0, atol=1e-9)


def test_a_pair_that_meets_is_driven_apart():
    """Two robots of a group are close to each other, all others are at rest in their places: the two are pushed apart."""
    _, bare = paper_like(4, "three")
    plan = with_avoidance(bare)
    cbt = CentralLaw(plan).transformation
    x = cbt.backward(cbt.desired(np.array([0.0, 0.0]))) + np.arange(9)[:, None] // 3 * 50.0
    x[1] = x[0] + (0.4, 0.0)
    v = np.zeros((9, 2))
    apart = [law(0.0, x, v)[1, 0] - law(0.0, x, v)[0, 0] for law in (CentralLaw(bare), CentralLaw(plan))]
    force = 50.0 / np.prod(EPSILON[:2])  # the force is capped, and its gain is 1/σ
    assert apart[1] - apart[0] == pytest.approx(2 * force, rel=0.5)
