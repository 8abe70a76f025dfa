"""An exit code is about the work of a command, whatever becomes of what it prints."""

import os
import subprocess
import sys
from pathlib import Path
from subprocess import PIPE

import pytest

from echelon.sim.recording.mcap_reader import read_trace
from support.runs import echelon, plan_of, start_echelon, summary_of

FAILS = ("lab", "--set", "duration=0.5", "--set", "claims=[{block='*', settled_by=0.4}]", "--can", "none")


def run_without_reader(*arguments: str | Path, of: str = "stdout") -> int:
    """Runs a command whose standard output, or standard error, nobody reads; returns its exit code."""
    read, write = os.pipe()
    os.close(read)
    streams = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL} | {of: write}
    try:
        return subprocess.run(
            [sys.executable, "-m", "echelon", *map(str, arguments)], **streams, timeout=600, check=False
        ).returncode
    finally:
        os.close(write)


@pytest.mark.parametrize("of", ["stdout", "stderr"])
@pytest.mark.parametrize("engine", ["inprocess", "processes"])
def test_a_verdict_stays_and_the_folder_is_full_when_nobody_reads(tmp_path: Path, of: str, engine: str) -> None:
    folder = tmp_path / "run"
    assert run_without_reader("run", *FAILS, "--engine", engine, "--out", folder, of=of) == 1
    assert summary_of(folder)["verdict"]["word"] == "FAILS"
    assert (folder / "report.html").stat().st_size > 10_000


def test_commands_that_end_by_themselves_do_so_without_a_reader() -> None:
    assert run_without_reader("scenarios") == 0
    assert run_without_reader("validate", "nowhere.toml", of="stderr") == 2


def test_what_prints_until_it_is_stopped_ends_with_its_reader(tmp_path: Path) -> None:
    with start_echelon("drives", "lab", "--can", "udp_multicast:239.74.163.9:43999", "--json") as command:
        try:
            assert command.stdout is not None
            assert command.stdout.readline()
            command.stdout.close()
            assert command.wait(60) == 141
        finally:
            command.kill()


FULL = "echelon: standard output: No space left on device\n"


def run_onto_a_full_disk(*arguments: str | Path) -> "subprocess.CompletedProcess[str]":
    """Runs a command whose standard output is a full device."""
    words = [sys.executable, "-m", "echelon", *map(str, arguments)]
    with Path("/dev/full").open("w") as full:
        return subprocess.run(words, stdout=full, stderr=PIPE, text=True, timeout=600, check=False)


@pytest.mark.parametrize("arguments", [("scenarios",), ("dbc", "lab")])
def test_a_full_disk_is_said_and_is_no_success(arguments: tuple[str, ...]) -> None:
    done = run_onto_a_full_disk(*arguments)
    assert (done.returncode, done.stderr) == (3, FULL)


def test_a_run_onto_a_full_disk_leaves_whole_files(tmp_path: Path) -> None:
    folder, short = tmp_path / "run", ("--set", "duration=0.5", "--set", "claims=[]", "--set", "can.path=closed")
    done = run_onto_a_full_disk("run", "lab", *short, "--can", "auto", "--quiet", "--out", folder)
    assert (done.returncode, done.stderr) == (3, FULL)
    summary = summary_of(folder)
    assert (summary["verdict"]["word"], summary["run"]["failure"]) == ("HEALTHY", None)
    assert read_trace(folder / "run.mcap", plan_of("lab", "duration=0.5")).digest() == summary["trace_digest"]
    assert (folder / "can.log").read_bytes().count(b"\n") == summary["can"]["frames"]
    assert (folder / "report.html").read_text().endswith("</html>\n")


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_an_encoding_that_lacks_characters_is_no_failure(encoding: str) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "echelon", "analyse", "lab"],
        env=os.environ | {"PYTHONIOENCODING": encoding},
        stdout=PIPE,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0
    assert "lab" in done.stdout.decode(encoding)
    assert b"?" in done.stdout
    assert echelon("scenarios").returncode == 0
