"""The display of a run: lines without a terminal, a table in a terminal."""

from __future__ import annotations

import io
import re
import threading

import numpy as np
import pytest

from echelon.bridge.reports import BridgeProgress
from echelon.controller.trajectory import make_trajectory
from echelon.controller.transformation import Transformation
from echelon.messages import STATE_FIELDS, Channel
from echelon.runtime.link import LinkCounts
from echelon.sim.processes.outcome import Progress
from echelon.sim.view import live
from echelon.sim.view.live import Display
from support.runs import plan_of, until

PLAN = plan_of("paper")


class Terminal(io.StringIO):
    """A stream that claims to be a terminal."""

    def isatty(self) -> bool:
        """Returns True."""
        return True


def progress_with(errors: dict[str, float], time_ns: int = 2_000_000_000) -> Progress:
    """Returns the progress of a run whose blocks have errors of these norms [m]."""
    cbt = Transformation(PLAN)
    shape = cbt.desired(make_trajectory(PLAN.trajectory).at(time_ns * 1e-9)[0]).copy()
    flat = shape.reshape(-1)
    for block in PLAN.blocks:
        flat[block.offset] += errors.get(block.name, 0.0)
    states = np.zeros((len(PLAN.robots), len(STATE_FIELDS)))
    states[:, :2] = cbt.backward(flat.reshape(shape.shape))
    return Progress("running", time_ns, time_ns, states, 1234, 1.0, BridgeProgress("virtual:x", 0.25, 12))


def test_errors_of_blocks() -> None:
    wanted = {"g1": 0.5, "inter": 0.25, "centroid": 3.0}
    errors = Display(PLAN, io.StringIO()).errors(progress_with(wanted))
    assert list(errors) == [block.name for block in PLAN.blocks]
    assert errors == pytest.approx({name: wanted.get(name, 0.0) for name in errors}, abs=1e-12)
    assert Display(PLAN, io.StringIO()).errors(Progress()) == {}


def test_errors_of_a_diverged_run_are_no_error() -> None:
    progress = progress_with({})
    progress.states[:] = np.inf
    assert not np.isfinite(list(Display(PLAN, io.StringIO()).errors(progress).values())).any()


def test_plain_lines_now_and_then(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [100.0]
    monkeypatch.setattr(live.time, "monotonic", lambda: now[0])
    stream = io.StringIO()
    display = Display(PLAN, stream)
    for _ in range(50):  # ten seconds
        display.show(progress_with({"g1": 0.5}))
        now[0] += 0.2
    display.close()
    lines = stream.getvalue().splitlines()
    assert 4 <= len(lines) <= 5
    assert all("t 2.00 of 12 s" in line and "g1 0.5 m" in line and "CAN load 25 %" in line for line in lines)
    assert "\x1b" not in stream.getvalue()


def test_a_note_is_told_once_and_at_once() -> None:
    stream = io.StringIO()
    display = Display(PLAN, stream, quiet=True)
    for note in ("stalled", "stalled", "goes on", "goes on"):
        display.show(Progress(note=note))
    display.close()
    assert stream.getvalue().splitlines() == ["stalled", "goes on"]


def test_a_table_in_a_terminal() -> None:
    stream = Terminal()
    display = Display(PLAN, stream)
    display.say("heading [not markup]")
    display.show(progress_with({"centroid": 3.0}))
    display.close()
    display.close()
    text = stream.getvalue()
    assert "\x1b" in text
    assert "heading [not markup]" in text
    assert "virtual:x" in text
    assert "centroid" in text
    display.say("after")
    assert stream.getvalue().endswith("after\n")


def test_the_table_has_the_links_if_they_are_late() -> None:
    rules = 'links=[{name="up",channel="state",delay=0.02},{channel="command",loss=0.1}]'
    plan = plan_of("paper", rules)
    progress = progress_with({})
    progress.hear_links(
        LinkCounts(
            link.source, link.receiver, link.channel, 100, 70, 20, 10, 60, 5, 1e6, 80_000_000, 1, 2, 40_000_000, 3
        )
        for link in plan.links
        if link.channel is Channel.COMMAND or link.name
    )
    for shown, there in ((plan, True), (PLAN, False)):
        stream = Terminal()
        display = Display(shown, stream)
        display.show(progress)
        display.close()
        text = " ".join(re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", stream.getvalue()).split())
        for name in ("up", "command"):
            assert (f"{name} 900 180 90 27 1e-09 2e-09 0.04 0.08" in text) == there


class Stopped(io.StringIO):
    """A terminal that is stopped (Ctrl-S), or a pipe that is full and that nobody reads."""

    def __init__(self) -> None:
        super().__init__()
        self.go_on = threading.Event()

    def write(self, text: str) -> int:
        self.go_on.wait()
        return super().write(text)


def test_who_shows_does_not_wait_for_a_terminal_that_is_stopped(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "CLOSE_S", 0.1)
    stream = Stopped()
    display = Display(PLAN, stream)
    for number in range(3):
        display.say(f"line {number}")
        display.show(progress_with({}))
    display.close()
    assert stream.getvalue() == ""
    stream.go_on.set()
    assert until(lambda: "line 2" in stream.getvalue())


def test_quiet_in_a_terminal_leaves_it_alone() -> None:
    stream = Terminal()
    display = Display(PLAN, stream, quiet=True)
    display.show(progress_with({}))
    display.close()
    assert stream.getvalue() == ""
