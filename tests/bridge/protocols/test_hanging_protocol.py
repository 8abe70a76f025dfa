"""A user's drive protocol that never returns: it is found and named, before a run and in it."""

import re
import shutil
from pathlib import Path

import pytest

from echelon.bridge.can.log_files import frames_in
from echelon.planning.loading import ScenarioError
from echelon.sim.parts import loading
from support.runs import EXAMPLES, echelon, reasons, summary_of

CHANGES = {
    # the host's side, from 0.3 s on; the drive's; and on the mirrored path, which knows no time, from the 31st torque of r2 on
    "bridge": (
        "class MyHost(CyclicHost):",
        "def command(self, *all):\n        while all and all[0] > 3e8: pass",
        "command",
    ),
    "drives": (
        "class MyDrive(CyclicDrive):",
        "def advance(self, time_ns):\n        while time_ns > 3e8: pass",
        "advance",
    ),
    "mirror": (
        "class MyHost(CyclicHost):",
        "said = 0\n    def mirror(self, *all):\n        self.said += any(all[:2]) and self.plan.node_ids[0] == 1\n"
        "        while self.said > 30: pass",
        "mirror",
    ),
}


def hanging(folder: Path, part: str) -> Path:
    """Writes the protocol of which a part hangs; returns its scenario."""
    shutil.copy(EXAMPLES / "my_drive.toml", folder)
    owner, code, method = CHANGES[part]
    text = (EXAMPLES / "my_drive.py").read_text()
    (found,) = [row for row in text.splitlines() if row.startswith(owner)]
    arguments = "time_ns" if method == "advance" else "*all"
    text = text.replace(found, f"{found}\n    {code}\n        return super().{method}({arguments})\n")
    (folder / "my_drive.py").write_text(text)
    return folder / "my_drive.toml"


def test_one_that_hangs_at_once_is_found_before_a_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loading, "LOAD_PATIENCE_S", 0.5)
    scenario = hanging(tmp_path, "mirror")
    code = (tmp_path / "my_drive.py").read_text().replace("self.said > 30", "True")
    (tmp_path / "my_drive.py").write_text(code)
    with pytest.raises(ScenarioError, match=r"my_drive\.py:MyProtocol of r1 takes longer than 0\.5 s to be tried"):
        loading.load(scenario)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("part", "engine"),
    [
        ("bridge", "inprocess"),
        ("bridge", "processes"),
        ("drives", "inprocess"),
        ("drives", "processes"),
        ("mirror", "inprocess"),
        ("mirror", "processes"),
    ],
)
def test_one_that_hangs_in_a_run_is_named_and_nothing_is_lost(tmp_path: Path, part: str, engine: str) -> None:
    scenario = hanging(tmp_path, part)
    sets = ("--set", "claims=[]", *(("--set", "can.path=mirror") if part == "mirror" else ()))
    options = ("--quiet", "--no-report", "--stall-timeout", "3", "--out", tmp_path / "run")
    done = echelon("run", scenario, "--engine", engine, *sets, *options)
    assert done.returncode == 3, done.stderr
    assert "Traceback" not in done.stderr
    who = "drives" if part == "drives" else "bridge"
    said = done.stderr.strip().splitlines()[-1]
    assert re.match(rf"echelon: stalled for 3 s at t = [0-9.]+ s: everyone waits for {who}\b", said), said
    assert "which runs my_drive.py:MyProtocol" in said
    summary = summary_of(tmp_path / "run")
    assert said.removeprefix("echelon: ") in reasons(summary)
    assert summary["instants"] > 25
    if part != "drives":
        frames = [frame for _, _, frame in frames_in(tmp_path / "run" / "can.log") if frame.can_id < 0x380]
        stopped = [robot for robot in range(3) if frames[-3:].count((0x300 + robot, bytes(5), False))]
        assert stopped == ([0, 2] if part == "mirror" else [0, 1, 2])  # r2's host hangs here, too
