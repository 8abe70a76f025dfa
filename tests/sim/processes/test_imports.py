"""What the processes of a run import: it costs time at each start, and memory in each process."""

import subprocess
import sys

import pytest

from support.runs import ROOT

HEAVY = ("pydantic", "numpy.random", "scipy", "matplotlib", "cantools", "can", "mcap", "rich", "tomlkit", "asyncio")


@pytest.mark.parametrize(
    ("module", "needed"),
    [
        ("echelon.sim.processes.process", set()),
        ("echelon.sim.processes.watchers", {"mcap"}),
        ("echelon.bridge.protocols.registry", set()),
        ("echelon.bridge.roles.drive_bank", {"numpy.random"}),
    ],
)
def test_a_process_imports_what_it_needs(module: str, needed: set[str]) -> None:
    program = f"import sys, {module}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) & set(HEAVY) <= needed
