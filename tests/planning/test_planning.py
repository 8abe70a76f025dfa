import math
import re
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon import shipped
from echelon.messages import Channel
from echelon.plan.plan import Plan, PlanError
from echelon.planning.loading import ScenarioError
from echelon.planning.members import MAX_ROBOTS, nanoseconds
from echelon.planning.plan_maker import path_matches
from echelon.sim.parts.loading import load, parse
from support.shape_variables import variables

SCENARIOS = shipped.FOLDER
HEAD = """
name = "t"
duration = 1.0
trajectory = { kind = "line", velocity = [1.0, 0.0] }
robot = { mass = 10.0, inertia = 0.5, wheel_radius = 0.1, arm = 0.4, offset = 0.2 }
"""


def grouped(*sizes: int, extra: str = "", epsilon: str = "[0.1, 0.1]") -> str:
    """Returns a scenario with groups of these numbers of robots; the robots of a group are in a line."""
    text, x = HEAD + extra, 0
    if "[law]" not in extra:
        text += f"\n[law]\nepsilon = {epsilon}\n"
    text += '[formation]\nshape = { kind = "line", spacing = 9.0 }\n'
    for group, size in enumerate(sizes, start=1):
        text += f'[formation.groups.g{group}]\nshape = {{ kind = "line", spacing = 1.0 }}\n'
        text += f"[formation.groups.g{group}.robots]\n"
        for robot in range(size):
            text += f"r{x} = {{ start = [{x}.0, {robot}.0] }}\n"
            x += 1
    return text


def plan_of(text: str, *overrides: str) -> Plan:
    """Returns the plan of a scenario's text."""
    return parse(text, "t.toml", overrides)[1]


def paper(*overrides: str) -> Plan:
    """Returns the plan of the paper's scenario."""
    return load(SCENARIOS / "paper.toml", overrides)[1]


def refusal(text: str, *overrides: str) -> str:
    """Returns the text of the error about a scenario that is refused, without the file and the overrides."""
    with pytest.raises(ScenarioError) as caught:
        parse(text, "t.toml", overrides)
    return re.sub(r"^t\.toml( with --set .*?)?: ", "", str(caught.value))


# Members


def test_members_are_numbered_robots_first_then_children_before_parents():
    plan = paper()
    assert [member.index for member in plan.formation] == list(range(13))
    assert [robot.path for robot in plan.robots][:4] == ["g1/r2", "g1/r1", "g1/r3", "g2/r4"]
    assert [node.path for node in plan.nodes] == ["g1", "g2", "g3", ""]
    assert [node.name for node in plan.nodes][-1] == "coordinator"
    assert plan.root.children == (9, 10, 11)
    assert [(node.children, node.weights, node.first_robot) for node in plan.nodes[:2]] == [
        ((0, 1, 2), (1, 1, 1), 0),
        ((3, 4, 5), (1, 1, 1), 3),
    ]
    assert plan.root.weights == (3, 3, 3)


DEEP = (
    HEAD
    + """
[law]
epsilon = [0.5, 0.25, 0.125]
[formation]
shape = { kind = "line", spacing = 9.0 }
[formation.robots]
lone = { start = [0.0, 0.0] }
[formation.groups.a]
shape = { kind = "line", spacing = 3.0 }
[formation.groups.a.groups.b]
shape = { kind = "line", spacing = 1.0 }
robots = { one = { start = [1.0, 0.0] }, two = { start = [2.0, 0.0] } }
[formation.groups.a.groups.c]
robots = { only = { start = [3.0, 0.0] } }
"""
)


def test_a_deep_and_mixed_tree():
    plan = plan_of(DEEP)
    assert [robot.path for robot in plan.robots] == ["lone", "a/b/one", "a/b/two", "a/c/only"]
    assert [node.path for node in plan.nodes] == ["a/b", "a/c", "a", ""]
    assert plan.root.children == (0, 6)
    assert plan.root.weights == (1, 3)
    assert plan.nodes[2].children == (4, 5)
    assert plan.nodes[2].weights == (2, 1)
    assert [node.first_robot for node in plan.nodes] == [1, 3, 1, 0]
    assert [node.depth for node in plan.nodes] == [2, 2, 1, 0]
    for member in plan.formation:
        if member.parent is not None:
            assert plan.nodes[member.parent - 4].children[member.child_number] == member.index
    assert [(block.name, block.layer, block.offset, block.size) for block in plan.blocks] == [
        ("a/b", "intra", 0, 2),
        ("a/c", "intra", 2, 0),
        ("a", "middle", 2, 2),
        ("inter", "inter", 4, 2),
        ("centroid", "centroid", 6, 2),
    ]
    assert [block.sigma for block in plan.blocks] == [1 / 64, 1 / 64, 1 / 8, 1 / 2, 1.0]


def test_robots_inherit_level_by_level():
    plan = plan_of(
        DEEP,
        "robot.mass=1",
        "formation.groups.a.robot.mass=2",
        "formation.groups.a.groups.b.robot.mass=3",
        "formation.groups.a.groups.b.robots.two.mass=4",
        "formation.groups.a.robot.arm=0.7",
    )
    assert [(robot.mass, robot.arm) for robot in plan.robots] == [(1, 0.4), (3, 0.7), (4, 0.7), (2, 0.7)]
    assert plan.robots[0].model.use == "paper"
    assert plan.robots[0].torque_limit == math.inf


@pytest.mark.parametrize("key", ["mass", "inertia", "wheel_radius", "arm", "offset"])
def test_a_key_that_no_level_gives_is_missing(key):
    text = re.sub(rf"(, )?{key} = [0-9.]+", "", grouped(2)).replace("{ , ", "{ ")
    assert refusal(text).startswith(f"formation.groups.g1.robots.r0.{key}: missing (neither here")


def test_a_start_may_be_missing_too():
    assert refusal(grouped(2).replace("{ start = [0.0, 0.0] }", "{}")).startswith(
        "formation.groups.g1.robots.r0.start: missing"
    )


def test_what_cannot_be_steered_is_refused():
    assert refusal(grouped(2), "robot.offset=0").startswith("formation.groups.g1.robots.r0.offset = 0: must not be")
    assert (
        refusal(grouped(2), "robot.inertia=0.4")
        == "formation.groups.g1.robots.r0.inertia = 0.4: must be larger than mass·offset² = 0.4; "
        "the same holds for 1 more"
    )
    assert "inertia = 0.5: must be larger" in refusal(grouped(2), "robot.offset=1e300")


def test_number_of_robots():
    assert len(plan_of(grouped(100, MAX_ROBOTS - 100)).robots) == MAX_ROBOTS
    why = "formation: 128 robots, but a bus has identifiers for 127; with can.enabled = false there may be 1000"
    assert refusal(grouped(100, MAX_ROBOTS - 99)) == why
    assert len(plan_of(grouped(100, 100), "can.enabled=false").robots) == 200
    assert refusal(grouped(500, 501), "can.enabled=false") == "formation: 1001 robots: must be at most 1000"


def test_robots_that_start_in_one_place_are_refused():
    assert (
        refusal(grouped(2, 2), "formation.groups.g2.robots.r3.start=[0, 0]")
        == "formation.groups.g2.robots.r3.start = [0.0, 0.0]: is where 'g1/r0' starts"
    )


def test_robots_that_avoid_each_other_must_start_apart():
    radii = ("avoidance.avoidance_radius=1.5", "avoidance.sensing_radius=9")
    plan_of(grouped(2), *radii)
    plan_of(grouped(2), "avoidance.enabled=true")
    assert refusal(grouped(2), *radii, "avoidance.enabled=true") == (
        "formation.groups.g1.robots.r1.start = [1.0, 1.0]: 1.41421 m from g1/r0, must be more than "
        "avoidance.avoidance_radius = 1.5 where robots avoid each other"
    )
    edge = ("avoidance.avoidance_radius=2.0", "formation.groups.g1.robots.r1.start=[2, 0]", *radii[1:])
    assert "2 m from g1/r0" in refusal(grouped(2), *edge, "avoidance.enabled=true")


# Time


@pytest.mark.parametrize(
    ("seconds", "ns"),
    [(1e-9, 1), (0.1, 10**8), (0.1 + 0.2, 3 * 10**8), (86400.001, 86_400_001_000_000), (1e9 + 0.001, 10**18 + 10**6)],
)
def test_nanoseconds(seconds, ns):
    assert nanoseconds(seconds, "k") == ns


@pytest.mark.parametrize("seconds", [1e-10, 1.5e-9, 1 / 3, 5e-324, 4.7e9, 1e300, 1.7e308])
def test_durations_that_are_not_whole_nanoseconds_are_refused(seconds):
    with pytest.raises(PlanError, match=r"^k = .*: must be a whole number of nanoseconds"):
        nanoseconds(seconds, "k")


@given(st.integers(1, 10**15))
def test_nanoseconds_of_every_instant(ns):
    assert nanoseconds(ns / 1e9, "k") == ns


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (["periods.torque=0.003"], "periods.torque = 0.003: must divide periods.acceleration = 0.01"),
        (["periods.torque=0.02"], "periods.torque = 0.02: must divide periods.acceleration = 0.01"),
        (
            ["formation.groups.g1.period=0.005"],
            "periods.torque = 0.01: must divide formation.groups.g1.period = 0.005",
        ),
        (
            ["formation.groups.g1.period=0.02"],
            "periods.acceleration = 0.01: must be a multiple of 0.02, the period of g1",
        ),
        (
            ["formation.groups.g2.period=0.02", "formation.period=0.03"],
            "formation.period = 0.03: must be a multiple of 0.02, the period of g2",
        ),
        (["duration=1.005"], "duration = 1.005: must be a multiple of 0.01, the coordinator's period"),
        (["formation.period=0.3"], "duration = 1.0: must be a multiple of 0.3, the coordinator's period"),
        (["record.display_period=1e-10"], "record.display_period = 1e-10: must be a whole number of nanoseconds"),
        (["periods.acceleration=1e-10"], "periods.acceleration = 1e-10: must be a whole number of nanoseconds"),
        (["duration=1e300"], "duration = 1e+300: must be a whole number of nanoseconds"),
    ],
)
def test_periods_fit_each_other(overrides, text):
    assert refusal(grouped(2, 2), *overrides).startswith(text)


def test_layers_have_periods_of_their_own():
    plan = plan_of(grouped(2, 2), "periods.torque=0.001", "formation.groups.g1.period=0.005", "formation.period=0.02")
    assert [node.period_ns for node in plan.nodes] == [5_000_000, 10_000_000, 20_000_000]
    assert [robot.period_ns for robot in plan.robots] == [5_000_000, 5_000_000, 10_000_000, 10_000_000]
    assert {link.period_ns for link in plan.links_into(6)} == {20_000_000}
    assert {link.period_ns for link in plan.links_into(0)} == {5_000_000}


def test_the_display_period_is_at_least_the_acceleration_period():
    assert paper("record.display_period=0.0001").display_period_ns == 1_000_000
    assert paper("record.display_period=0.5").display_period_ns == 500_000_000


# Shapes


def test_the_papers_shapes():
    plan = paper()
    for node, vectors in zip(
        plan.nodes, [[(-4.9497, 0), (0, 6.0622)]] * 3 + [[(-14.1421, 0), (0, 17.3205)]], strict=True
    ):
        assert node.shape.kind == "points"
        for found, wanted in zip(variables(node.shape.points), vectors, strict=True):
            assert found == pytest.approx(wanted, abs=5e-5)


@pytest.mark.parametrize(
    ("shape", "text"),
    [
        ('{kind="triangle",side=1}', "kind = 'triangle': gives 3 places; a group of 2 needs 2"),
        ('{kind="points",points=[[0,0]]}', "points: gives 1 place; a group of 2 needs 2"),
        ('{kind="vectors",vectors=[[0,0],[1,1]]}', "vectors: gives 2 vectors; a group of 2 needs 1"),
    ],
)
def test_shapes_fit_their_groups(shape, text):
    assert refusal(grouped(2), f"formation.groups.g1.shape={shape}") == f"formation.groups.g1.shape.{text}"


def test_a_shape_too_large_is_refused():
    assert refusal(grouped(5), "formation.groups.g1.shape={kind='line',spacing=1e308}").endswith(
        "too large to be computed with"
    )


def test_vectors_are_turned_like_points():
    plan = plan_of(grouped(2), 'formation.groups.g1.shape={kind="vectors",vectors=[[1,0]],rotation=90}')
    assert plan.nodes[0].shape.kind == "vectors"
    assert plan.nodes[0].shape.points[0] == pytest.approx((0, 1))


# The law


@pytest.mark.parametrize("groups", [1, 2, 3, 5, 8])
def test_three_time_scales(groups):
    plan = plan_of(grouped(*[2] * groups, epsilon="[0.5, 0.25]"))
    assert [block.sigma for block in plan.blocks] == [0.5 * 0.25] * groups + [0.5, 1.0]


@pytest.mark.parametrize("m", [1, 2, 3, 5, 8])
def test_multi_time_scales(m):
    """docs/architecture.md, 2.4: the inter block has ε_1, group j has σ_j = ε_1 ε_2 … ε_{m+2−j}."""
    epsilon = [1 / (k + 2) for k in range(m + 1)]
    plan = plan_of(grouped(*[2] * m, extra=f'[law]\ntime_scales = "multi"\nepsilon = {epsilon}\n'))
    sigma = {block.name: block.sigma for block in plan.blocks}
    for j in range(1, m + 1):
        product_of_epsilon = 1.0
        for k in range(1, m + 2 - j + 1):
            product_of_epsilon *= epsilon[k - 1]
        assert sigma[f"g{j}"] == pytest.approx(product_of_epsilon, rel=1e-14)
    assert sigma["inter"] == epsilon[0]
    assert sigma["centroid"] == 1.0
    ordered = [sigma[f"g{j}"] for j in range(1, m + 1)] + [sigma["inter"]]
    assert ordered == sorted(ordered)


def test_the_papers_time_scales():
    assert [block.sigma for block in paper().blocks] == pytest.approx([0.01, 0.01, 0.01, 0.1, 1.0])


@pytest.mark.parametrize(
    ("overrides", "text"),
    [
        (
            ["law.epsilon=[0.1]"],
            "law.epsilon = [0.1]: must have 2 numbers with time_scales = 'three', as many as layers of the tree",
        ),
        (
            ["law.time_scales=multi", "law.epsilon=[0.1,0.1]"],
            "law.epsilon = [0.1, 0.1]: must have 3 numbers with time_scales = 'multi', as many as groups and the",
        ),
        (["law.epsilon=[1e-200,1e-200]"], "law.epsilon = [1e-200, 1e-200]: the gains of g1 over σ² are too large"),
        (
            ["law.gains.0.block=g9"],
            "law.gains.0.block = 'g9': must be one of '*', 'intra', 'inter', 'centroid', 'g1', 'g2'",
        ),
        (["law.coupling.0={block='g1',onto='G2',value=1}"], "law.coupling.0.onto = 'G2': must be one of '*', 'intra'"),
        (
            ["law.coupling.0={block='g1',onto='g1',value=1}"],
            "law.coupling.0.onto = 'g1': a block is not coupled to itself",
        ),
        (
            ["law.coupling.0={block='inter',onto='inter',value=1}"],
            "law.coupling.0.onto = 'inter': a block is not coupled to itself",
        ),
        (
            ["law.gains.0={block='g1',k1=[[1.0,0],[0,1],[1,1]]}"],
            "law.gains.0.k1: a matrix for g1 must have 2 rows of 2 numbers",
        ),
        (["law.gains.0={k2=[[1,0],[0,1]]}"], "law.gains.0.k2: a matrix for g2 must have 4 rows of 4 numbers"),
        (["law.gains.0={k2=[]}"], "law.gains.0.k2: a matrix for g1 must have 2 rows of 2 numbers"),
        (
            ["law.coupling.0={block='g1',onto='g2',value=[[1,2],[3,4]]}"],
            "law.coupling.0.value: a matrix for g1 by g2 must have 2 rows of 4 numbers",
        ),
        (["claims.0={block='intre',settled_by=1}"], "claims.0.block = 'intre': must be one of"),
    ],
)
def test_rules_of_the_law_fit(overrides, text):
    assert refusal(grouped(2, 3), *overrides).startswith(text)


def test_later_gains_override_earlier_ones():
    plan = plan_of(
        grouped(2, 3),
        "law.gains.0={k1=2.0,k2=3.0}",
        "law.gains.1={block='intra',k1=4.0}",
        "law.gains.2={block='g1',k1=[[1,2],[3,4]],k2=5}",
    )
    g1, g2, inter, centroid = plan.blocks
    assert g1.k1.tolist() == [[1, 2], [3, 4]]
    assert np.array_equal(g1.k2, 5 * np.eye(2))
    assert np.array_equal(g2.k1, 4 * np.eye(4))
    assert np.array_equal(g2.k2, np.eye(4))
    for block in (inter, centroid):
        assert np.array_equal(block.k1, 2 * np.eye(2))
        assert np.array_equal(block.k2, 3 * np.eye(2))


def test_coupling_is_never_on_the_diagonal():
    plan = plan_of(
        grouped(2, 3),
        "law.coupling.0={value=1}",
        "law.coupling.1={block='g1',onto='inter',value=[[1,2],[3,4]]}",
        "law.coupling.2={block='centroid',onto='intra',value=7}",
    )
    assert plan.coupled
    at = {block.name: slice(block.offset, block.offset + block.size) for block in plan.blocks}
    for one, other in product(at, at):
        part = plan.coupling[at[one], at[other]]
        if one == other:
            assert not part.any()
        elif (one, other) == ("g1", "inter"):
            assert part.tolist() == [[1, 2], [3, 4]]
        else:
            assert (part == (7 if one == "centroid" and other.startswith("g") else 1)).all()
    assert not plan_of(grouped(2, 3)).coupled


def test_one_group_alone_is_intra():
    text = HEAD + "[law]\nepsilon = [0.3]\n[formation]\nshape = {kind='line',spacing=1}\n"
    text += "robots = {a={start=[0,0]},b={start=[1,0]}}\n"
    plan = plan_of(text)
    assert [(block.name, block.layer, block.sigma) for block in plan.blocks] == [
        ("intra", "intra", 0.3),
        ("centroid", "centroid", 1.0),
    ]
    assert refusal(text, "claims.0={block='inter',settled_by=1}") == (
        "claims.0.block = 'inter': must be one of '*', 'intra', 'centroid'"
    )


# Links


def test_the_trees_links():
    plan = paper()
    names = [member.name for member in plan.formation]
    found = {(names[link.source], names[link.receiver], link.channel) for link in plan.links}
    expected = set()
    for robot in plan.robots:
        group = robot.path.split("/")[0]
        expected |= {(robot.path, group, Channel.STATE), (group, robot.path, Channel.COMMAND)}
    for group in ("g1", "g2", "g3"):
        expected |= {(group, "coordinator", Channel.GROUP_STATE), ("coordinator", group, Channel.REFERENCE)}
    assert found == expected
    assert len(plan.links) == 24
    assert [link.receiver for link in plan.links] == sorted(link.receiver for link in plan.links)
    assert all(link.ideal for link in plan.links)


def test_the_last_fitting_rule_holds_alone():
    plan = plan_of(
        grouped(2, 2),
        "links.0={delay=0.002,loss=0.5}",
        "links.1={source='g1/*',delay={min=0.001,max=0.003}}",
        "links.2={channel='reference',receiver='g2',loss=0.25}",
    )
    names = [member.name for member in plan.formation]
    for link in plan.links:
        values = link.delay_min_ns, link.delay_max_ns, link.loss
        if names[link.source].startswith("g1/"):
            assert values == (1_000_000, 3_000_000, 0.0)
        elif link.channel is Channel.REFERENCE and names[link.receiver] == "g2":
            assert values == (0, 0, 0.25)
        else:
            assert values == (2_000_000, 2_000_000, 0.5)


@pytest.mark.parametrize(
    ("override", "text"),
    [
        (
            "links.0.source=g7/*",
            "links.0.source = 'g7/*': fits no member; there are coordinator, g1, g2, g1/r0, g1/r1, g2/r2, g2/r3",
        ),
        ("links.0.receiver=r0", "links.0.receiver = 'r0': fits no member; there are coordinator"),
        (
            "links.0={source='g1/r0',receiver='g2'}",
            "links.0: no link goes from 'g1/r0' to 'g2' on channel '*'; links go from",
        ),
        ("links.0={source='g1',channel='state'}", "links.0: no link goes from 'g1' to '**' on channel 'state'"),
        ("links.0.delay=2e6", "links.0.delay = 2000000.0: must be at most 1e+06"),
        ("links.0.delay={min=0,max=2e6}", "links.0.delay.max = 2000000.0: must be at most 1e+06"),
    ],
)
def test_rules_of_links_fit(override, text):
    assert refusal(grouped(2, 2), override).startswith(text)


def test_many_members_are_not_all_listed():
    text = refusal(grouped(60, 60), "links.0.source=x")
    assert text.endswith("g1/r7, g1/r8, and 111 more")


def matches_by_force(pattern: str, path: str) -> bool:
    """Returns whether a path matches, by trying every number of chunks that each `**` can stand for."""
    wants, chunks = pattern.split("/"), path.split("/")
    wild = [at for at, want in enumerate(wants) if want == "**"]
    for lengths in product(range(len(chunks) + 1), repeat=len(wild)):
        spread = []
        for at, want in enumerate(wants):
            spread += ["*"] * lengths[wild.index(at)] if want == "**" else [want]
        if len(spread) == len(chunks) and all(w in ("*", c) for w, c in zip(spread, chunks, strict=True)):
            return True
    return False


@pytest.mark.slow
@settings(max_examples=1500)
@given(
    st.lists(st.sampled_from(["a", "b", "*", "**"]), min_size=1, max_size=5).map("/".join),
    st.lists(st.sampled_from(["a", "b"]), min_size=1, max_size=5).map("/".join),
)
def test_wildcards_match_as_a_search_of_all_possibilities(pattern, path):
    assert path_matches(pattern, path) == matches_by_force(pattern, path)


@pytest.mark.parametrize(
    ("pattern", "path", "fits"),
    [
        ("*", "g1", True),
        ("*", "g1/r1", False),
        ("**", "g1/r1", True),
        ("g1/**", "g1", True),
        ("g1/**", "g1/a/b", True),
        ("**/r1", "g1/r1", True),
        ("**/r1", "r1", True),
        ("g*", "g1", False),
        ("", "g1", False),
        ("coordinator", "coordinator", True),
        ("/".join(["**"] * 60 + ["x"]), "/".join("y" * 60), False),
    ],
)
def test_wildcards(pattern, path, fits):
    assert path_matches(pattern, path) == fits


def test_the_root_and_the_layers_between_can_be_told_apart() -> None:
    plan = load(SCENARIOS / "three_levels.toml", ['law.gains=[{block="inter",k1=3.0},{block="middle",k1=2.0}]'])[1]
    assert {block.name: block.layer for block in plan.blocks if block.layer not in ("intra", "centroid")} == {
        "west": "middle",
        "south": "middle",
        "east": "middle",
        "inter": "inter",
    }
    assert {block.layer: block.k1[0, 0] for block in plan.blocks} == {
        "intra": 1.0,
        "middle": 2.0,
        "inter": 3.0,
        "centroid": 1.0,
    }
