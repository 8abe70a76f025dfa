"""A machine without a network, only with its loopback, in a network namespace of its own."""

import subprocess
import sys
from pathlib import Path

import pytest

from echelon.bridge.can.bus_url import why_no_multicast
from support.runs import summary_of

RUN = (sys.executable, "-m", "echelon", "run")


def offline(*command: str | Path) -> subprocess.CompletedProcess[str]:
    """Runs a command where only `lo` is up.  Skips the test where no namespace can be made."""
    words = [
        "unshare",
        "--map-root-user",
        "--net",
        "sh",
        "-c",
        'ip link set lo up && exec "$@"',
        "sh",
        *map(str, command),
    ]
    done = subprocess.run(words, capture_output=True, text=True, timeout=600, check=False)
    if done.stderr.startswith("unshare:"):
        pytest.skip(f"no network namespace can be made here: {done.stderr.strip()}")
    return done


def test_the_default_command_runs_and_says_that_it_makes_no_frames(tmp_path: Path) -> None:
    done = offline(*RUN, "lab", "--set", "duration=0.2", "--set", "claims=[]", "--quiet", "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    assert "no CAN frames: no vcan0 is up, and multicast cannot be used here" in done.stderr
    assert summary_of(tmp_path / "run")["can"] is None
    assert not (tmp_path / "run" / "can.log").exists()


def test_a_closed_torque_path_is_refused_in_one_line(tmp_path: Path) -> None:
    done = offline(*RUN, "drives", "--out", tmp_path / "run")
    assert (done.returncode, done.stdout) == (2, "")
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        "echelon: the closed torque path needs a bus: no vcan0 is up, and multicast cannot be used here: "
    )


def test_with_a_network_multicast_can_be_used() -> None:
    assert why_no_multicast() is None
