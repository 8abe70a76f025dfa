"""The blocks of a plan: their time scales, gains and coupling from the table `[law]` (docs/architecture.md, 2.4)."""

from collections.abc import Sequence
from dataclasses import replace
from math import prod

import numpy as np

from echelon.errors import Mistakes
from echelon.plan.plan import Array, BlockPlan, NodePlan, PlanError
from echelon.scenario.law_tables import Coupling, Law
from echelon.scenario.tables import BLOCK_NAMES
from echelon.scenario.values import Matrix


def make_blocks(law: Law, nodes: Sequence[NodePlan]) -> tuple[BlockPlan, ...]:
    """Returns the blocks with their time scales and gains: one for each node in their order, then the centroid's.

    Raises PlanError if numbers do not fit the tree, or a gain over σ² is not finite."""
    blocks: list[BlockPlan] = []
    offset = 0
    for node, sigma in zip(nodes, _time_scales(law, nodes), strict=True):
        has_groups = any(child >= nodes[0].index for child in node.children)
        layer = "intra" if not has_groups else "inter" if node.parent is None else "middle"
        size = 2 * (len(node.children) - 1)
        blocks.append(BlockPlan(node.path or layer, layer, node.index, offset, size, sigma, np.eye(size), np.eye(size)))
        offset += size
    blocks.append(BlockPlan("centroid", "centroid", None, offset, 2, 1.0, np.eye(2), np.eye(2)))
    mistakes = Mistakes()
    for at, rule in enumerate(law.gains):
        key = f"law.gains.{at}"
        with mistakes.noted():
            names = {block.name for block in fitting(blocks, rule.block, f"{key}.block")}
            blocks = [
                replace(block, k1=_gain(rule.k1, f"{key}.k1", block), k2=_gain(rule.k2, f"{key}.k2", block))
                if block.name in names
                else block
                for block in blocks
            ]
    mistakes.check(PlanError)
    for block in blocks:
        with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
            scaled = block.k1 / np.square(block.sigma)
        if not np.isfinite(scaled).all():
            raise PlanError(f"{_epsilon(law)}: the gains of {block.name} over σ² are too large to compute with")
    return tuple(blocks)


def _time_scales(law: Law, nodes: Sequence[NodePlan]) -> list[float]:
    """Returns the time scale σ of each node's shape [s] (docs/architecture.md, 2.4): the product of the first few epsilons.

    With `three`, a node at depth k has k + 1 factors.  With `multi`, the root has one factor, and each node one more than the
    node after it.  Raises PlanError if the scenario gives another number of epsilons."""
    if law.time_scales == "three":
        needed, what = max(node.depth for node in nodes) + 1, "layers of the tree"
        factors = [node.depth + 1 for node in nodes]
    else:
        needed, what = len(nodes), "groups and the formation"
        factors = list(range(len(nodes), 0, -1))
    if len(law.epsilon) != needed:
        numbers = "1 number" if needed == 1 else f"{needed} numbers"
        raise PlanError(
            f"{_epsilon(law)}: must have {numbers} with time_scales = {law.time_scales!r}, as many as {what}"
        )
    return [prod(law.epsilon[:count]) for count in factors]


def _epsilon(law: Law) -> str:
    """Returns the beginning of an error about `law.epsilon`: its value, and a remark if the scenario does not give it."""
    default = "" if "epsilon" in law.model_fields_set else ", its default (the scenario gives none)"
    return f"law.epsilon = {law.epsilon}{default}"


def make_coupling(law: Law, blocks: Sequence[BlockPlan]) -> Array:
    """Returns the coupling K̄ of all blocks, (2N, 2N) for N robots.  Raises PlanError if a rule does not fit the blocks."""
    size = blocks[-1].offset + blocks[-1].size
    coupling = np.zeros((size, size))
    mistakes = Mistakes()
    for at, rule in enumerate(law.coupling):
        with mistakes.noted():
            _couple(coupling, rule, blocks, f"law.coupling.{at}")
    mistakes.check(PlanError)
    return coupling


def _couple(coupling: Array, rule: Coupling, blocks: Sequence[BlockPlan], key: str) -> None:
    """Writes the values of one rule into K̄ (`coupling`).  Raises PlanError."""
    pairs = [
        (block, onto)
        for block in fitting(blocks, rule.block, f"{key}.block")
        for onto in fitting(blocks, rule.onto, f"{key}.onto")
        if block is not onto
    ]
    if not pairs:
        raise PlanError(f"{key}.onto = {rule.onto!r}: a block is not coupled to itself")
    for block, onto in pairs:
        shape = (block.size, onto.size)
        value: float | Array = (
            _matrix(rule.value, shape, f"{key}.value", f"{block.name} by {onto.name}")
            if isinstance(rule.value, list)
            else rule.value
        )
        coupling[_range(block), _range(onto)] = value


def fitting(blocks: Sequence[BlockPlan], name: str, key: str) -> list[BlockPlan]:
    """Returns the blocks that a name stands for: the name of a block, of a layer, or `*`.  Raises PlanError if none fits."""
    fits = [block for block in blocks if name in ("*", block.name, block.layer)]
    if not fits:
        groups = [block.name for block in blocks if block.name not in BLOCK_NAMES]
        layers = [name for name in BLOCK_NAMES if any(name == block.layer for block in blocks)]
        raise PlanError(f"{key} = {name!r}: must be one of {', '.join(repr(one) for one in ['*', *layers, *groups])}")
    return fits


def _range(block: BlockPlan) -> slice:
    """Returns the place of a block in the transformed state."""
    return slice(block.offset, block.offset + block.size)


def _gain(value: float | Matrix, key: str, block: BlockPlan) -> Array:
    """Returns a gain as a matrix; a number stands for a multiple of the identity."""
    if isinstance(value, list):
        return _matrix(value, (block.size, block.size), key, block.name)
    return value * np.eye(block.size)


def _matrix(rows: Matrix, shape: tuple[int, int], key: str, what: str) -> Array:
    """Returns rows of numbers as an array.  Raises PlanError if they do not have this shape."""
    if len(rows) != shape[0] or any(len(row) != shape[1] for row in rows):
        raise PlanError(f"{key}: a matrix for {what} must have {shape[0]} rows of {shape[1]} numbers")
    return np.array(rows, dtype=float).reshape(shape)
