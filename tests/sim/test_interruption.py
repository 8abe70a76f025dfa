"""Signals that ask a run to end: noted once, and never lost because somebody kept the exception to himself."""

import shutil
import signal
import sys
from pathlib import Path

import pytest

from echelon.sim.interruption import Interruption, Raises, interruption
from support.runs import ROOT, echelon

MY_LAWS = ROOT / "examples" / "my_laws.py"

LAW = """
import os
import signal

try:
    signal.raise_signal(signal.SIGINT)
except BaseException:
    with open("swallowed", "a"):
        pass

"""


def test_an_interrupt_that_a_library_kept_to_itself_is_raised_again() -> None:
    with interruption() as noted:
        try:
            signal.raise_signal(signal.SIGTERM)
        except KeyboardInterrupt:
            pass
        assert noted.asked
        before = signal.getsignal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt), interruption():
            pytest.fail("the run began")
        assert signal.getsignal(signal.SIGTERM) == before


@pytest.mark.filterwarnings("error")
def test_an_interrupt_that_python_ignores_is_noted_and_nothing_is_printed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A signal may come in a destructor, or as an import ends: Python prints what is raised there, and goes on."""
    told: list[str] = []
    monkeypatch.setattr(sys, "unraisablehook", lambda ignored: told.append(str(ignored.exc_value)))

    class Signalled:
        def __del__(self) -> None:
            signal.raise_signal(signal.SIGTERM)

    class Broken:
        def __del__(self) -> None:
            raise ValueError("broken")

    with interruption() as noted:
        Signalled()
        assert noted.asked
        Broken()
        with pytest.raises(KeyboardInterrupt), interruption():
            pytest.fail("the run began")
    Broken()
    assert told == ["broken", "broken"]


def test_a_context_inside_another_notes_for_itself() -> None:
    before = [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)]
    with interruption() as outer:
        with interruption() as inner, inner.during(Raises.NONE):
            signal.raise_signal(signal.SIGTERM)
            assert inner.asked
        assert not outer.asked
    assert [signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)] == before


def test_signals_that_come_together_are_one_request() -> None:
    noted = Interruption(raises=Raises.SECOND)
    noted.note(signal.SIGINT)
    noted.note(signal.SIGTERM)  # raises nothing
    assert noted.asked


@pytest.mark.parametrize("engine", ["inprocess", "processes"])
def test_a_users_file_that_swallows_the_interrupt_does_not_make_the_run_go_on(engine: str, tmp_path: Path) -> None:
    swallowed = tmp_path / "swallowed"
    (tmp_path / "patient.py").write_text(LAW.replace('"swallowed"', repr(str(swallowed))) + MY_LAWS.read_text())
    scenario = tmp_path / "mine.toml"
    scenario.write_text((ROOT / "examples" / "mine.toml").read_text().replace("my_laws.py", "patient.py"))
    for other in ("my_plants.py", "my_paths.py"):
        shutil.copy(ROOT / "examples" / other, tmp_path)
    done = echelon("run", scenario, "--engine", engine, "--quiet", "--no-report", "--out", tmp_path / "run")
    assert swallowed.exists()
    assert (done.returncode, done.stderr) == (3, "echelon: interrupted\n")
    assert not (tmp_path / "run" / "summary.json").exists()
