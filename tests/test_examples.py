"""The examples run as they stand, whatever else lies beside them; and the same parts installed, by their names."""

import os
import shutil
import subprocess
import sys
import zipfile
from collections.abc import Sequence
from pathlib import Path

import pytest

from echelon.sim.parts.loading import load
from support.awkward import write_awkward_files
from support.runs import ROOT, summary_of

EXAMPLES = ROOT / "examples"
COMMAND = Path(sys.executable).parent / "echelon"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A copy of the examples, with files of awkward names beside them."""
    folder = tmp_path / "mine"
    shutil.copytree(EXAMPLES, folder)
    write_awkward_files(folder)
    return folder


def echelon(
    folder: Path, *arguments: str | Path, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    """Runs the command in a folder, as a user does."""
    return subprocess.run(
        [COMMAND, *map(str, arguments)], cwd=folder, env=env, capture_output=True, text=True, timeout=600
    )


def run(folder: Path, out: str, *arguments: str, env: dict[str, str] | None = None) -> str:
    """Runs mine.toml; it must hold; returns its digest."""
    done = echelon(folder, "run", "mine.toml", "--quiet", "--no-report", "--out", out, *arguments, env=env)
    assert done.returncode == 0, done.stdout + done.stderr
    digest: str = summary_of(folder / out)["trace_digest"]
    return digest


def test_examples_hold_in_process_and_as_processes_alike(folder: Path) -> None:
    """With all that they claim; and the run's folder runs again."""
    digest = run(folder, "one", "--engine", "inprocess")
    assert run(folder, "many") == digest
    assert sorted(part["use"] for part in summary_of(folder / "many")["parts"]) == [
        "my_laws.py:SlidingMode",
        "my_paths.py:Eight",
        "my_plants.py:Slipping",
    ]
    assert len(summary_of(folder / "many")["claims"]) == 3
    again = echelon(
        folder, "run", "many/scenario.toml", "--engine", "inprocess", "--quiet", "--no-report", "--out", "x"
    )
    assert again.returncode == 0
    assert summary_of(folder / "x")["trace_digest"] == digest


@pytest.mark.parametrize("engine", ["inprocess", "processes"])
def test_examples_run_on_a_wall_clock(folder: Path, engine: str) -> None:
    run(folder, "wall", "--clock", "wall", "--engine", engine, "--set", "duration=3.0", "--set", "claims=[]")
    assert summary_of(folder / "wall")["instants"] > 200


def test_examples_are_as_short_as_their_page_says() -> None:
    """Lines of the class, without blank ones and its docstring."""
    for name, most in (("my_laws", 7), ("my_plants", 5), ("my_paths", 6)):
        lines = (EXAMPLES / f"{name}.py").read_text().splitlines()
        first = next(at for at, line in enumerate(lines) if line.startswith("class"))
        code = [line for line in lines[first:] if line.strip() and not line.strip().startswith('"""')]
        assert len(code) <= most, name


def test_the_page_shows_what_the_examples_are() -> None:
    """Each block of code in docs/add-a-law.md that begins with the name of a file is a part of that file."""
    page = (ROOT / "docs" / "add-a-law.md").read_text(encoding="utf-8")
    shown = [block for block in page.split("```python\n")[1:] if block.startswith("# examples/")]
    assert len(shown) == 3
    for block in shown:
        title, _, code = block.partition("```")[0].partition("\n")
        assert code.strip() in (ROOT / title.removeprefix("# ")).read_text(encoding="utf-8"), title


def test_the_linear_law_of_the_page_can_be_analysed(folder: Path) -> None:
    page = (ROOT / "docs" / "add-a-law.md").read_text(encoding="utf-8")
    (code,) = [block for block in page.split("```python\n") if block.startswith("# pd_laws.py")]
    (folder / "pd_laws.py").write_text(code.partition("```")[0], encoding="utf-8")
    law = ("--set", 'law={use="pd_laws.py:PD",epsilon=[0.5,0.5]}')
    done = echelon(folder, "analyse", "mine.toml", *law)
    assert done.returncode == 0, done.stderr
    built_in = 'law={use="linear",epsilon=[0.5,0.5],gains=[{k1=0.25,k2=1.0}]}'
    assert done.stdout == echelon(folder, "analyse", "mine.toml", "--set", built_in).stdout
    assert "  settles; errors shrink e-fold in " in done.stdout


def wheel(folder: Path, modules: Sequence[str], entry_points: str) -> Path:
    """Makes a distribution of some modules of the examples."""
    path, info = folder / "my_parts-1.0-py3-none-any.whl", "my_parts-1.0.dist-info"
    files = {f"my_parts_{name}.py": (EXAMPLES / f"{name}.py").read_text() for name in modules}
    files[f"{info}/METADATA"] = "Metadata-Version: 2.1\nName: my-parts\nVersion: 1.0\n"
    files[f"{info}/WHEEL"] = "Wheel-Version: 1.0\nGenerator: tests\nRoot-Is-Purelib: true\nTag: py3-none-any\n"
    files[f"{info}/entry_points.txt"] = entry_points
    files[f"{info}/RECORD"] = "".join(f"{name},,\n" for name in [*files, f"{info}/RECORD"])
    with zipfile.ZipFile(path, "w") as archive:
        for name, text in files.items():
            archive.writestr(name, text)
    return path


ENTRY_POINTS = """
[echelon.laws]
sliding_mode = my_parts_my_laws:SlidingMode
broken = my_parts_my_laws:Nothing
plant_for_a_law = my_parts_my_plants:Slipping
[echelon.plants]
slipping = my_parts_my_plants:Slipping
[echelon.trajectories]
eight = my_parts_my_paths:Eight
[echelon.protocols]
my_protocol = my_parts_my_drive:MyProtocol
"""


def test_installed_parts_are_used_by_name(tmp_path: Path) -> None:
    distribution = wheel(tmp_path, ("my_laws", "my_plants", "my_paths", "my_drive"), ENTRY_POINTS)
    target = tmp_path / "installed"
    pip = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--no-index",
        "--no-deps",
        "--target",
        target,
        distribution,
    ]
    subprocess.run(pip, check=True, capture_output=True, timeout=600)
    env = os.environ | {"PYTHONPATH": str(target)}
    folder = tmp_path / "mine"
    folder.mkdir()
    text = (EXAMPLES / "mine.toml").read_text()
    for file, name in (
        ("my_laws.py:SlidingMode", "sliding_mode"),
        ("my_plants.py:Slipping", "slipping"),
        ("my_paths.py:Eight", "eight"),
    ):
        text = text.replace(file, name)
    (folder / "mine.toml").write_text(text)
    digest = run(folder, "many", "--set", "duration=10.0", env=env)
    assert run(folder, "one", "--engine", "inprocess", "--set", "duration=10.0", env=env) == digest
    shutil.copytree(EXAMPLES, tmp_path / "files")
    assert run(tmp_path / "files", "one", "--engine", "inprocess", "--set", "duration=10.0") == digest
    parts = summary_of(folder / "many")["parts"]
    assert {part["use"] for part in parts} == {"sliding_mode", "slipping", "eight"}
    assert all(part["file"] is None for part in parts)
    drives = ("can.path=closed", "robot.drive.protocol=my_protocol", "duration=0.5", "claims=[]")
    sets = [argument for override in drives for argument in ("--set", override)]
    run(folder, "closed", "--engine", "inprocess", *sets, env=env)
    rows = summary_of(folder / "closed")["can"]["robots"].values()
    assert {(row["protocol"], row["enabled"], row["fault"]) for row in rows} == {("my_protocol", True, "")}
    assert all(row["largest"] > 0.01 for row in rows)
    for use, says in (
        ("sliding", "did you mean 'sliding_mode'?"),
        ("broken", "the installed my_parts_my_laws:Nothing cannot be loaded: AttributeError"),
        ("plant_for_a_law", "plant_for_a_law must be a class derived from echelon.Law"),
    ):
        done = echelon(folder, "validate", "mine.toml", "--set", f"law.use={use}", env=env)
        assert done.returncode == 2
        assert says in done.stderr
        assert len(done.stderr.strip().splitlines()) == 1


def test_examples_load() -> None:
    _, plan = load(EXAMPLES / "mine.toml")
    assert plan.law.parameters == {"reach": 0.25, "width": 0.1}
