"""sim.replay: roles that hear what was said say what was said; what differs is found where it begins."""

from pathlib import Path

import pytest

from echelon.errors import UsageError
from echelon.messages import NULL, Channel, Message
from echelon.plan.can_plan import NEVER_NS
from echelon.sim.recorded_runs import open_recorded, replay_run
from echelon.sim.replay.comparison import ChannelComparison
from echelon.sim.replay.replay import Replay
from support.arrivals import write_arrivals
from support.recordings import LOSSY, QUICK, Alter, messages_of, planted, record
from support.runs import plan_of

LEADER, ROOT = 9, 12
"""Of `lab`: g1 and the coordinator"""


def replayed(
    folder: Path, *overrides: str, only: tuple[str, ...] = (), tolerance: float = 0.0, scenario: str | None = None
) -> Replay:
    """Replays the run of a folder."""
    return replay_run(folder, scenario, overrides, only, tolerance)


def channel_of(found: Replay, member: str, channel: Channel) -> ChannelComparison:
    """Returns the comparison of one member's channel."""
    (one,) = [each for each in found.channels if (each.member, each.channel) == (member, channel)]
    return one


@pytest.mark.parametrize(
    ("scenario", "overrides"),
    [
        ("lab", ()),
        ("lab", (LOSSY,)),
        ("lab", (LOSSY, "seed=7", "duration=1.5")),
        ("paper", ("avoidance.enabled=true", "duration=0.05")),
        ("three_levels", ("duration=0.05",)),
        ("multi", ("duration=0.1",)),
        ("integral", ("duration=0.1",)),
        ("lab", ("law.coupling=[{block='inter',onto='intra',value=0.1}]", LOSSY)),
        ("drives", ("duration=0.2",)),
        ("drives", ("duration=0.2", LOSSY)),
    ],
)
def test_without_a_change_all_outputs_are_equal(scenario: str, overrides: tuple[str, ...], tmp_path: Path) -> None:
    plan = plan_of(scenario, *QUICK, *overrides)
    found = replayed(record(tmp_path / "run", scenario, *overrides))
    assert found.equal
    assert found.first_difference is None
    assert found.roles == tuple(one.name for one in plan.formation)
    assert found.until == plan.duration_ns / 1e9
    sent = [message for message in messages_of(plan) if message.channel is not Channel.WHEELS and not message.is_null]
    assert sum(channel.equal for channel in found.channels) == len(sent)
    if plan.can.closed:
        assert any(remark.startswith("bridge and drives are not replayed") for remark in found.remarks)


def test_null_messages_take_the_place_of_older_messages_as_they_did_then(tmp_path: Path) -> None:
    folder = record(
        tmp_path / "run", "lab", "links=[{channel='state',loss=0.03,policy='hold_then_stop',timeout=0.015}]"
    )
    recorded = open_recorded(folder)
    said, nulls = recorded.series[LEADER, Channel.COMMAND].sequences, recorded.nulls[LEADER, Channel.COMMAND]
    assert set(said.tolist()) & {number - 1 for number in nulls}
    assert replayed(folder).equal


def test_a_changed_value_of_a_command_is_found_with_the_robot_that_heard_it(tmp_path: Path) -> None:
    folder = record(tmp_path / "run", "lab", alter=planted(LEADER, Channel.COMMAND, 7, 3, 0.25))
    found = replayed(folder)
    assert found.first_difference is not None
    assert (found.first_difference.time, found.first_difference.member, found.first_difference.channel) == (
        0.07,
        "g1",
        Channel.COMMAND,
    )
    assert (found.first_difference.sequence, found.first_difference.value) == (7, "ay of g1/r2")
    assert found.first_difference.first == pytest.approx(found.first_difference.second + 0.25)  # type: ignore[operator]
    command = channel_of(found, "g1", Channel.COMMAND)
    assert (command.compared, command.equal) == (41, 40)
    differing = {channel.member for channel in found.channels if not channel.is_equal}
    assert differing == {"g1", "g1/r2"}  # the robot was told something else than what moved it then
    heard = channel_of(found, "g1/r2", Channel.STATE).first_difference
    assert heard is not None
    assert (heard.time, heard.value) == (0.08, "x")


def test_a_changed_state_is_found_with_the_leader_that_heard_it(tmp_path: Path) -> None:
    found = replayed(record(tmp_path / "run", "lab", alter=planted(1, Channel.STATE, 5, 0, 1e-6)))
    assert found.first_difference is not None
    assert (found.first_difference.time, found.first_difference.member, found.first_difference.value) == (
        0.05,
        "g1/r2",
        "x",
    )
    assert channel_of(found, "g1/r2", Channel.STATE).equal == 40
    assert channel_of(found, "g1", Channel.GROUP_STATE).equal == 40
    assert channel_of(found, "coordinator", Channel.REFERENCE).is_equal  # it hears what g1 said then
    assert replayed(tmp_path / "run", tolerance=1e-4).equal


def test_where_a_role_said_nothing_what_it_says_now_is_computed_only(tmp_path: Path) -> None:
    def silent(message: Message) -> Message:
        null = message[1:3] == (LEADER, 7) and message.channel is Channel.COMMAND
        return message._replace(values=NULL) if null else message

    found = replayed(record(tmp_path / "run", "lab", alter=silent))
    assert found.first_difference is not None
    assert (found.first_difference.member, found.first_difference.sequence, found.first_difference.lacking) == (
        "g1",
        7,
        "first",
    )
    assert channel_of(found, "g1", Channel.COMMAND).only_second == 1
    assert "command number 7: computed only, none recorded" in str(found)
    head, *_ = (line.split("  ") for line in str(found).splitlines()[1:-1])
    assert [text.strip() for text in head if text][:6] == [
        *("member", "channel", "messages", "equal", "recorded only", "computed only"),
    ]


def test_a_changed_law_says_what_it_says_in_a_run_of_its_own(tmp_path: Path) -> None:
    """At the first instant both laws have the same states before them."""
    change = "law.epsilon=[0.3,0.6]"
    found = replayed(record(tmp_path / "run", "lab"), change)
    (said,) = [
        message
        for message in messages_of(plan_of("lab", *QUICK, change))
        if (message.source, message.channel, message.sequence) == (ROOT, Channel.REFERENCE, 0)
    ]
    assert found.first_difference is not None
    assert (found.first_difference.time, found.first_difference.member, found.first_difference.value) == (
        0.0,
        "coordinator",
        "ax of g1",
    )
    assert found.first_difference.second == said.values[0]
    assert channel_of(found, "coordinator", Channel.REFERENCE).equal == 0
    assert channel_of(found, "g1/r1", Channel.STATE).is_equal  # robots hear what was commanded then


def test_another_scenario_is_judged_on_the_same_messages(tmp_path: Path) -> None:
    folder = record(tmp_path / "run", "lab")
    other = record(tmp_path / "other", "lab", "law.lead=0.0")
    found = replayed(folder, scenario=str(other))
    assert {channel.member for channel in found.channels if not channel.is_equal} <= {"g1", "g2", "g3", "coordinator"}
    assert not found.equal
    assert replayed(folder, "law.lead=0.5", scenario=str(other)).equal  # as lab has it


@pytest.mark.parametrize(
    ("only", "roles"),
    [
        (("g1",), ("g1/r1", "g1/r2", "g1/r3", "g1")),
        (("g2/r4", "coordinator"), ("g2/r4", "coordinator")),
        (("g1/r1", "g1/r1"), ("g1/r1",)),
    ],
)
def test_only_some_roles(only: tuple[str, ...], roles: tuple[str, ...], tmp_path: Path) -> None:
    found = replayed(record(tmp_path / "run", "lab"), only=only)
    assert found.roles == roles
    assert {channel.member for channel in found.channels} == set(roles)


@pytest.mark.parametrize(
    ("overrides", "only", "says"),
    [
        ((), ("coordinater",), "coordinater: no robot and no node of this run; did you mean 'coordinator'?"),
        ((), ("west",), "west: no robot and no node of this run; nodes are g1, g2, g3, coordinator"),
        ((), ("bridge",), "bridge: cannot be replayed: frames are recorded one by one"),
        (
            ("avoidance.enabled=true",),
            (),
            "g1 hears reference of coordinator with 24 values, recorded with 6: coupling and avoidance",
        ),
        (("periods.acceleration=0.02",), (), "every 20 ms, recorded every 10 ms: replay needs the same periods"),
        (("can.path=closed",), (), "g1/r1 hears wheels of bridge, which was not recorded"),
    ],
)
def test_what_does_not_fit_the_recording_is_refused_in_one_line(
    overrides: tuple[str, ...], only: tuple[str, ...], says: str, tmp_path: Path
) -> None:
    folder = record(tmp_path / "run", "lab", "avoidance.enabled=false")
    with pytest.raises(UsageError) as error:
        replayed(folder, *overrides, only=only)
    assert says in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("scenario", "says"),
    [("unequal", "the scenario has pair/p1, the recording does not"), ("drives", "hears wheels of bridge")],
)
def test_a_scenario_of_another_tree_is_refused(scenario: str, says: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=says):
        replayed(record(tmp_path / "run", "lab"), scenario=scenario)


@pytest.mark.parametrize("tolerance", [-1.0, float("nan"), float("inf")])
def test_a_tolerance_is_finite_and_not_negative(tolerance: float, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"tolerance .*: must be 0 or more, and finite"):
        replayed(record(tmp_path / "run", "lab"), tolerance=tolerance)


@pytest.mark.parametrize("source", [4, LEADER, ROOT])
def test_from_the_first_message_that_lacks_nothing_is_compared(source: int, tmp_path: Path) -> None:
    folder = record(tmp_path / "run", "lab", alter=lambda message: None if message[1:3] == (source, 7) else message)
    found = replayed(folder)
    assert found.equal
    assert found.until == pytest.approx(0.06)
    assert "the recording lacks messages: it is whole up to t = 0.06 s of 0.4 s" in str(found)
    nothing = record(
        tmp_path / "none", "lab", alter=lambda message: None if message.channel is Channel.STATE else message
    )
    with pytest.raises(UsageError, match="lacks messages from the start"):
        replayed(nothing)


def test_a_recording_that_is_cut_off_is_replayed_up_to_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echelon.sim.recording.mcap_writer.CHUNK_SIZE", 20_000)
    path = record(tmp_path / "run", "lab", LOSSY) / "run.mcap"
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])
    found = replayed(tmp_path / "run")
    assert found.equal
    assert 0.1 < found.until < 0.3
    assert "the recording is cut off: it is whole up to t =" in str(found)


def test_on_a_wall_clock_it_says_what_is_exact(tmp_path: Path) -> None:
    folder = record(
        tmp_path / "run",
        "lab",
        alter=lambda message: None if (message.source, message.sequence) == (4, 7) else message,
        metadata={"engine": "processes", "clock": "wall"},
    )
    found = replayed(folder, only=("g2/r5", "g1"))
    assert found.equal  # what a recorder missed is no difference
    assert found.until == 0.4
    assert channel_of(found, "g2/r5", Channel.STATE).only_second == 1
    assert "on a wall clock: when each message arrived is not recorded" in str(found)


def test_on_a_wall_clock_a_recording_is_whole_up_to_its_last_message(tmp_path: Path) -> None:
    folder = record(
        tmp_path / "run",
        "lab",
        alter=lambda message: None if message.time_ns > 200_000_000 else message,
        metadata={"engine": "processes", "clock": "wall"},
    )
    found = replayed(folder, only=("g1",))
    assert found.until == 0.2
    assert channel_of(found, "g1", Channel.COMMAND).compared == 21
    assert "it is whole up to t = 0.2 s of 0.4 s" in str(found)


def test_a_recording_by_another_version_is_told(tmp_path: Path) -> None:
    metadata = {"engine": "inprocess", "clock": "virtual", "echelon": "0.0.1", "numpy": "1.0"}
    text = str(replayed(record(tmp_path / "run", "lab", metadata=metadata)))
    assert "recorded with echelon 0.0.1, now 0.1.0; numpy 1.0, now" in text
    assert "last digits may differ, which --tolerance allows for" in text


WALL = {"engine": "processes", "clock": "wall"}


def on_a_wall_clock(
    folder: Path, *overrides: str, alter: Alter = lambda message: message, ended: bool = True, until_ns: int = NEVER_NS
) -> Path:
    """Records a run over ideal links as if it had been on a wall clock where messages took no time; the arrivals are known up
    to an instant."""
    record(folder, "lab", *overrides, alter=alter, metadata=WALL)
    plan = plan_of("lab", *QUICK, *overrides)
    rows = [
        (number, message.sequence, message.time_ns, message.time_ns)
        for message in messages_of(plan)
        for number, link in enumerate(plan.links)
        if (link.source, link.channel) == (message.source, message.channel) and message.time_ns < until_ns
    ]
    write_arrivals(folder, rows, [(one.index, plan.duration_ns + 1) for one in plan.formation] if ended else ())
    return folder


def test_on_a_wall_clock_arrivals_decide_what_was_heard(tmp_path: Path) -> None:
    found = replayed(on_a_wall_clock(tmp_path / "run"))
    assert found.equal
    assert sum(channel.equal for channel in found.channels) == 16 * 41
    assert not any("wall clock" in remark or "not all" in remark for remark in found.remarks)
    assert replayed(tmp_path / "run", "links=[{delay=0.2,loss=0.9}]").equal  # whatever the links say now
    (tmp_path / "run" / "arrivals.bin").write_bytes(b"")
    assert all(channel.compared == 0 for channel in replayed(tmp_path / "run").channels)


def test_on_a_wall_clock_a_role_is_compared_up_to_what_the_recorder_missed(tmp_path: Path) -> None:
    """The command number 7 of g1 is missing, so what its robots did from 0.07 s on is not known; all else is."""

    def missed(message: Message) -> Message | None:
        return None if message[1:3] == (LEADER, 7) and message.channel is Channel.COMMAND else message

    found = replayed(on_a_wall_clock(tmp_path / "run", alter=missed))
    assert found.equal
    assert [channel_of(found, name, Channel.STATE).compared for name in ("g1/r1", "g2/r4")] == [7, 41]
    assert channel_of(found, "g1", Channel.COMMAND).only_second == 1
    (says,) = [remark for remark in found.remarks if remark.startswith("not all that roles heard is known: ")]
    assert says.endswith("of g1/r1 outputs are compared up to t = 0.07 s, and of 2 more not to the end either")


def test_on_a_wall_clock_a_member_that_was_killed_is_compared_up_to_its_last_arrival(tmp_path: Path) -> None:
    found = replayed(on_a_wall_clock(tmp_path / "run", ended=False, until_ns=200_000_000))
    assert found.equal
    assert {channel.compared for channel in found.channels} == {19}


def test_of_a_wall_clock_a_changed_value_is_found(tmp_path: Path) -> None:
    found = replayed(on_a_wall_clock(tmp_path / "run", alter=planted(LEADER, Channel.COMMAND, 7, 3, 0.25)))
    assert found.first_difference is not None
    assert (found.first_difference.time, found.first_difference.member) == (0.07, "g1")
    assert {channel.member for channel in found.channels if not channel.is_equal} == {"g1", "g1/r2"}
