"""Run time from time stamps of the kernel, whose clock somebody may set meanwhile."""

from dataclasses import dataclass

import pytest

from echelon.bridge.stations.waiting import RunClock

MS = 1_000_000
HOUR = 3_600_000 * MS
SINCE_1970 = 1_790_000_000_000 * MS


@dataclass
class Clocks:
    """The two clocks of a machine; each reading takes 50 ns."""

    monotonic_ns: int = 77_000 * MS
    ahead_ns: int = SINCE_1970
    """By how much the kernel's clock is ahead of the monotonic clock"""

    def monotonic(self) -> int:
        self.monotonic_ns += 50
        return self.monotonic_ns

    def since_1970(self) -> int:
        return self.monotonic() + self.ahead_ns


@pytest.fixture
def clocks(monkeypatch: pytest.MonkeyPatch) -> Clocks:
    made = Clocks()
    monkeypatch.setattr("time.monotonic_ns", made.monotonic)
    monkeypatch.setattr("time.time_ns", made.since_1970)
    return made


def test_a_stamp_has_the_run_time_at_which_it_was_made(clocks: Clocks) -> None:
    clock = RunClock(clocks.monotonic_ns)
    clocks.monotonic_ns += 1000 * MS
    stamp, now = clocks.since_1970(), clock.now()
    assert clock.of(stamp) == pytest.approx(now, abs=1000)


@pytest.mark.parametrize("step_ns", [HOUR, -HOUR, 30 * MS, -30 * MS])
def test_a_clock_that_is_set_moves_no_frame(clocks: Clocks, step_ns: int) -> None:
    """Every 2 ms a frame comes and is read; after a second the clock is set."""
    clock = RunClock(clocks.monotonic_ns)
    start_ns = clocks.monotonic_ns
    for number in range(1000):
        if number == 500:
            clocks.ahead_ns += step_ns
        clocks.monotonic_ns = start_ns + number * 2 * MS
        assert clock.of(clocks.since_1970()) == pytest.approx(number * 2 * MS, abs=2000)


@pytest.mark.parametrize("step_ns", [HOUR, -HOUR])
def test_frames_from_before_and_after_are_told_apart_when_they_are_read_at_once(clocks: Clocks, step_ns: int) -> None:
    clock = RunClock(clocks.monotonic_ns)
    start_ns, stamps = clocks.monotonic_ns, []
    for number in range(10):
        if number == 5:
            clocks.ahead_ns += step_ns
        clocks.monotonic_ns = start_ns + number * 2 * MS
        stamps.append(clocks.since_1970())
    found = [clock.of(stamp) for stamp in stamps]
    assert found == pytest.approx([number * 2 * MS for number in range(10)], abs=2000)


def test_what_comes_late_from_another_bus_stays_where_it_is(clocks: Clocks) -> None:
    """One bus is read after the other; the reader had stood still for 2 s."""
    clock = RunClock(clocks.monotonic_ns)
    early = clocks.since_1970()
    clocks.monotonic_ns += 2000 * MS
    assert clock.of(clocks.since_1970()) == pytest.approx(2000 * MS, abs=2000)
    assert clock.of(early) == pytest.approx(0, abs=2000)
