"""Runs on a GPU: the CUDA simulator stands in for one.  It runs the same source as Python."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from echelon.errors import UsageError
from echelon.sim.batch import refusals
from echelon.sim.batch.batch import run_many
from support.runs import ROOT, plan_of

LATE = 'links=[{source="**", receiver="**", loss=0.1, delay={min=0.0, max=0.03}}]'
SIMULATED = """
import sys
import numpy as np
from echelon.sim.batch.batch import run_many
from support.runs import plan_of
runs = run_many(plan_of(*sys.argv[2:]), [5, 6], device="gpu", traces=True, say=lambda text: None)
np.savez(sys.argv[1], traces=runs.traces, links=runs.links, blocks=runs.blocks)
"""


@pytest.mark.parametrize("changes", [("duration=0.05",), ("duration=0.1", LATE)], ids=["ideal", "late"])
def test_runs_on_a_gpu_are_the_processors(tmp_path: Path, changes: tuple[str, ...]) -> None:
    kept = tmp_path / "runs.npz"
    environment = os.environ | {
        "NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}",
    }  # fmt: skip
    command = [sys.executable, "-W", "ignore", "-c", SIMULATED, str(kept), "multi", *changes]
    subprocess.run(command, env=environment, timeout=250, check=True)
    found = np.load(kept)
    wanted = run_many(plan_of("multi", *changes), [5, 6], traces=True, say=lambda text: None)
    np.testing.assert_allclose(found["traces"], wanted.traces, rtol=0, atol=1e-12)
    np.testing.assert_array_equal(found["links"], wanted.links)
    np.testing.assert_allclose(found["blocks"]["ise"], wanted.blocks["ise"], rtol=1e-12)


def test_without_a_gpu_one_line_says_what_makes_the_same_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "echelon.sim.batch.gpu", None)  # as without numba-cuda
    assert refusals.gpu_refusal() == (
        "engine gpu needs numba-cuda: pip install 'echelon[gpu]'; --engine batch makes the same runs on the processor"
    )
    with pytest.raises(UsageError, match="needs numba-cuda"):
        run_many(plan_of("multi"), [1], device="gpu")


def test_sums_over_runs_are_the_processors_alone() -> None:
    with pytest.raises(UsageError, match="device 'gpu': sums over runs"):
        run_many(plan_of("multi"), [1], device="gpu", mean_squares=True)
