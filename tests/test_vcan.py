"""Runs tests/vcan where there is a real vcan0: by deploy/vcan.sh, if need be in a guest, once for all of them."""

import ast
import faulthandler
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from echelon.bridge.can.bus_url import interface_is_up
from support.notice import say_not_tested
from support.vcan import vcan_required

ROOT = Path(__file__).parents[1]
INSIDE = ROOT / "tests" / "vcan"
SCRIPT = ROOT / "deploy" / "vcan.sh"
NAMES = [
    f"{file.stem}::{node.name}"
    for file in sorted(INSIDE.glob("test_*.py"))
    for node in ast.parse(file.read_text(encoding="utf-8")).body
    if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")
]
NO_VCAN = 125
LIMIT_S = 1500
"""Ten times what it takes where nothing else runs"""

if interface_is_up("vcan0"):
    pytest.skip("vcan0 is up: tests/vcan runs without a guest", allow_module_level=True)


def read_report(path: Path) -> dict[str, str]:
    """For each test, as `file::name`, what its cases said: nothing if all passed."""
    found: dict[str, str] = {}
    for case in ElementTree.parse(path).iter("testcase"):
        name = f"{case.get('classname', '').rpartition('.')[2]}::{case.get('name', '').partition('[')[0]}"
        said = "\n".join(f"{part.tag}: {part.get('message')}\n{part.text}" for part in case)
        found[name] = "\n".join(filter(None, (found.get(name), said)))
    return found


@pytest.fixture(scope="module")
def results(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """For each inner test that passed "", for the others what they said."""
    report = tmp_path_factory.mktemp("vcan") / "junit.xml"
    # fewer plugins, since imports are slow in a guest; its own folder for temporary files, in its own memory
    options = ["-q", "-p", "no:cacheprovider", "-p", "no:hypothesispytest", "--basetemp=/dev/shm/pytest"]
    command = [sys.executable, "-m", "pytest", *options, f"--junit-xml={report}", str(INSIDE)]
    faulthandler.cancel_dump_traceback_later()  # of pytest, for what hangs; this has a limit of its own
    run = subprocess.run(
        [str(SCRIPT), *command],
        cwd=ROOT,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
        check=False,
    )
    if run.returncode == NO_VCAN:
        why = f"no vcan can be had here: {run.stderr.strip()}"
        if vcan_required():
            pytest.fail(why)
        say_not_tested(request.config, "real vcan", f"{len(NAMES)} tests of CAN frames on a real interface. {why}")
        pytest.skip(why)
    if not report.exists():
        pytest.fail(f"exit status {run.returncode}\n{run.stdout}\n{run.stderr}")
    return read_report(report)


@pytest.mark.timeout(LIMIT_S + 20)
def test_all_of_them_ran(results: dict[str, str]) -> None:
    assert sorted(results) == sorted(NAMES), results
    assert NAMES


@pytest.mark.timeout(LIMIT_S + 20)
@pytest.mark.parametrize("name", NAMES)
def test_in_guest(results: dict[str, str], name: str) -> None:
    said = results.get(name, "did not run")
    if said.startswith("skipped") and not vcan_required():
        pytest.skip(said)
    assert not said, said
