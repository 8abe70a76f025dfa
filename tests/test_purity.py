"""Pure rooms do no input or output and draw no global random numbers; what import contracts cannot see is looked for here."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

from support.runs import ROOT

CALLS = {"open", "print", "input", "eval", "exec"}
METHODS = {"read_text", "write_text", "read_bytes", "write_bytes", "mkdir", "unlink", "rename", "iterdir", "glob"}
METHODS |= {"open", "exists", "is_file", "is_dir", "stat", "touch", "tofile"}
GLOBAL = ("np.random.", "np.load", "np.save", "np.fromfile", "np.genfromtxt", "np.memmap", "os.", "sys.")
EXCEPTIONS = {
    ("echelon/planning/loading.py", "path.read_text"),  # a scenario is read where its mistakes are explained
    ("sim/results/rendering.py", "write_text"),
    ("sim/results/rendering.py", "path.read_bytes"),
}


def pure_files() -> Iterator[Path]:
    """Yields the files of the rooms that pyproject.toml calls pure."""
    contracts = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"]["contracts"]
    (modules,) = (contract["source_modules"] for contract in contracts if contract["name"].startswith("Pure rooms"))
    for module in modules:
        path = ROOT / module.replace(".", "/")
        yield from sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]


def impure_calls(source: str) -> Iterator[str]:
    """Yields calls that read, write or look at something outside."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Call):
            called = ast.unparse(node.func)
            if called.startswith("np.random.default_rng(") or (called == "np.random.default_rng" and node.args):
                continue  # a generator with a seed
            if called in CALLS or called.rpartition(".")[2] in METHODS or called.startswith(GLOBAL):
                yield called


def test_pure_rooms_do_no_input_or_output() -> None:
    files = {path.resolve() for path in pure_files()}
    assert len(files) > 60
    found = {
        (path.relative_to(ROOT).as_posix(), call)
        for path in files
        for call in impure_calls(path.read_text(encoding="utf-8"))
    }
    assert found == EXCEPTIONS


def test_what_is_impure_is_seen() -> None:
    assert list(impure_calls("open('x')\nPath('x').read_text()\nnp.random.normal()\nnp.random.default_rng()")) == [
        "open",
        "Path('x').read_text",
        "np.random.normal",
        "np.random.default_rng",
    ]
    assert list(impure_calls("Path('x').open()\nnp.savetxt('x', y)")) == ["Path('x').open", "np.savetxt"]
    assert list(impure_calls("x.reads()\nnp.random.default_rng(1).normal()\nrandom.normal()\nself.open_bus()")) == []
