"""Hypothesis draws the same examples in every run, and a loaded machine is no failure.  Matrices are small: one thread."""

import os
import signal
from pathlib import Path
from typing import Final

# Before numpy is imported: on a busy machine its threads wait for each other, a hundred times as long as they compute.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import pytest
from hypothesis import settings

TESTS: Final = Path(__file__).parent
LONG: Final = (
    "test_vcan.py",
    "sim/processes/test_stopping_table.py",
    "sim/parts/test_foreign_parts.py",
    "cli/test_cli.py",
    "sim/processes/test_supervisor.py",
    "sim/batch/test_delay_boundary.py",
    "cli/test_cli_help.py",
    "sim/processes/test_stopping.py",
    "cli/test_analyse.py",
    "chaos/test_chaos.py",
    "controller/test_largest_delay.py",
    "sim/processes/test_closed_processes.py",
    "cli/test_cli_scenarios.py",
    "test_wheel.py",
    "sim/test_notebook.py",
    "sim/test_recovery.py",
    "cli/test_sweep_command.py",
    "sim/sweep/test_sweep.py",
    "cli/test_recordings.py",
    "controller/test_linear_run.py",
    "sim/test_diverged_runs.py",
)
"""Files of tests that take 40 s and more, the longest first"""

settings.register_profile("ci", derandomize=True, deadline=None, database=None)
settings.load_profile("ci")


def pytest_configure() -> None:
    """Under a shell's `nohup` SIGHUP is ignored, also in the runs that tests start; but tests end runs by it."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Long files come first, so that processes that share the files are done at about the same time."""
    places = {TESTS / name: at for at, name in enumerate(LONG)}
    items.sort(key=lambda item: places.get(item.path, len(LONG)))
