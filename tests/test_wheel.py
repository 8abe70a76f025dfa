"""The wheel holds all that the package needs, and works where there is neither this checkout nor a careful user.

It is built from a copy, since setuptools leaves `build/` and `*.egg-info` where it works.  It is installed into a new
environment beside its dependencies, those of requirements.lock as they stand in the environment of the tests: their files
are linked, so that no network is needed.  Neither the site-packages of the tests nor a .pth to them would do, since a
module that only a test depends on would be found there, and the editable install might be taken for the wheel.
"""

import os
import shutil
import stat
import subprocess
import sys
import zipfile
from importlib.metadata import distribution
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from support.runs import ROOT, summary_of

UV = Path(sys.executable).parent / "uv"
NOT_COPIED = shutil.ignore_patterns(".*", "__pycache__", "runs", "build", "dist", "*.egg-info")
SHORT = ("--set", "duration=0.1", "--set", "claims=[]")
LIMIT_S = 600.0  # a command takes 3 s where nothing else runs
HOSTILE = ("controller.py", "agents.py", "sim/__init__.py")
"""Files of a user with the names of folders of this checkout"""


def uv(*arguments: str | Path, cwd: Path = ROOT) -> None:
    """Runs uv without a network, and shows what it says if it fails."""
    command = [UV, *arguments, "--offline", "--no-config"]
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, timeout=600, check=False)
    assert done.returncode == 0, done.stderr


@pytest.fixture(scope="module")
def tree(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout, links as links."""
    return shutil.copytree(
        ROOT, tmp_path_factory.mktemp("copy") / "checkout", symlinks=True, ignore=NOT_COPIED, dirs_exist_ok=True
    )


@pytest.fixture(scope="module")
def wheel(tree: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of that copy, built by the setuptools of the lock."""
    folder = tmp_path_factory.mktemp("dist")
    uv("build", "--wheel", "--no-build-isolation", "--python", sys.executable, "--out-dir", folder, tree)
    (found,) = folder.glob("*.whl")
    return found


def link_dependencies(site: Path) -> None:
    """Puts the packages that requirements.lock names into a site-packages, as links to the files of this environment."""
    for line in (ROOT / "requirements.lock").read_text(encoding="utf-8").splitlines():
        if not line[:1].isalnum():
            continue  # a hash, or who asks for the package
        requirement = Requirement(line.rstrip(" \\"))
        if requirement.marker is not None and not requirement.marker.evaluate():
            continue
        for file in distribution(requirement.name).files or ():
            if ".." in file.parts or file.suffix == ".pyc":
                continue  # commands, and what Python makes anew
            target = site / file
            target.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(file.locate(), target)
            except OSError:  # another file system
                shutil.copyfile(file.locate(), target)


@pytest.fixture(scope="module")
def commands(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of commands of an environment that holds the wheel and its dependencies, nothing else."""
    environment = tmp_path_factory.mktemp("installed") / "venv"
    uv("venv", "--python", sys.executable, environment)
    link_dependencies(next(environment.glob("lib/python*/site-packages")))
    uv("pip", "install", "--no-deps", "--python", environment, wheel)
    uv("pip", "check", "--python", environment)  # nothing that it or a dependency asks for is missing or too old
    return environment / "bin"


@pytest.fixture(params=[(), HOSTILE], ids=["empty", "hostile"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A folder to work in: an empty one, and one with files that must not be imported."""
    for name in request.param:
        file = tmp_path / name
        file.parent.mkdir(exist_ok=True)
        file.write_text('raise RuntimeError("a file of the user was imported")\n')
    return tmp_path


def run(folder: Path, *command: str | Path) -> str:
    """Runs a command in a folder, outside of any environment; returns what it printed."""
    environment = {name: text for name, text in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    done = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, timeout=LIMIT_S, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "a file of the user was imported" not in done.stdout + done.stderr
    return done.stdout


def test_the_wheel_holds_each_file_of_the_package_and_no_other(tree: Path, wheel: Path) -> None:
    package = {
        str((Path(place) / name).relative_to(tree)): (Path(place) / name).read_bytes()
        for place, _, names in os.walk(tree / "echelon", followlinks=True)
        for name in names
    }
    with zipfile.ZipFile(wheel) as archive:
        entries = {one.filename: one for one in archive.infolist()}
        held = {name: archive.read(name) for name in entries if ".dist-info/" not in name}
    assert held == package
    assert not [name for name, one in entries.items() if stat.S_ISLNK(one.external_attr >> 16)]
    assert {name.partition("/")[0] for name in entries if ".dist-info/" not in name} == {"echelon"}
    assert {
        "echelon/py.typed",
        "echelon/deploy/scenarios/paper.toml",
        "echelon/deploy/lichtblick-layout.json",
        "echelon/deploy/vcan.sh",
        "echelon/bridge/protocols/cia402/drive.eds",
    } <= set(held)
    assert entries["echelon/deploy/vcan.sh"].external_attr >> 16 & 0o111 == 0o111


def test_nothing_in_the_wheel_tells_where_it_was_built(tree: Path, wheel: Path) -> None:
    places = [str(place).encode() for place in (ROOT, tree, sys.prefix, sys.base_prefix, f"{Path.home()}/")]
    with zipfile.ZipFile(wheel) as archive:
        told = [name for name in archive.namelist() if any(place in archive.read(name) for place in places)]
    assert told == []


def test_what_is_imported_is_the_wheel(commands: Path, tmp_path: Path) -> None:
    where = run(tmp_path, commands / "python", "-P", "-c", "import echelon.bridge.can as last; print(*last.__path__)")
    assert Path(where.strip()).is_relative_to(commands.parent)


@pytest.mark.timeout(4 * LIMIT_S)
def test_runs_and_their_report(commands: Path, folder: Path) -> None:
    names = ("paper", "lab", "drives")
    for name in names:
        run(folder, commands / "echelon", "run", name, *SHORT, "--out", f"runs/{name}")
        assert summary_of(folder / "runs" / name)["trace_digest"]
    run(folder, commands / "echelon", "report", *(f"runs/{name}" for name in names), "--out", "runs/all.html")
    page = (folder / "runs" / "all.html").read_text(encoding="utf-8")
    assert all(name in page for name in names)


def test_the_package_is_a_command_too(commands: Path, folder: Path) -> None:
    assert run(folder, commands / "python", "-m", "echelon", "scenarios") == run(
        folder, commands / "echelon", "scenarios"
    )
