"""sim.measured_links: what a scenario keeps whose links get measured delays, and runs that have no latencies."""

import shutil
import tomllib
from pathlib import Path
from typing import Any

import pytest

import echelon
from echelon.errors import UserError
from echelon.messages import Channel
from echelon.plan.delay_tables import LOST
from echelon.sim.measured_links import measured, trace_name, write_traces
from echelon.sim.parts.loading import load
from echelon.sim.recording.arrivals import read_arrivals
from support.arrivals import write_arrivals
from support.recordings import record
from support.runs import EXAMPLES, SCENARIOS

WALL = {"engine": "processes", "clock": "wall"}
LINKS = (
    'links=[{name="up",channel="state",delay=0.5,loss=0.5,policy="extrapolate"},'
    '{channel="command",loss=0.2,policy="zero",timeout=0.03}]'
)
EVENTS = (
    'events=[{kind="blackout",at=0.1,duration=0.1,link="up"},{kind="cut_off",at=0.2,duration=0.1,member="g1"},'
    '{kind="blackout",at=0.3,duration=0.05,channel="command"}]'
)
ROWS = [(0, 0, 2_000_000, 5_000_001), (0, 1, 12_000_000, 13_000_000), (0, 3, 30_000_000, 31_000_000)]
"""Arrivals at g1/r1"""


def on_a_wall_clock(folder: Path, scenario: str, *overrides: str) -> Path:
    """Makes the folder of a run with some arrivals."""
    record(folder, scenario, *overrides, metadata=WALL)
    write_arrivals(folder, ROWS)
    return folder


def table_of(path: Path) -> dict[str, Any]:
    """Returns a scenario as it is written."""
    return tomllib.loads(path.read_text())


def test_each_link_takes_its_delays_and_keeps_what_happens_to_late_messages(tmp_path: Path) -> None:
    folder = on_a_wall_clock(tmp_path / "run", "lab", LINKS, EVENTS)
    scenario, *traces = write_traces(folder, measured(folder).arrivals, tmp_path / "out")
    assert len(traces) == 24
    _, plan = load(scenario)
    _, before = load(folder / "scenario.toml")
    assert [link.delays.delays_ns[:5] for link in plan.links[:2] if link.delays] == [  # type: ignore[union-attr]
        (3_000_001, 1_000_000, LOST, 1_000_000, LOST),
        (LOST,) * 5,
    ]
    for link, old in zip(plan.links, before.links, strict=True):
        assert (link.policy, link.timeout_ns) == (old.policy, old.timeout_ns)
        assert (link.loss, link.duplicates, link.fifo) == (0, 0, False)
        assert len(link.delays.delays_ns) == 41  # type: ignore[union-attr]
    events = table_of(scenario)["events"]
    assert [event["kind"] for event in events] == ["cut_off", "blackout"]  # no rule is called "up" any more
    assert (tmp_path / "out" / trace_name(plan, plan.links[0])).read_text().splitlines()[:4] == [
        "# one-way delays [s]: g1 to g1/r1, command, message by message",
        "delay",
        "0.003000001",
        "0.001000000",
    ]


def test_of_a_closed_torque_path_other_rules_stay_and_shafts_get_none(tmp_path: Path) -> None:
    rules = 'links=[{channel="torque",loss=0.1},{channel="state",loss=0.2}]'
    folder = on_a_wall_clock(tmp_path / "run", "drives", rules)
    found = measured(folder)
    assert {link.channel for link in found.links} == {"command", "state", "reference", "group_state", "wheels"}
    scenario, *traces = write_traces(folder, found.arrivals, tmp_path / "out")
    assert len(traces) == 24
    _, plan = load(scenario)
    assert plan.bridge is not None
    to_bridge = [link for link in plan.links_into(plan.bridge.index) if link.channel is Channel.TORQUE]
    assert {link.loss for link in to_bridge} == {0.1}
    assert {link.loss for link in plan.links if link.channel is Channel.STATE} == {0.0}


def test_a_law_of_the_users_comes_along(tmp_path: Path) -> None:
    shutil.copy(EXAMPLES / "my_laws.py", tmp_path)
    shutil.copy(SCENARIOS / "lab.toml", tmp_path / "mine.toml")
    out = tmp_path / "run"
    changes = {"duration": 0.1, "claims": [], "law": {"use": "my_laws.py:SlidingMode", "epsilon": [0.5, 0.5]}}
    echelon.run(tmp_path / "mine.toml", changes, engine="inprocess", out=out, can="none", quiet=True)
    write_arrivals(out, ROWS)
    arrivals = read_arrivals(out / "arrivals.bin", load(out / "scenario.toml")[1])
    scenario, *_ = write_traces(out, arrivals, tmp_path / "out")
    assert (tmp_path / "out" / "my_laws.py").read_text() == (EXAMPLES / "my_laws.py").read_text()
    assert load(scenario)[1].law.use == "my_laws.py:SlidingMode"


def test_runs_without_latencies_are_named(tmp_path: Path) -> None:
    virtual = record(tmp_path / "virtual", "lab", metadata={"engine": "processes", "clock": "virtual"})
    alone = record(tmp_path / "alone", "lab", metadata={"engine": "inprocess", "clock": "wall"})
    old = record(tmp_path / "old", "lab", metadata=WALL)
    empty = record(tmp_path / "empty", "lab", metadata=WALL)
    (empty / "arrivals.bin").touch()
    for folder, says in [
        (virtual, f"{virtual}: a run in virtual time; its latencies are those that its scenario gives the links"),
        (alone, f"{alone}: a run in one process; messages take no time there"),
        (old, f"{old}/arrivals.bin: not there; the run did not note when messages arrived"),
        (empty, f"{empty}/arrivals.bin: holds no arrivals"),
        (tmp_path / "none", f"{tmp_path}/none/run.mcap: No such file or directory"),
    ]:
        with pytest.raises(UserError) as raised:
            measured(folder)
        assert str(raised.value).startswith(says)
        assert "\n" not in str(raised.value)


def test_in_a_notebook(tmp_path: Path) -> None:
    run = echelon.run(
        "lab", {"duration": 0.3, "claims": []}, clock="wall", out=tmp_path / "run", can="none", quiet=True
    )
    found = run.latencies()
    assert len(found.links) == 24
    frame = found.table.to_pandas()
    assert frame.loc[("g1/r1", "g1", "state"), "sent"] == 31
    assert 0 < frame["latency_p50"].min() <= frame["latency_max"].max()
    assert len(found.messages) == sum(link.delivered for link in found.links)
    assert str(found).startswith(f"{tmp_path}/run: one-way latencies")
    with pytest.raises(UserError, match="virtual time"):
        echelon.run("lab", {"duration": 0.1}, out=tmp_path / "virtual", can="none", quiet=True).latencies()
    with pytest.raises(UserError, match="has no folder"):
        type(run)(run.trace, run.summary).latencies()
