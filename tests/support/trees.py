"""Random plans: trees of any depth with matrices as gains and couplings; all numbers come from one seed."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import strategies as st
from numpy.random import Generator

from echelon.plan.layout import with_message_sizes
from echelon.plan.plan import Plan
from echelon.planning.plan_maker import make_plan
from echelon.scenario.part_fields import PartContext
from echelon.scenario.tables import Scenario
from echelon.sim.parts.loading import REGISTRY

Tree = Sequence[Any]
"""The children of a node: None is a robot, a sequence is a group"""
ROBOT = {"mass": 10.0, "inertia": 0.5, "wheel_radius": 0.1, "arm": 0.4, "offset": 0.2}
PAPER_TREE: Tree = ((None,) * 3,) * 3


def trees(max_depth: int = 4, max_children: int = 4, max_robots: int = 14) -> st.SearchStrategy[Tree]:
    """Returns trees of 1 to `max_depth` layers of nodes.  Each node has 1 to `max_children` children, robots or groups."""

    def node(depth: int) -> st.SearchStrategy[Tree]:
        child: st.SearchStrategy[Any] = st.none()
        if depth > 1:
            child = st.one_of(st.none(), node(depth - 1))
        return st.lists(child, min_size=1, max_size=max_children).map(tuple)

    return node(max_depth).filter(lambda tree: count_robots(tree) <= max_robots)


def count_robots(tree: Tree) -> int:
    """Returns the number of robots of a tree."""
    return sum(1 if child is None else count_robots(child) for child in tree)


def count_nodes(tree: Tree) -> int:
    """Returns the number of nodes of a tree."""
    return 1 + sum(count_nodes(child) for child in tree if child is not None)


def count_layers(tree: Tree) -> int:
    """Returns the number of layers of nodes of a tree."""
    return 1 + max((count_layers(child) for child in tree if child is not None), default=0)


def group_table(tree: Tree, random: Generator, spread: float = 10.0) -> dict[str, Any]:
    """Returns the scenario's table of a group: robots first, then groups, at random places within `spread` [m]."""
    table: dict[str, Any] = {"robots": {}, "groups": {}}
    if len(tree) > 1:
        table["shape"] = {"kind": "points", "points": random.normal(size=(len(tree), 2), scale=3.0).tolist()}
    for at, child in enumerate(tree):
        if child is None:
            start = random.uniform(-spread / 2, spread / 2, 2).tolist()
            table["robots"][f"r{at}"] = {"start": start, "heading": random.uniform(-3, 3)}
        else:
            table["groups"][f"g{at}"] = group_table(child, random, spread)
    return table


def scenario(tree: Tree, random: Generator, **tables: Any) -> dict[str, Any]:
    """Returns a scenario of a tree; `tables` replace or add top-level keys."""
    return {
        "name": "invented",
        "duration": 0.003,
        "periods": {"acceleration": 0.001, "torque": 0.001},
        "robot": ROBOT,
        "formation": group_table(tree, random),
        "trajectory": {"kind": "sine", "speed": 1.0, "amplitude": 30.0, "rate": 0.1},
        "law": {"epsilon": [0.5] * count_layers(tree)},
    } | tables


def plan_of(table: dict[str, Any]) -> Plan:
    """Returns the plan of a scenario's table."""
    return make_plan(Scenario.model_validate(table, context=PartContext(REGISTRY, Path())), REGISTRY)


def random_law(tree: Tree, random: Generator, time_scales: str = "three", coupling: float = 0.5) -> dict[str, Any]:
    """Returns the table `[law]` for a tree of two layers: full gain matrices for every block, K̄ for every pair of blocks."""
    law = random_epsilon(tree, random, time_scales)
    bare = plan_of(scenario(tree, random, law=law))
    law["gains"] = [
        {"block": block.name, "k1": near_unit(block.size, random), "k2": near_unit(block.size, random)}
        for block in bare.blocks
    ]
    law["coupling"] = [
        {
            "block": one.name,
            "onto": other.name,
            "value": random.normal(size=(one.size, other.size), scale=coupling).tolist(),
        }
        for one in bare.blocks
        for other in bare.blocks
        if one is not other and coupling
    ]
    return law


def with_random_gains(plan: Plan, random: Generator, coupling: float = 0.5) -> Plan:
    """Returns a plan in which every block has its own full gain matrices, and K̄ is full outside its diagonal blocks."""
    size = 2 * len(plan.robots)
    k_bar = coupling * random.normal(size=(size, size))
    blocks = []
    for block in plan.blocks:
        rows = slice(block.offset, block.offset + block.size)
        k_bar[rows, rows] = 0.0
        k1, k2 = (np.array(near_unit(block.size, random)).reshape(block.size, block.size) for _ in range(2))
        blocks.append(replace(block, k1=k1, k2=k2))
    return with_message_sizes(replace(plan, blocks=tuple(blocks), coupling=k_bar))


def random_epsilon(tree: Tree, random: Generator, time_scales: str = "three") -> dict[str, Any]:
    """Returns the table `[law]` with random time scales that are not far apart."""
    count = count_layers(tree) if time_scales == "three" else count_nodes(tree)
    return {"time_scales": time_scales, "epsilon": random.uniform(0.6, 1.0, count).tolist()}


def near_unit(size: int, random: Generator) -> list[list[float]]:
    """Returns a random full matrix close to the unit matrix."""
    rows: list[list[float]] = (np.eye(size) + 0.2 * random.normal(size=(size, size))).tolist()
    return rows


def like_groups(groups: int, robots: int, **tables: Any) -> Plan:
    """Returns the plan of any number of like groups of like robots, also more than a bus has identifiers for: that of two
    groups of two robots, multiplied.  Robots have no drives of their own; the plan is for predictions."""
    law = {"epsilon": [0.5, 0.5], "lead": 0.5}
    base = plan_of(scenario(((None, None), (None, None)), np.random.default_rng(1), **({"law": law} | tables)))
    count, shape = groups * robots, base.nodes[0].shape
    root, members = count + groups, []
    for group in range(groups):
        for robot in range(robots):
            number = group * robots + robot
            place = {"index": number, "parent": count + group, "child_number": robot, "path": f"g{group}/r{number}"}
            members.append(replace(base.robots[0], **place))
    nodes, blocks = [], []
    for group in range(groups + 1):
        below = range(count, root) if group == groups else range(group * robots, (group + 1) * robots)
        old = base.root if group == groups else base.nodes[0]
        weights = (robots if group == groups else 1,) * len(below)
        points = tuple((float(at), 0.0) for at in range(len(below)))
        index = {"index": count + group, "children": tuple(below), "weights": weights}
        place = {} if group == groups else {"parent": root, "child_number": group, "path": f"g{group}"}
        place["first_robot"] = 0 if group == groups else group * robots
        nodes.append(replace(old, shape=replace(shape, kind="points", points=points), **index, **place))
        block = base.block_of(old.index)
        size, offset = 2 * (len(below) - 1), 2 * group * (robots - 1)
        name = block.name if group == groups else f"g{group}"
        k1, k2 = (gain[0, 0] * np.eye(size) for gain in (block.k1, block.k2))
        blocks.append(replace(block, name=name, node=count + group, offset=offset, size=size, k1=k1, k2=k2))
    blocks.append(replace(base.blocks[-1], offset=2 * (count - 1)))
    one = {(link.source < 4, link.receiver < 4, link.channel): link for link in base.links}
    links = []
    for parent in nodes:
        for child in parent.children:
            for (from_robot, to_robot, _), link in one.items():
                if child < count and (from_robot or to_robot):
                    ends = (child, parent.index) if from_robot else (parent.index, child)
                elif child >= count and not from_robot and not to_robot:
                    ends = (child, parent.index) if link.source < link.receiver else (parent.index, child)
                else:
                    continue
                links.append(replace(link, source=ends[0], receiver=ends[1]))
    tree = {"robots": tuple(members), "nodes": tuple(nodes), "blocks": tuple(blocks), "links": tuple(links)}
    avoidance = replace(base.avoidance, enabled=False)
    return with_message_sizes(replace(base, coupling=np.zeros((2 * count, 2 * count)), avoidance=avoidance, **tree))
