"""Which members of a formation are like each other, and a smaller formation that is stable if and only if the whole one is.

Where no blocks are coupled and the gains of a node's shape are numbers, the node treats its children alike: the acceleration of
child k is that of the centroid, and -K_1 (x_k - x̄) - K_2 (v_k - v̄) with the weighted mean x̄, beside what is constant.  Let c
of its children be alike: the same periods, links, delays, gains and weight w, and the same below.  The motions of these c are

- what they do in common: that of one child with the weight c w;
- differences between two of them, which move no mean: a child alone, whatever c is, in c - 1 copies.

Two of them, each with the weight c w/2, have the same motions, with one copy of the difference.  So they have the same
eigenvalues, and `reduced` leaves out the rest.  A formation of 100 groups of ten is that of two groups of two.
"""

from collections import Counter
from collections.abc import Callable, Hashable, Iterable
from dataclasses import dataclass, replace
from math import gcd

import numpy as np

from echelon.controller.prediction.gains import linear_gains
from echelon.controller.prediction.linear_run import Edges, edge_of
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import (
    Array,
    BlockPlan,
    NodePlan,
    Plan,
    ShapePlan,
)

Numbers = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Likeness:
    """What is like what in a plan."""

    kinds: tuple[int, ...]
    """For each member a number that is the same for members with the same place, period, links and gains, and the same below"""
    below: tuple[int, ...]
    """The same for the parts of the tree that begin at each member, wherever they are"""
    symmetric: frozenset[int]
    """The nodes that treat like children alike"""


def likeness(plan: Plan, late: Edges = frozenset()) -> Likeness:
    """Returns what is like what in a plan, where the links `late` are unlike the others."""
    links: dict[int, list[Hashable]] = {member.index: [] for member in plan.formation}
    for link in plan.links:
        child = next(
            (end for end in (link.source, link.receiver) if end in links and _parent(plan, end) in _ends(link)), None
        )
        if child is not None:
            bare = replace(link, source=0, receiver=0, size=None, name="")
            links[child].append((bare.channel, repr(bare), repr(bare.delays), edge_of(link) in late))
    number = _numbering()
    below = [0] * len(plan.formation)
    symmetric = set()
    for robot in plan.robots:
        periods = robot.period_ns, robot.torque_period_ns, robot.event_driven
        below[robot.index] = number(("robot", periods, _sorted(links[robot.index])))
    for node in plan.nodes:
        block = plan.block_of(node.index)
        numbers = _scalars(plan, block)
        children = [(below[child], weight) for child, weight in zip(node.children, node.weights, strict=True)]
        of_gains: Hashable
        of_children: Hashable
        if numbers is not None and not plan.coupled and not plan.bus_roles:
            symmetric.add(node.index)
            of_gains, of_children = numbers, frozenset(Counter(children).items())
        else:
            matrices = tuple(each.tobytes() for each in _matrices(plan, block))
            of_gains, of_children = (matrices, node.index if plan.coupled else None), tuple(children)
        own = node.period_ns, node.event_driven, of_gains, of_children
        below[node.index] = number(("node", own, _sorted(links[node.index])))
    kinds = [0] * len(plan.formation)
    for node in reversed(plan.nodes):
        if node.parent is None:
            kinds[node.index] = number("root")
        for at, (child, weight) in enumerate(zip(node.children, node.weights, strict=True)):
            place = None if node.index in symmetric else at
            kinds[child] = number(("place", kinds[node.index], below[child], weight, place))
    return Likeness(tuple(kinds), tuple(below), frozenset(symmetric))


def reduced(plan: Plan, late: Edges = frozenset()) -> tuple[Plan, Edges, tuple[tuple[str, ...], ...]]:
    """Returns a smaller plan with the same eigenvalues, the links `late` in it, and for each of its blocks the names of the
    blocks of `plan` that it stands for.  The plan itself if nothing is alike."""
    like = likeness(plan, late)
    kept: list[int] = []
    weights: dict[int, tuple[tuple[int, ...], tuple[int, ...]]] = {}
    waiting = [plan.root.index]
    while waiting:
        at = waiting.pop()
        kept.append(at)
        if at >= len(plan.robots):
            node = plan.nodes[at - len(plan.robots)]
            weights[at] = _kept_children(node, like)
            waiting += weights[at][0]
    names: dict[int, list[str]] = {}
    for block in plan.blocks:
        if block.node is not None:
            names.setdefault(like.kinds[block.node], []).append(block.name)
    if len(kept) == len(plan.formation):
        return plan, late, tuple((block.name,) for block in plan.blocks)
    index = {old: new for new, old in enumerate(sorted(kept))}
    robots = [
        replace(robot, index=index[robot.index], parent=index[robot.parent],
                child_number=weights[robot.parent][0].index(robot.index))
        for robot in plan.robots
        if robot.index in index
    ]  # fmt: skip
    nodes, blocks, stands_for, offset = [], [], [], 0
    for node in plan.nodes:
        if node.index not in index:
            continue
        children, of_children = weights[node.index]
        parent = None if node.parent is None else index[node.parent]
        place = 0 if node.parent is None else weights[node.parent][0].index(node.index)
        first = min(index[robot] for robot in index if robot < len(plan.robots) and _is_below(plan, robot, node.index))
        shape = ShapePlan("points", ((0.0, 0.0),) * len(children))
        nodes.append(
            replace(node, index=index[node.index], parent=parent, child_number=place, weights=of_children, shape=shape,
                    children=tuple(index[child] for child in children), first_robot=first)
        )  # fmt: skip
        block = plan.block_of(node.index)
        size = 2 * (len(children) - 1)
        k1, k2 = block.k1[:size, :size], block.k2[:size, :size]
        blocks.append(replace(block, node=index[node.index], offset=offset, size=size, k1=k1, k2=k2))
        stands_for.append(tuple(names[like.kinds[node.index]]))
        offset += size
    blocks.append(replace(plan.blocks[-1], offset=offset))
    stands_for.append((plan.blocks[-1].name,))
    links = [
        replace(link, source=index[link.source], receiver=index[link.receiver], size=None)
        for link in plan.links
        if link.source in index and link.receiver in index
    ]
    size = 2 * len(robots)
    small = replace(
        plan, robots=tuple(robots), nodes=tuple(nodes), blocks=tuple(blocks), links=tuple(links),
        coupling=np.zeros((size, size)), avoidance=replace(plan.avoidance, enabled=False),
    )  # fmt: skip
    stay = frozenset((index[one], index[two], channel) for one, two, channel in late if one in index and two in index)
    return small, stay, tuple(stands_for)


def _kept_children(node: NodePlan, like: Likeness) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Returns the children of a node that are kept, and their weights."""
    if node.index not in like.symmetric:
        return node.children, node.weights
    count = Counter(like.kinds[child] for child in node.children)
    seen: Counter[int] = Counter()
    children, weights = [], []
    for child, weight in zip(node.children, node.weights, strict=True):
        kind = like.kinds[child]
        seen[kind] += 1
        if count[kind] <= 2 or seen[kind] <= 2:
            children.append(child)
            weights.append(2 * weight if count[kind] <= 2 else weight * count[kind])
    common = gcd(*weights)
    return tuple(children), tuple(weight // common for weight in weights)


def _matrices(plan: Plan, block: BlockPlan) -> tuple[Array, ...]:
    gains = linear_gains(plan, block)
    return gains.K_1, gains.K_2, gains.K_i, gains.weight


def _scalars(plan: Plan, block: BlockPlan) -> Hashable:
    """Returns the gains of a block as numbers; None if they are not all multiples of the unit matrix.  A law may make of the
    gains what it likes, so the gains as they act count too, and their size must not."""
    matrices = [*_matrices(plan, block), block.k1, block.k2]
    if not block.size:
        return ()
    if not all(np.array_equal(each, each[0, 0] * np.eye(block.size)) for each in matrices):
        return None
    for size in {2, min(4, block.size)}:
        small = replace(block, size=size, k1=block.k1[:size, :size], k2=block.k2[:size, :size])
        if not all(
            np.array_equal(less, each[:size, :size])
            for less, each in zip(_matrices(plan, small), matrices, strict=False)
        ):
            return None
    return tuple(float(each[0, 0]) for each in matrices)


def _sorted(things: Iterable[Hashable]) -> Hashable:
    return tuple(sorted(things, key=repr))


def _parent(plan: Plan, member: int) -> int | None:
    return plan.formation[member].parent


def _ends(link: LinkPlan) -> tuple[int, int]:
    return link.source, link.receiver


def _is_below(plan: Plan, robot: int, node: int) -> bool:
    at: int | None = robot
    while at is not None and at != node:
        at = plan.formation[at].parent
    return at == node


def _numbering() -> Callable[[Hashable], int]:
    """Returns a function that gives equal things equal numbers."""
    known: dict[Hashable, int] = {}
    return lambda thing: known.setdefault(thing, len(known))
