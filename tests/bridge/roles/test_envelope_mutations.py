"""The checks of the envelope find every small mistake: each mutant of the module fails one of them.

In a mutant, one comparison, operator, literal, condition, min or max is changed, or one statement is missing."""

import ast
import copy
import inspect
import signal
from collections.abc import Iterator
from itertools import count
from types import FrameType, ModuleType

import pytest

from echelon.bridge.roles import envelope
from support.envelope_checks import CHECKS

SOURCE = inspect.getsource(envelope)
CPU_SECONDS = 2.0  # a mutant may loop for ever

ORDERS: tuple[type[ast.cmpop], ...] = (ast.Lt, ast.LtE, ast.Gt, ast.GtE)
OPPOSITES: dict[type[ast.AST], type[ast.AST]] = {
    ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq,
    ast.Is: ast.IsNot,
    ast.IsNot: ast.Is,
    ast.Add: ast.Sub,
    ast.Sub: ast.Add,
    ast.Mult: ast.Div,
    ast.Div: ast.Mult,
    ast.And: ast.Or,
    ast.Or: ast.And,
}
CALLS = {"min": "max", "max": "min", "popleft": "pop", "pop": "popleft"}

# Equivalent mutants, as (line, line of the mutant).  Of two equal values the window may keep both or only the later one: if it
# keeps both, the earlier one leaves first, and the later one has the same value.  A torque of zero has no common part with any
# other torque, whichever sign it counts for.  The shortcuts only save time: no comparison with an infinite limit finds
# anything, and torques within their limit are never more than twice the limit apart.
COMMON = "common = min(size, before) if (torque {} 0.0) is (sent {} 0.0) else 0.0"
WINDOWED = "self._windowed = plan.window_limit {} * plan.torque_limit"
SPREAD = "_largest(self.highs, now_ns, torque) + _largest(self.lows, now_ns, -torque) > plan.window_limit"
EQUIVALENT = {
    ("while window and window[-1][1] <= value:", "while window and window[-1][1] < value:"),
    (COMMON.format(">", ">"), COMMON.format(">=", ">")),
    (COMMON.format(">", ">"), COMMON.format(">", ">=")),
    ("if self._unlimited:", "pass"),
    (WINDOWED.format("< 2"), WINDOWED.format("<= 2")),
    (WINDOWED.format("< 2"), WINDOWED.format("< 3")),
    (f"if self._windowed and {SPREAD}:", f"if {SPREAD}:"),
}


def changes(node: ast.AST) -> Iterator[ast.AST]:
    """Yields the nodes that may replace a node."""
    if isinstance(node, ast.Compare):
        (operator,) = node.ops
        others = [other for other in ORDERS if not isinstance(operator, other)] if isinstance(operator, ORDERS) else []
        for other in [*others, *([opposite] if (opposite := OPPOSITES.get(type(operator))) else [])]:
            yield ast.Compare(node.left, [other()], node.comparators)  # type: ignore[list-item]
    elif isinstance(node, ast.BinOp | ast.AugAssign | ast.BoolOp) and type(node.op) in OPPOSITES:
        mutant = copy.copy(node)
        mutant.op = OPPOSITES[type(node.op)]()  # type: ignore[assignment]
        yield mutant
        if isinstance(node, ast.BoolOp):
            yield from node.values
        elif isinstance(node, ast.BinOp):
            yield from (node.left, node.right)
        else:
            yield ast.Pass()
    elif isinstance(node, ast.UnaryOp):
        yield node.operand
    elif isinstance(node, ast.Constant) and isinstance(node.value, int | float) and not isinstance(node.value, bool):
        yield from (ast.Constant(value) for value in (node.value + 1, node.value - 1, 0) if value != node.value)
    elif isinstance(node, ast.Name) and node.id in CALLS:
        yield ast.Name(CALLS[node.id], node.ctx)
    elif isinstance(node, ast.Attribute) and node.attr in CALLS:
        yield ast.Attribute(node.value, CALLS[node.attr], node.ctx)
    elif (
        isinstance(node, ast.Call) and len(node.args) == 1 and isinstance(node.func, ast.Name) and node.func.id == "abs"
    ):
        yield node.args[0]
    elif isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("min", "max"):
        for left_out in range(len(node.args)):
            if len(node.args) > 2:
                yield ast.Call(node.func, node.args[:left_out] + node.args[left_out + 1 :], node.keywords)
            else:
                yield node.args[left_out]
    elif isinstance(node, ast.IfExp):
        yield ast.IfExp(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
        yield from (node.body, node.orelse)
    elif isinstance(node, ast.If | ast.While):
        yield type(node)(ast.UnaryOp(ast.Not(), node.test), node.body, node.orelse)
        yield ast.Pass()
    elif isinstance(node, ast.Return) and isinstance(node.value, ast.Constant) and node.value.value is None:
        return  # at the end of a function this changes nothing
    elif isinstance(node, ast.Return | ast.Assign | ast.Raise) or (
        isinstance(node, ast.Expr) and not isinstance(node.value, ast.Constant)
    ):
        yield ast.Pass()


class Replace(ast.NodeTransformer):
    """Puts one node in place of another."""

    def __init__(self, old: ast.AST, new: ast.AST) -> None:
        self.old, self.new = old, new

    def visit(self, node: ast.AST) -> ast.AST:
        return self.new if node is self.old else self.generic_visit(node)


def mutants() -> dict[str, str]:
    """Returns the source of each mutant, with the change in words."""
    found = {}
    original = ast.unparse(ast.parse(SOURCE))
    lines = original.splitlines()
    for at in range(len(list(ast.walk(ast.parse(SOURCE))))):
        for number in count():
            tree = ast.parse(SOURCE)
            node = list(ast.walk(tree))[at]
            options = list(changes(node))
            if number == len(options):
                break
            text = ast.unparse(ast.fix_missing_locations(Replace(node, options[number]).visit(tree)))
            if text == original:
                continue
            other = text.splitlines()
            first = next(n for n, (a, b) in enumerate(zip([*lines, ""], [*other, ""], strict=False)) if a != b)
            if (lines[first].strip(), other[first].strip()) not in EQUIVALENT:
                found[text] = f"{lines[first].strip()}  ->  {other[first].strip()}"
    return found


def survives(source: str) -> bool:
    """Returns whether all checks pass with this source."""
    module = ModuleType("echelon.bridge.roles.envelope")

    def interrupt(number: int, frame: FrameType | None) -> None:
        raise TimeoutError("the mutant does not come to an end")

    before = signal.signal(signal.SIGVTALRM, interrupt)
    signal.setitimer(signal.ITIMER_VIRTUAL, CPU_SECONDS)
    try:
        exec(source, module.__dict__)
        for check in CHECKS:
            check(module)
    except (Exception, pytest.fail.Exception):
        return False
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0)
        signal.signal(signal.SIGVTALRM, before)
    return True


def test_the_checks_pass_without_a_mutation() -> None:
    assert survives(SOURCE)


def test_every_mutant_is_noticed() -> None:
    found = mutants()
    assert len(found) > 100
    assert [what for source, what in found.items() if survives(source)] == []


def test_what_is_listed_as_equivalent_is_in_the_module() -> None:
    lines = [line.strip() for line in ast.unparse(ast.parse(SOURCE)).splitlines()]
    assert {line for line, _ in EQUIVALENT} <= set(lines)
