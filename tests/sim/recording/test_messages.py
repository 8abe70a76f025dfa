"""sim.recording.messages: every message comes back bit for bit, cut-off files up to the cut, garbage raises ValueError."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from echelon.messages import NULL, Channel, Message
from echelon.sim.recording import mcap_writer as chunked
from echelon.sim.recording.messages import read_messages
from echelon.sim.recording.recorder import Recorder
from support.recordings import LOSSY, messages_of, record
from support.runs import plan_of


@pytest.mark.parametrize(
    ("scenario", "overrides"),
    [
        ("lab", ()),
        ("lab", (LOSSY,)),
        ("paper", ("avoidance.enabled=true", "duration=0.05")),
        ("three_levels", ("duration=0.05",)),
        ("drives", ("duration=0.1",)),
    ],
)
def test_all_messages_come_back_bit_for_bit(scenario: str, overrides: tuple[str, ...], tmp_path: Path) -> None:
    folder = record(tmp_path / "run", scenario, *overrides)
    plan = plan_of(scenario, "duration=0.4", "claims=[]", *overrides)
    expected: dict[tuple[int, Channel], list[Message]] = {}
    nulls: dict[tuple[int, Channel], dict[int, int]] = {}
    for message in messages_of(plan):
        if message.is_null:
            nulls.setdefault((message.source, message.channel), {})[message.sequence] = message.time_ns
        else:
            expected.setdefault((message.source, message.channel), []).append(message)
    recorded = read_messages(folder / "run.mcap", plan)
    assert recorded.series.keys() == expected.keys()
    for key, series in recorded.series.items():
        assert (series.source, series.channel) == key
        assert series.sequences.tolist() == [message.sequence for message in expected[key]]
        assert series.times_ns.tolist() == [message.time_ns for message in expected[key]]
        assert series.values.tobytes() == b"".join(message.values.tobytes() for message in expected[key])
    assert recorded.nulls == nulls
    assert bool(nulls) == (LOSSY in overrides)
    assert not recorded.cut
    assert recorded.whole_until_ns() == plan.duration_ns + 1
    assert recorded.scenario == (folder / "scenario.toml").read_text()
    assert recorded.metadata == {"engine": "inprocess", "clock": "virtual"}


def test_a_file_that_is_cut_off_gives_what_is_whole(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(chunked, "CHUNK_SIZE", 20_000)
    path, plan = record(tmp_path, "lab") / "run.mcap", plan_of("lab", "duration=0.4", "claims=[]")
    whole, data = read_messages(path, plan), path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    cut = read_messages(path, plan)
    assert cut.cut
    ends = set()
    for key, series in cut.series.items():
        count = len(series.sequences)
        ends.add(count)
        np.testing.assert_array_equal(series.values, whole.series[key].values[:count])
    assert 0 < min(ends) <= max(ends) < 41
    assert cut.whole_until_ns() == min(ends) * 10_000_000  # of the member that lacks most


def test_of_what_lacks_states_in_between_the_beginning_is_whole(tmp_path: Path) -> None:
    path = record(
        tmp_path, "lab", alter=lambda message: None if (message.source, message.sequence) == (4, 7) else message
    )
    recorded = read_messages(path / "run.mcap", plan_of("lab", "duration=0.4", "claims=[]"))
    assert recorded.whole_until_ns() == 70_000_000


def test_on_a_wall_clock_a_state_may_lack(tmp_path: Path) -> None:
    path = record(
        tmp_path,
        "lab",
        alter=lambda message: None if (message.source, message.sequence) == (4, 7) else message,
        metadata={"engine": "processes", "clock": "wall"},
    )
    plan = plan_of("lab", "duration=0.4", "claims=[]")
    recorded = read_messages(path / "run.mcap", plan)
    assert recorded.by_arrival
    assert recorded.whole_until_ns() == plan.duration_ns + 1


def test_numbers_beyond_those_of_the_format_come_back(tmp_path: Path) -> None:
    plan = plan_of("lab")
    numbers = [(1 << 32) - 2, (1 << 32) - 1, 1 << 32, (1 << 32) + 1, 1 << 33, (1 << 33) + 1]
    with closing(Recorder(tmp_path / "run.mcap", plan, "", {})) as recorder:
        for number in numbers:
            recorder.record(Message(Channel.STATE, 0, number, number * 10_000_000, np.ones(16)))
    series = read_messages(tmp_path / "run.mcap", plan).series[0, Channel.STATE]
    assert series.sequences.tolist() == numbers


def twice(path: Path) -> None:
    """Records a message twice."""
    with closing(Recorder(path, plan_of("lab"), "", {})) as recorder:
        for _ in range(2):
            recorder.record(Message(Channel.STATE, 0, 0, 0, np.ones(16)))


def of_another_plan(path: Path) -> None:
    """Records a message that has another size in the plan of `lab`: avoidance adds positions to it."""
    plan = plan_of("lab", "avoidance.enabled=false")
    with closing(Recorder(path, plan, "", {})) as recorder:
        recorder.record(Message(Channel.GROUP_STATE, 9, 0, 0, np.ones(4)))


def of_nobody(path: Path) -> None:
    """Records a null message of a source that the plan of `lab` does not have."""
    with closing(Recorder(path, plan_of("three_levels"), "", {})) as recorder:
        recorder.record(Message(Channel.COMMAND, 30, 0, 0, NULL))


def of_no_channel(path: Path) -> None:
    """Records a null message on a channel that does not exist."""
    with closing(Recorder(path, plan_of("lab"), "", {})) as recorder:
        recorder.record(Message(17, 0, 0, 0, NULL))  # type: ignore[arg-type]


def empty(path: Path) -> None:
    """Records nothing."""
    Recorder(path, plan_of("lab"), "", {}).close()


@pytest.mark.parametrize(
    ("write", "says"),
    [
        (twice, r"/run.mcap: /g1/r1/state has two messages number 0"),
        (of_another_plan, r"/run.mcap: a message of /g1/state has \d+ bytes, not \d+"),
        (of_nobody, r"/run.mcap: /nulls names source 30 and channel 4, which are not of this plan"),
        (of_no_channel, r"/run.mcap: /nulls names source 0 and channel 17, which are not of this plan"),
        (empty, r"/run.mcap: holds no messages between roles of this plan"),
        (lambda path: path.write_bytes(b"hello"), r"/run.mcap: is no MCAP file"),
    ],
)
def test_what_is_no_recording_of_this_plan_is_refused(write: object, says: str, tmp_path: Path) -> None:
    assert callable(write)
    write(tmp_path / "run.mcap")
    with pytest.raises(ValueError, match=says):
        read_messages(tmp_path / "run.mcap", plan_of("lab"))
