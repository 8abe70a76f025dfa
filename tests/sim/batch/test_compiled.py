"""The compiler is a matter of speed: code runs without it, and what is kept is of the present sources."""

import ast
import importlib
import os
import subprocess
import sys
from pathlib import Path

import numpy as np

from echelon.sim.batch import compiled
from echelon.sim.batch.batch import run_many
from support.runs import ROOT, plan_of

RUN = (
    "lab", "duration=0.1", 'links=[{source="**", receiver="**", loss=0.1, delay={min=0.0, max=0.03}}]',
)  # fmt: skip
UNCOMPILED = """
import sys
import numpy as np
from echelon.sim.batch.batch import run_many
from support.runs import plan_of
np.save(sys.argv[1], run_many(plan_of(*sys.argv[2:]), [5], traces=True, say=lambda text: print(text)).traces)
"""


def test_code_does_the_same_uncompiled(tmp_path: Path) -> None:
    kept = tmp_path / "traces.npy"
    environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}"}
    command = [sys.executable, "-W", "ignore::RuntimeWarning", "-c", UNCOMPILED, str(kept), *RUN]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=600, check=True)
    assert not done.stdout  # nothing is compiled
    found = run_many(plan_of(*RUN), [5], traces=True).traces
    np.testing.assert_allclose(np.load(kept), found, rtol=0, atol=1e-9)


def test_compiled_code_is_kept_for_all_sources_of_its_numbers() -> None:
    sources = {source.resolve() for source in compiled.sources()}
    found = set()
    for source in Path(compiled.__file__).parent.glob("*.py"):
        imports = [node for node in ast.parse(source.read_text()).body if isinstance(node, ast.ImportFrom)]
        marks = {name.name for node in imports if node.module == "echelon.sim.batch.compiled" for name in node.names}
        if marks & {"compiled", "fused", "apart"}:
            modules = [
                node.module for node in imports if node.module is not None and node.module.startswith("echelon.")
            ]
            found |= {Path(importlib.import_module(module).__file__ or "").resolve() for module in modules}
    assert found <= sources
    assert len(found) > 5
