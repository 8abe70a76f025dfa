"""The benchmark's exchange is the same for every peer: whoever leaves something out does not end at the same values."""

import json
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench import batch, lockstep, product, vmas
from bench.can import Robots, bus_rates, closed_in_process
from bench.product import Row, table
from echelon.bridge.can.bus import open_bus
from echelon.bridge.can.bus_url import resolve_url
from echelon.bridge.protocols.native.codec import NativeCodec, Torque
from echelon.controller.laws.central import CentralLaw
from echelon.controller.potential import potential
from echelon.plan.plan import Array, Plan
from echelon.sim.processes.supervisor import Supervisor
from support.runs import ROOT


@pytest.mark.parametrize("peer", ["zenoh", "zenoh-secrets", "pipes"])
def test_a_peer_ends_where_the_exchange_ends(peer: str) -> None:
    # A process of its own: roles are forked, which a process that has used Zenoh must not do.
    command = [sys.executable, "-m", "bench.lockstep", "--peers", peer, "--ticks", "50", "--repeat", "1", "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=600, check=True)
    found = json.loads(done.stdout)
    assert not found["failures"]
    (run,) = found["peers"][peer]
    assert tuple(run["values"]) == lockstep.expected(50)
    assert tuple(run["values"]) != lockstep.expected(49)
    assert run["ticks_per_s"] > 0


def test_a_peer_that_is_not_installed_is_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lockstep, "installed", lambda module: False)
    assert lockstep.compare(["helics"], 10, 1) == ({"helics": []}, {"helics": "not installed"})


def test_table_quotes_medians() -> None:
    assert table([Row("start-up", "s", (3.0, 1.0, 2.0))]).splitlines()[1].split()[-3:] == ["2", "1", "3"]


def test_what_is_measured_on_the_bus_are_torques() -> None:
    robots, codec = Robots(), NativeCodec(0.001)
    with open_bus("virtual:bench") as bus:
        rate, frames = robots.send(bus, 3)
        assert bus.counts.sent == len(frames) == 3 * 9
    assert rate > 0
    torques = [codec.decode(can_id, data) for can_id, data, _ in frames]
    assert all(isinstance(torque, Torque) and torque.enable_left and torque.tau_left == -0.5 for torque in torques)
    assert len({torque.tau_right for torque in torques if isinstance(torque, Torque)}) == 3


def test_all_ways_over_a_bus_are_measured() -> None:
    url = resolve_url("auto")
    try:
        open_bus(url).close()
    except OSError as error:
        pytest.skip(f"no multicast here: {error}")
    rates = bus_rates(url, 5)
    assert set(rates) == {"bridge", "send", "plain send", "recv", "plain recv"}
    assert all(rate > 0 for rate in rates.values())


def test_a_closed_path_is_measured() -> None:
    assert closed_in_process(0.05) > 0


def test_loops_beside_the_batch_engine_do_the_same_work() -> None:
    plan = batch.lab(0.5)
    where = batch.batch(plan, 1)
    for loop in (batch.plain_numpy, batch.plain_python):
        assert np.abs(loop(plan, 1) - where).max() < 1e-9
    assert batch.rate(batch.batch, plan, 2) > 0


NEAR = ("avoidance.sensing_radius=1.2", "avoidance.avoidance_radius=0.6")
"""Changes of lab.toml by which robots avoid each other; as it is shipped, no two are near"""
WRONG = ("law.gains=[{k1=0.2525,k2=0.5}]", "law.gains=[{k1=0.25,k2=0.505}]", "law.lead=0.0", "law.epsilon=[0.5,0.505]",
         "trajectory.rate=0.202", "avoidance.sensing_radius=1.2")  # fmt: skip


@pytest.fixture(scope="module")
def lab() -> Plan:
    return batch.lab(2)


@pytest.fixture(scope="module")
def robots(lab: Plan) -> Array:
    """Where lab.toml's robots end."""
    return batch.plain_numpy(lab, 1)


def printed(where: Array) -> str:
    """Returns what the process with VMAS prints if its points end at `where`."""
    ways = ("env.step", "world.step", "points alone")
    return json.dumps({"rates": dict.fromkeys(ways, 1.0), "places": {way: [where.tolist()] for way in ways}}) + "\n"


def test_law_for_points_is_the_central_law_multiplied_out() -> None:
    plan = batch.lab(0.05, *NEAR)
    given, law = vmas.law_of(plan), CentralLaw(plan)
    matrix, moving, apart_of, push = (np.array(given[name]) for name in ("matrix", "moving", "apart", "push"))
    generator = np.random.default_rng(1)
    near = 0
    for step, wanted in enumerate(moving):
        p = np.array(given["start"]) + generator.uniform(-0.05, 0.05, (9, 2))
        v = generator.uniform(-1, 1, (9, 2))
        apart = apart_of @ p
        distance = np.hypot(*apart.T)
        slope = -(potential(distance + 1e-6, plan.avoidance) - potential(distance - 1e-6, plan.avoidance)) / 2e-6
        force = np.minimum(slope, plan.avoidance.force_limit)[:, None] * apart / distance[:, None]
        near += np.count_nonzero(slope)
        found = matrix @ np.vstack([p, v]) + wanted + push @ force
        assert found / given["mass"] == pytest.approx(law(step * given["period_s"], p, v), rel=1e-6, abs=1e-6)
    assert near > 20


def test_points_are_as_near_to_robots_as_steps_of_their_size_allow(lab: Plan, robots: Array) -> None:
    finer = batch.lab(2, "periods={acceleration=0.005,torque=0.005}")
    far = np.abs(vmas.euler(lab) - robots).max()
    near = np.abs(vmas.euler(finer) - batch.plain_numpy(finer, 1)).max()
    assert far < vmas.STEPPING
    assert far / near == pytest.approx(2, rel=0.1)


def test_rates_of_points_that_end_where_they_should_are_taken(lab: Plan, robots: Array) -> None:
    where = vmas.euler(lab) + 0.5 * vmas.ROUNDING
    assert vmas.Vmas(lab, robots).checked(printed(where))["world.step"] == 1.0


@pytest.mark.parametrize("change", WRONG)
def test_points_under_another_law_have_failed(lab: Plan, robots: Array, change: str) -> None:
    other = vmas.euler(batch.lab(2, change))
    with pytest.raises(RuntimeError, match="its points end more than"):
        vmas.Vmas(lab, robots).checked(printed(other))


def test_points_whose_physics_is_another_than_the_robots_have_failed(lab: Plan, robots: Array) -> None:
    with pytest.raises(RuntimeError, match="m from robots under the same law"):
        vmas.Vmas(lab, robots + 0.01).checked(printed(vmas.euler(lab)))


@pytest.mark.parametrize(
    "text", ["", "no JSON\n", "[]", '{"rates": {}}', '{"rates": {"env.step": "fast"}, "places": {}}']
)
def test_what_is_no_result_has_failed(lab: Plan, robots: Array, text: str) -> None:
    with pytest.raises(RuntimeError, match="is no result"):
        vmas.Vmas(lab, robots).checked(text)


@pytest.mark.parametrize("where", [np.full((9, 2), np.nan), np.zeros((8, 2)), np.zeros((9, 2))])
def test_other_places_have_failed(lab: Plan, robots: Array, where: Array) -> None:
    with pytest.raises(RuntimeError, match="its points end more than"):
        vmas.Vmas(lab, robots).checked(printed(where))


def test_a_process_without_vmas_has_failed_with_one_line(lab: Plan, robots: Array) -> None:
    with pytest.raises(RuntimeError, match=r"^ModuleNotFoundError: No module named '(torch|vmas)'$"):
        vmas.Vmas(lab, robots, Path(sys.executable)).rates()


@pytest.mark.parametrize(
    ("python", "told"),
    [
        (ROOT / "no-such-environment", r"^vmas: not installed; `make bench-vmas` makes \.venv-vmas for it$"),
        (Path(sys.executable), r"^vmas: failed: ModuleNotFoundError: No module named '(torch|vmas)'$"),
    ],
)
def test_without_vmas_and_gpu_the_others_are_measured(monkeypatch: pytest.MonkeyPatch, python: Path, told: str) -> None:
    monkeypatch.setattr(batch, "SECONDS", dict.fromkeys(batch.SECONDS, 0.1))
    monkeypatch.setattr(batch, "RUNS", dict.fromkeys(batch.RUNS, 1))
    monkeypatch.setattr(batch, "SPREAD", {size: batch.SPREAD[size] for size in (9, 90)})
    monkeypatch.setattr(batch, "gpu_refusal", lambda: "engine gpu: there is none")
    monkeypatch.setattr(batch, "sweep_s", lambda: 25.0)
    rows, failures = batch.measure(1, python=python)
    assert [row.what for row in rows[5:]] == [
        "9 robots, many runs: batch engine",
        "90 robots, many runs: batch engine",
        "sweep: 1 runs of lab, 0.1 s each, tables written",
    ]
    assert [row.unit for row in rows] == ["10⁶ steps/s"] * 7 + ["s"]
    assert sorted(failures) == ["gpu", "vmas"]
    assert re.search(told, batch.told(failures), re.MULTILINE)
    assert "gpu: engine gpu: there is none\n" in batch.told(failures)


def test_with_a_gpu_it_has_a_row(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[float, int]] = []
    monkeypatch.setattr(batch, "SECONDS", dict.fromkeys(batch.SECONDS, 0.1))
    monkeypatch.setattr(batch, "RUNS", {**dict.fromkeys(batch.RUNS, 1), "gpu": 12})
    monkeypatch.setattr(batch, "SPREAD", {})
    monkeypatch.setattr(batch, "gpu_refusal", lambda: None)
    monkeypatch.setattr(batch, "on_gpu", lambda plan, runs: asked.append((plan.duration_ns / 1e9, runs)))
    monkeypatch.setattr(batch, "sweep_s", lambda: 25.0)
    rows, failures = batch.measure(1, python=ROOT / "no-such-environment")
    assert rows[5].what == "lab.toml, many runs: batch engine on the GPU"
    assert asked[-1] == (0.1, 12)
    assert list(failures) == ["vmas"]


def test_formations_of_all_sizes_are_of_labs_robots() -> None:
    nine, ninety = (batch.spread(batch.SPREAD[robots], 0.1) for robots in (9, 90))
    assert (len(nine.robots), len(ninety.robots)) == (9, 90)
    assert {robot.mass for robot in ninety.robots} == {batch.lab(0.1).robots[0].mass}
    starts = np.array([robot.start for robot in ninety.robots])
    apart = np.hypot(*(starts[:, None] - starts).T) + 9 * np.eye(90)
    assert apart.min() == pytest.approx(0.8)  # nobody starts at the place of another one
    assert batch.rate(batch.batch, ninety, 2) > 0


def test_a_whole_sweep_is_timed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "SECONDS", {"sweep": 0.1})
    monkeypatch.setattr(batch, "RUNS", {"sweep": 3})
    assert 0.1 < batch.sweep_s() < 600


def test_delayed_runs_as_processes_are_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    plans: list[Plan] = []

    class Noted(Supervisor):
        def __init__(self, plan: Plan, folder: Path, **options: Any) -> None:
            plans.append(plan)
            super().__init__(plan, folder, **options)

    monkeypatch.setattr(product, "Supervisor", Noted)
    assert product.paper_processes(0.05, recorded=False, can=False, changes=product.LATE)[0] > 0
    assert {link.delay_min_ns for link in plans[0].links} == {5_000_000}


@pytest.fixture(scope="module")
def python() -> Path:
    """The interpreter that has VMAS."""
    if not vmas.PYTHON.exists():
        pytest.skip(f"VMAS: {vmas.MISSING}")
    return vmas.PYTHON


@pytest.mark.parametrize("changes", [(), NEAR], ids=["far", "near"])
def test_points_of_vmas_end_where_the_central_law_takes_them(python: Path, changes: tuple[str, ...]) -> None:
    plan = batch.lab(1, *changes)
    rates = vmas.Vmas(plan, vmas.euler(plan), python).rates(3)
    assert set(rates) == {"env.step", "world.step", "points alone"}
    assert min(rates.values()) > 0


def test_points_of_vmas_under_a_wrong_law_have_failed(python: Path, lab: Plan, robots: Array) -> None:
    peer = vmas.Vmas(lab, robots, python)
    peer.law["mass"] *= 1.01
    with pytest.raises(RuntimeError, match=r"env\.step: its points end more than"):
        peer.rates(3)


def test_what_fails_in_a_process_of_vmas_is_told_in_one_line(python: Path, lab: Plan, robots: Array) -> None:
    peer = vmas.Vmas(lab, robots, python)
    del peer.law["apart"]
    with pytest.raises(RuntimeError, match=r"^KeyError: 'apart'$"):
        peer.rates(3)
