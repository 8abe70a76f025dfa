"""A limit of the system that a run as processes does not fit is one line before it starts."""

import resource
import subprocess
import sys
from pathlib import Path

import pytest

from support.runs import ROOT, echelon

RUN = ("run", "paper", "--set", "duration=0.1", "--set", "claims=[]", "--quiet", "--no-report", "--out")


@pytest.mark.parametrize(
    ("limit", "value", "says"),
    [(resource.RLIMIT_NOFILE, 64, "ulimit -n"), (resource.RLIMIT_AS, 300 << 20, "ulimit -v")],
)
def test_a_limit_that_is_too_low_is_one_line(limit: int, value: int, says: str, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    done = echelon(*RUN, folder, preexec_fn=lambda: resource.setrlimit(limit, (value, value)))
    assert (done.returncode, done.stderr.count("\n"), folder.exists()) == (2, 1, False), done.stderr
    assert says in done.stderr
    assert "--engine inprocess" in done.stderr


def test_a_limit_of_files_that_may_be_raised_is_raised(tmp_path: Path) -> None:
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    done = echelon(*RUN, tmp_path / "run", preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_NOFILE, (30, hard)))
    assert done.returncode == 0, done.stderr


def test_threads_of_the_user_are_counted() -> None:
    """Root is not held to this limit, so the check is made as somebody else."""
    program = (
        "import os, resource\n"
        "from echelon.errors import UsageError\n"
        "from echelon.sim.processes.limits import check_limits\n"
        "if os.geteuid() == 0: os.setresuid(65534, 65534, 65534)\n"
        "resource.setrlimit(resource.RLIMIT_NPROC, (50, 50))\n"
        "try: check_limits(6)\n"
        "except UsageError as error: print(error)\n"
    )
    done = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert "ulimit -u" in done.stdout
    assert "6 processes needs 84" in done.stdout


def test_without_a_folder_for_temporary_files_it_is_one_line(tmp_path: Path) -> None:
    """Python itself tries some folders, and at last the present one; here none of them is there."""
    program = (
        "import sys, tempfile\n"
        "tempfile._candidate_tempdir_list = lambda: ['/nowhere']\n"
        "from echelon.cli import main\n"
        "sys.exit(main(sys.argv[1:]))\n"
    )
    command = [sys.executable, "-c", program, *RUN, str(tmp_path / "run")]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr.count("\n")) == (2, 1), done.stderr
    assert "TMPDIR" in done.stderr
