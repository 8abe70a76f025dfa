"""The benchmark's exchange is the same for every peer: whoever leaves something out does not end at the same values."""

import pytest

from bench import lockstep
from bench.product import Row, table


@pytest.mark.parametrize("peer", ["zenoh", "pipes"])
def test_a_peer_ends_where_the_exchange_ends(peer: str) -> None:
    runs, failures = lockstep.compare([peer], 50, 1)
    assert not failures
    (run,) = runs[peer]
    assert run.values == lockstep.expected(50)
    assert run.values != lockstep.expected(49)
    assert run.ticks_per_s > 0


def test_a_peer_that_is_not_installed_is_no_crash(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lockstep, "installed", lambda module: False)
    assert lockstep.compare(["helics"], 10, 1) == ({"helics": []}, {"helics": "not installed"})


def test_table_quotes_medians() -> None:
    assert table([Row("start-up", "s", (3.0, 1.0, 2.0))]).splitlines()[1].split()[-3:] == ["2", "1", "3"]
