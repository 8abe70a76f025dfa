"""The benchmark's exchange is the same for every peer: whoever leaves something out does not end at the same values."""

import json
import subprocess
import sys

import numpy as np
import pytest

from bench import batch, lockstep
from bench.can import Robots, bus_rates, closed_in_process
from bench.product import Row, table
from echelon.bridge.can.bus import open_bus
from echelon.bridge.can.bus_url import resolve_url
from echelon.bridge.protocols.native.codec import NativeCodec, Torque
from support.runs import ROOT


@pytest.mark.parametrize("peer", ["zenoh", "pipes"])
def test_a_peer_ends_where_the_exchange_ends(peer: str) -> None:
    # A process of its own: roles are forked, which a process that has used Zenoh must not do.
    command = [sys.executable, "-m", "bench.lockstep", "--peers", peer, "--ticks", "50", "--repeat", "1", "--json"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=250, check=True)
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
