"""Control laws as parts: their arguments, what the tree adds to them, and errors in scenarios and in runs."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from echelon.agents.robot import Robot
from echelon.controller.laws import Block, Law, Linear
from echelon.controller.laws.central import CentralLaw
from echelon.controller.laws.in_tree import NodeBlocks
from echelon.controller.laws.law import law_block, make_nu, make_state, make_weight
from echelon.errors import PartRunError
from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError, effective_toml
from echelon.plugins import Part
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import load, parse
from support.runs import SCENARIOS, plan_of, trace_of
from support.synthetic import claims_of
from support.trees import PAPER_TREE
from support.watched import Watched, random_plan

OWN = """
import numpy as np
from echelon.controller.laws import Law

class Spring(Law):
    uses = {"gains"}
    stiffness: float = 2.0

    def nu(self, block, t, e, e_dot, feed_forward, state):
        return feed_forward - self.stiffness * e / block.sigma**2 - block.K_2 @ e_dot
"""
USE = 'law={use="my_laws.py:Spring",parameters={stiffness=3.0},epsilon=[0.5,0.5]}'


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Returns a user's folder with a scenario and a law."""
    (tmp_path / "mine.toml").write_text((SCENARIOS / "lab.toml").read_text())
    (tmp_path / "my_laws.py").write_text(OWN)
    return tmp_path


def of_another(plan: Plan, law: Law) -> Plan:
    """Returns a plan with another law, which is not built in."""
    return replace(plan, law=Part("my_laws.py:Mine", {}, None, law))


class Same(Linear):
    """The linear law as another class, so that nodes call it block by block and do not multiply it out."""


class Witness(Law):
    """A law that counts its calls and keeps its arguments."""

    def nu(self, block, t, e, e_dot, feed_forward, state):
        state += [1.0, t, *feed_forward[:2]]
        return feed_forward - e

    def state_size(self, block):
        return 4

    def weight(self, block):
        return 3.0 * np.eye(block.size)


@pytest.mark.parametrize("coupling", [0.0, 0.5])
@pytest.mark.parametrize("avoidance", [False, True])
def test_the_linear_law_block_by_block_agrees_with_its_matrices(coupling, avoidance):
    plan = random_plan(PAPER_TREE, 3, "three", coupling, avoidance)
    expected, found = (Watched(one, 3).commanded(0) for one in (plan, of_another(plan, Same())))
    np.testing.assert_allclose(found, expected, rtol=1e-11, atol=1e-11 * np.abs(expected).max())
    assert np.abs(expected).max() > 1


@pytest.mark.parametrize(("name", "linear"), [("lab", True), ("paper", True), ("integral", False), ("sliding", False)])
def test_nodes_multiply_out_the_linear_law_and_no_other(name: str, linear: bool) -> None:
    plan = plan_of(name)
    assert len(plan.nodes) > 1
    assert [NodeBlocks.of(plan, node) is None for node in plan.nodes] == [linear] * len(plan.nodes)


@pytest.mark.parametrize("tree", [PAPER_TREE, ((None,), (None, (None, None)), None)])
def test_a_law_that_is_not_built_in_gives_the_same_in_the_tree_and_centrally(tree):
    """State, weight and time are included.  A group of a single robot has no shape, so the law is not called for it."""
    plan = of_another(random_plan(tree, 5, "multi", 0.5, avoidance=True), Witness())
    central, run = CentralLaw(plan), Watched(plan, 5)
    for time_ns in run.instants:
        states = run.states(time_ns)
        expected = central(time_ns * 1e-9, states[:, :2], states[:, 2:4])
        np.testing.assert_allclose(run.commanded(time_ns), expected, atol=1e-12 * (1 + np.abs(expected).max()))
    calls = len(run.instants)
    assert [state[0] for state in central.states] == [calls if block.size else 0 for block in plan.blocks]
    t = sum(time_ns * 1e-9 for time_ns in run.instants)
    ahead = plan.lead * plan.root.period_ns * 1e-9
    z_ddot = sum(central.trajectory.at(time_ns * 1e-9 + ahead)[2] for time_ns in run.instants)
    np.testing.assert_allclose(central.states[-1], [calls, t, *z_ddot])
    np.testing.assert_allclose(central.states[0], [calls, t, 0, 0] if plan.blocks[0].size else [0] * 4)


def test_the_tree_weighs_coupling_and_avoidance_as_the_law_says():
    bare = random_plan(PAPER_TREE, 4, "three", 0.5, avoidance=True)

    class Light(Witness):
        def weight(self, block):
            return 6.0 * np.eye(block.size)

    class Deaf(Witness):
        def weight(self, block):
            return np.zeros((block.size, block.size))

    deaf, heavy, light = (Watched(of_another(bare, law), 4).commanded(0) for law in (Deaf(), Witness(), Light()))
    np.testing.assert_allclose(light - deaf, 2 * (heavy - deaf), rtol=1e-10, atol=1e-10 * np.abs(light).max())
    assert np.abs(heavy - deaf).max() > 1


def test_a_law_is_not_called_while_the_node_misses_a_message():
    """States take 2 ms.  Until then the node commands nothing, and the state of the law does not change."""
    plan = of_another(random_plan((None, None), 1, "three", 0.0, avoidance=False, duration=0.004), Witness())
    late = tuple(
        replace(link, delay_min_ns=2_000_000, delay_max_ns=2_000_000) if link.source == 0 else link
        for link in plan.links
    )
    engine = Engine(replace(plan, links=late))
    engine.run()
    states = [state for _, _, state in engine.roles[plan.root.index]._blocks._own]
    assert [state[0] for state in states] == [3, 3]  # at 2, 3 and 4 ms
    assert states[0][1] == pytest.approx(0.009)


def test_the_block_that_a_law_gets():
    plan = plan_of("lab", "law.lead=0.25", "formation.period=0.05", 'law.gains=[{k1=2.0,k2=3.0},{block="g2",k1=5.0}]')
    blocks = {block.name: law_block(plan, block) for block in plan.blocks}
    assert [(one.name, one.layer, one.size, one.sigma, one.period_s, one.lead) for one in blocks.values()] == [
        ("g1", "intra", 4, 0.25, 0.01, 0.25),
        ("g2", "intra", 4, 0.25, 0.01, 0.25),
        ("g3", "intra", 4, 0.25, 0.01, 0.25),
        ("inter", "inter", 4, 0.5, 0.05, 0.25),
        ("centroid", "centroid", 2, 1.0, 0.05, 0.25),
    ]
    np.testing.assert_allclose(blocks["g1"].K_1, 32 * np.eye(4))
    np.testing.assert_allclose(blocks["g1"].K_2, 12 * np.eye(4))
    np.testing.assert_allclose(blocks["g2"].K_1, 80 * np.eye(4))
    np.testing.assert_allclose(blocks["inter"].K_2, 6 * np.eye(4))
    assert blocks["inter"].ahead_s == 0.0125
    with pytest.raises(ValueError, match="read-only"):
        blocks["g1"].K_1[0, 0] = 1.0


def test_a_law_from_a_file_moves_robots(folder: Path) -> None:
    _, plan = load(folder / "mine.toml", [USE])
    assert plan.law.made.stiffness == 3.0
    engine = Engine(replace(plan, duration_ns=200_000_000))
    engine.run()
    moved = [role.state for role in engine.roles if isinstance(role, Robot)]
    assert max(abs(state.v) for state in moved) > 0.05
    # A law from a file moves the robots as the built-in law with the same numbers does.
    same = load(folder / "mine.toml", ["law={epsilon=[0.5,0.5],gains=[{k1=3.0}]}"])[1]
    other = Engine(replace(same, duration_ns=200_000_000))
    other.run()
    for one, another in zip(engine.roles, other.roles, strict=True):
        if isinstance(one, Robot):
            np.testing.assert_allclose(one.state, another.state, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("use", [(), ("law.use=integral", "law.parameters.k_i=0.05"), (USE,)])
def test_the_effective_scenario_names_the_law_with_all_parameters(folder: Path, use: tuple[str, ...]) -> None:
    scenario, plan = load(folder / "mine.toml", use)
    text = effective_toml(scenario)
    assert f'use = "{plan.law.use}"' in text
    assert all(f"{name} = {value}" in text for name, value in plan.law.parameters.items())
    again, plan_again = parse(text, "again.toml", folder=folder)
    assert again == scenario
    assert plan_again.law == plan.law
    assert effective_toml(again) == text


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["law.use=integra"], "law.use = 'integra': must be one of 'linear', 'integral', 'terminal_sliding', or"),
        (["law.use=3"], "law.use = 3: must be one of 'linear'"),
        (["law.use=my_laws.py:Spin"], "law.use = 'my_laws.py:Spin': my_laws.py has no class Spin; it has Spring"),
        (["law.use=my_laws.py:Law"], "law.use = 'my_laws.py:Law': my_laws.py:Law lacks the method nu"),
        (["law.use=integral"], "law.parameters.k_i: missing"),
        (["law.use=integral", "law.parameters.k_i=-1.0"], "law.parameters.k_i = -1.0: must be greater than 0"),
        (["law.parameters.k_i=1.0"], "law.parameters.k_i: unknown key; there are none here"),
        (["law.parameters=3"], "law.parameters = 3: must be a table"),
        (["law.use=my_laws.py:Spring", "law.parameters.stiff=1"], "law.parameters.stiff: unknown key; did you mean"),
        (["law.use=terminal_sliding", "law.parameters.gamma=2.0"], "law.parameters.gamma = 2.0: must be less than 2"),
        (
            ["law.use=terminal_sliding"],
            "law.gains: the law 'terminal_sliding' has gains of its own, in law.parameters; leave gains out",
        ),
        (
            ["law.use=my_laws.py:Spring", "law.lead=0.5"],
            "law.lead: the law 'my_laws.py:Spring' does not look ahead; leave lead out",
        ),
        (["law={use='linear',epsilon=[0.5,0.5],leads=0.5}"], "law.leads: unknown key; did you mean 'lead'?"),
    ],
)
def test_mistakes_name_key_value_and_what_is_allowed(folder: Path, overrides: list[str], says: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load(folder / "mine.toml", overrides)
    assert says in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


BLOCK = Block("g1", "intra", 4, 0.5, 0.01, 0.0, 4 * np.eye(4), 2 * np.eye(4))
ZERO = np.zeros(4)


class Faulty(Law):
    """A law that fails in the way that a test chooses."""

    does: str = ""

    def nu(self, block, t, e, e_dot, feed_forward, state):
        return eval(self.does)

    def nu_of(self, block):
        return 1 / 0 if self.does == "nu_of" else super().nu_of(block)

    def state_size(self, block):
        return {"size": -1, "half": 0.5, "raise": []}.get(self.does, 0) if self.does != "oops" else 1 / 0

    def weight(self, block):
        return {"flat": ZERO, "nan": np.full((4, 4), np.nan), "word": "x"}.get(self.does, np.eye(4))


def of_faulty(does: str) -> Part[Law]:
    return Part("my_laws.py:Faulty", {}, None, Faulty(does=does))


@pytest.mark.parametrize(
    ("does", "says"),
    [
        ("1 / 0", "raised ZeroDivisionError: division by zero"),
        ("e[:2]", "has the shape (2,), not (4,)"),
        ("e @ e", "has the shape (), not (4,)"),
        ("None", "returned nothing; it must return 4 numbers"),
        ("'x'", "raised ValueError: could not convert string to float: 'x'"),
        ("e + np.nan", "is not finite: [nan, nan, nan, nan]"),
        ("[0, 0, 0, np.inf]", "is not finite: [0.0, 0.0, 0.0, inf]"),
        ("e.fill(1.0)", "raised ValueError: assignment destination is read-only"),
    ],
)
def test_a_law_that_fails_in_a_run_is_named_with_its_block(does: str, says: str) -> None:
    e = np.ones(4)
    e.flags.writeable = False
    with pytest.raises(PartRunError) as caught:
        make_nu(of_faulty(does), BLOCK)(0.3, e, ZERO, ZERO, ZERO[:0])
    assert str(caught.value).startswith(f"my_laws.py:Faulty of block g1: nu at t = 0.3 s {says}")


@pytest.mark.parametrize(
    ("make", "does", "says"),
    [
        (make_nu, "nu_of", "nu_of raised ZeroDivisionError: division by zero"),
        (make_state, "size", "state_size must be a whole number that is not negative, not -1"),
        (make_state, "half", "state_size must be a whole number that is not negative, not 0.5"),
        (make_state, "raise", "state_size must be a whole number that is not negative, not []"),
        (make_state, "oops", "state_size raised ZeroDivisionError: division by zero"),
        (make_weight, "flat", "weight has the shape (4,), not (4, 4)"),
        (make_weight, "nan", "weight is not finite: [[nan, nan"),
        (make_weight, "word", "weight raised ValueError: could not convert string to float: 'x'"),
    ],
)
def test_other_answers_of_a_law_are_checked(make, does: str, says: str) -> None:
    with pytest.raises(PartRunError) as caught:
        make(of_faulty(does), BLOCK)
    assert str(caught.value).startswith(f"my_laws.py:Faulty of block g1: {says}")


def test_where_the_run_diverged_a_law_may_fail() -> None:
    for lost in (np.full(4, np.nan), np.full(4, 1e200)):
        assert np.isnan(make_nu(of_faulty("1 / 0"), BLOCK)(0.0, lost, ZERO, ZERO, ZERO[:0])).all()
        assert np.isnan(make_nu(of_faulty("e * np.nan"), BLOCK)(0.0, lost, ZERO, ZERO, ZERO[:0])).all()


def test_built_in_laws_are_not_checked() -> None:
    plan = plan_of("lab")
    assert make_nu(plan.law, BLOCK).__module__ == "echelon.controller.laws.linear"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["integral", "sliding"])
def test_shipped_scenarios_of_other_laws_hold(name: str) -> None:
    plan = plan_of(name)
    claims = claims_of(trace_of(plan))
    assert [claim.block for claim in claims] == ["intra", "inter", "centroid"]
    assert all(claim.outcome == "passed" for claim in claims), claims


@pytest.mark.slow
def test_the_linear_law_takes_nine_times_as_long_as_sliding() -> None:
    plan = plan_of("lab", "claims=[{block='intra',settled_by=1.0,band=1e-4},{block='inter',settled_by=1.0,band=1e-4}]")
    intra, inter = (claim.measured for claim in claims_of(trace_of(plan)))
    plan = plan_of("sliding")
    quick = [claim.measured for claim in claims_of(trace_of(plan))]
    assert intra > 8.5 * quick[0]
    assert inter > 8.5 * quick[1]
