"""Runs on a GPU: the CUDA simulator stands in for one.  It runs the same source as Python."""

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from echelon.errors import UsageError
from echelon.plan.plan import Plan
from echelon.sim.batch import records, refusals
from echelon.sim.batch.batch import run_many
from support.batch_cases import CASES
from support.runs import ROOT, plan_of

RECORDS = ("runs", "blocks", "robots", "links", "claims", "traces")
SHORT = {
    "multi": "0.05", "only one group is late": "0.05", "event-driven: only one group is late": "0.03",
    "late, lossy, three levels": "0.16", "blackouts": "1.32",
}  # fmt: skip
"""Durations [s] of cases that have more robots than nine, or of which something happens late"""
SIMULATED = """
import sys
import numpy as np
from echelon.sim.batch.batch import run_many
from test_gpu import CASES, RECORDS, seeds, short
kept = {}
for number, case in enumerate(CASES):
    runs = run_many(short(case), seeds(case), device="gpu", traces=True, say=lambda text: None)
    for kind in RECORDS:
        kept[f"{number}/{kind}"] = getattr(runs, kind)
np.savez(sys.argv[1], **kept)
"""


def short(case: str) -> Plan:
    """Returns the plan of a case that is as short as a simulator needs: it is slower than a GPU by a million."""
    name, *changes = CASES[case]
    duration = SHORT.get(case, "0.02" if name == "paper" else "0.2")
    return plan_of(name, *(change for change in changes if not change.startswith("duration=")), f"duration={duration}")


def seeds(case: str) -> list[int]:
    """Returns the seeds of a case: one, and in one case two, which two threads make."""
    return [5, 6] if case == "late and lossy" else [5]


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """All cases on the simulator, in a process of its own: numba reads its settings once."""
    kept = tmp_path_factory.mktemp("gpu") / "runs.npz"
    environment = os.environ | {
        "NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1",
        "PYTHONPATH": f"{ROOT}:{ROOT / 'tests'}:{Path(__file__).parent}",
    }  # fmt: skip
    subprocess.run([sys.executable, "-W", "ignore", "-c", SIMULATED, str(kept)], env=environment, check=True)
    return np.load(kept)


@pytest.mark.parametrize("case", CASES)
def test_runs_on_a_gpu_are_the_processors(simulated: Any, case: str) -> None:
    wanted = run_many(short(case), seeds(case), traces=True, say=lambda text: None)
    found = {kind: simulated[f"{list(CASES).index(case)}/{kind}"] for kind in RECORDS}
    np.testing.assert_allclose(found["traces"], wanted.traces, rtol=0, atol=1e-12)
    for name in wanted.links.dtype.names or ():
        np.testing.assert_array_equal(found["links"][name], wanted.links[name], err_msg=name)
    np.testing.assert_array_equal(found["claims"], wanted.claims)
    for kind in ("runs", "blocks", "robots"):
        for name in found[kind].dtype.names:
            np.testing.assert_allclose(found[kind][name], getattr(wanted, kind)[name], 1e-9, 1e-12, err_msg=name)


@pytest.mark.parametrize("kind", ["RUN", "ROBOT", "NODE", "BLOCK", "STREAM", "LINK"])
def test_no_field_is_hidden_by_an_attribute_of_numpys_scalars(kind: str) -> None:
    """Code that is not compiled would get the attribute."""
    assert not {*getattr(records, kind).names} & {*dir(np.void)}


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
