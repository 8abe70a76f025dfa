"""The referee on logs of other programs: what is left out is counted, and is no finding against a robot."""

import random
from pathlib import Path

import pytest

from echelon.bridge.can.canlog import EPOCH_NS, CanLog
from echelon.bridge.referee.log import judge_log
from echelon.plan.plan import Plan
from support.closed_run import run
from support.runs import echelon

WALL_NS = 1_700_000_000_000_000_000


def logged(path: Path, protocol: str = "native", epoch_ns: int = EPOCH_NS) -> tuple[Plan, list[str]]:
    """Writes the log of a short closed run; returns its plan and the lines."""
    plan, frames = run(protocol)
    with CanLog(path, "can0", epoch_ns) as log:
        for time_ns, _, (can_id, data, remote) in frames:
            log.write(time_ns, can_id, data, 0, "", remote)
    return plan, path.read_text().splitlines(keepends=True)


@pytest.mark.parametrize("protocol", ["native", "odrive", "cia402"])
def test_lines_that_cannot_be_read_are_no_findings(protocol: str, tmp_path: Path) -> None:
    path = tmp_path / "can.log"
    plan, lines = logged(path, protocol)
    rng = random.Random(1)
    for _ in range(5):
        damaged = list(lines)
        first = rng.randrange(len(lines) - 400)
        for at in (*range(first, first + 300), *rng.sample(range(len(lines)), 3), len(lines) - 1):
            damaged[at] = damaged[at].replace("#", "?")
        path.write_text("".join(damaged))
        report = judge_log(path, plan)
        assert report.kinds == {}
        assert 301 <= report.left_out["lines that could not be read"] <= 304
        assert report.frames + report.left_out["lines that could not be read"] == len(lines)


def test_frames_that_are_missing_without_a_trace_are_findings_still(tmp_path: Path) -> None:
    path = tmp_path / "can.log"
    plan, lines = logged(path)
    path.write_text("".join(lines[:1500] + lines[1700:]))
    assert judge_log(path, plan).kinds["counter gap"] > 0
    path.write_text("".join(["?\n", *lines[:1500], *lines[1700:]]))  # damage long ago hides nothing
    assert judge_log(path, plan).kinds["counter gap"] > 0


@pytest.mark.parametrize("part", [(0, 1), (0.3, 0.8)])
def test_a_log_with_another_clock_may_begin_and_end_within_a_run(part: tuple[float, float], tmp_path: Path) -> None:
    path = tmp_path / "other.log"
    plan, lines = logged(path, epoch_ns=WALL_NS)
    first, last = (round(share * len(lines)) for share in part)
    path.write_text("".join(lines[first:last]))
    report = judge_log(path, plan)
    assert (report.kinds, report.frames) == ({}, last - first)


def test_the_name_of_another_interface_is_told_without_its_control_characters(tmp_path: Path) -> None:
    path = tmp_path / "other.log"
    plan, lines = logged(path)
    path.write_text("".join([*lines, "(1700000000.1) \x1b[31mEVIL\x1b[0m" + "x" * 500 + " 101#11\n"]))
    ((reason, count),) = judge_log(path, plan).left_out.items()
    assert count == 1
    assert reason.isprintable()
    assert len(reason) < 200


def test_frames_of_other_interfaces_are_counted_and_not_judged(tmp_path: Path) -> None:
    path = tmp_path / "other.log"
    plan, lines = logged(path, epoch_ns=WALL_NS)
    path.write_text(
        "".join(line.replace("can0", f"can{at % 40 or 0}") if at % 40 else line for at, line in enumerate(lines))
    )
    report = judge_log(path, plan, names={"can0": 0})
    assert report.frames == len(lines[::40])
    assert sum(report.left_out.values()) == len(lines) - report.frames
    assert len(report.left_out) <= 21
    assert judge_log(path, plan, names={}).frames == 0


def test_the_command_judges_the_log_of_another_program(tmp_path: Path) -> None:
    path = tmp_path / "other.log"
    _, lines = logged(path, epoch_ns=WALL_NS)
    path.write_text("".join(line.replace(" can0 ", " vcan3 ") for line in lines))
    options = ["can.path=closed", "can.bitrate=1000000", "can.bring_up=0.7", "claims=[]"]
    command = ("referee", "lab", *(word for each in options for word in ("--set", each)), "--log", path)
    refused = echelon(*command)
    assert refused.returncode == 2
    assert refused.stderr.count("\n") == 1
    assert f"{len(lines)} frames of the interface vcan3; --map" in refused.stderr
    with path.open("a") as file:
        file.write("(1700000009.0) can7 101#11\nwhat is this\n")
    judged = echelon(*command, "--map", "vcan3=can0")
    assert judged.returncode == 0, judged.stdout + judged.stderr
    assert f"{len(lines)} frames of 27 identifiers: no findings; left out: " in judged.stdout
    for wrong, says in (
        (("--map", "vcan3=can9"), "with BUS one of can0"),
        (("--can", "socketcan:vcan0"), "is for live buses"),
        (("--tolerance", "-1"), "must be 0 s or more"),
    ):
        done = echelon(*command, *wrong)
        assert (done.returncode, says in done.stderr) == (2, True)
    differences = (f" (000.{at % 7:06d})  can0  101   [2]  11 22\n".encode() for at in range(100))
    for content in (b"".join(differences), b"", b"\x00\xff" * 5000, b"LOGG", b"\x1f\x8b\x08"):
        path.write_bytes(content)
        done = echelon(*command)
        assert (done.returncode, done.stderr.count("\n"), done.stdout) == (2, 1, "")
