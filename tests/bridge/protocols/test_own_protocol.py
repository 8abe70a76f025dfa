"""A user's drive protocol in a file beside the scenario: the example runs, and a wrong one causes one line that names it."""

import re
import shutil
from pathlib import Path

import pytest
from mcap.reader import make_reader

from echelon.bridge.can.log_files import frames_in
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.plan_dbc import plan_dbc
from echelon.bridge.protocols.registry import make_drive, make_host, make_observer
from echelon.errors import PartRunError
from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError
from echelon.planning.loading import load as load_untried
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import REGISTRY, load
from echelon.sim.parts.time_limit import TookTooLong
from support.awkward import write_awkward_files
from support.runs import EXAMPLES, echelon, reasons, summary_of

TEXT = (EXAMPLES / "my_drive.py").read_text()
QUIET = ("--quiet", "--no-report")


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The user's folder, with files of awkward names beside the protocol."""
    for path in EXAMPLES.glob("my_drive.*"):
        shutil.copy(path, tmp_path)
    write_awkward_files(tmp_path)
    return tmp_path


def changed(folder: Path, *changes: tuple[str, str]) -> Path:
    """Changes the protocol; returns its scenario."""
    text = TEXT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "my_drive.py").write_text(text)
    return folder / "my_drive.toml"


def failing(method: str, line: str, owner: str = "MyHost(CyclicHost)") -> tuple[str, str]:
    """Returns the change after which a method of a host or drive executes `line` from 0.3 s on."""
    where = f"class {owner}:"
    (found,) = [row for row in TEXT.splitlines() if row.startswith(where)]
    return found, (
        f"{found}\n    def {method}(self, *arguments):\n"
        f"        if arguments and arguments[0] > 300_000_000: {line}\n"
        f"        return super().{method}(*arguments)\n"
    )


@pytest.mark.slow
@pytest.mark.parametrize("protocol", ["my_drive.py:MyProtocol", "my_wheels.py:MyProtocol"])
def test_the_examples_run_in_one_process_and_in_many(protocol: str, folder: Path, tmp_path: Path) -> None:
    scenario, use = folder / "my_drive.toml", f"robot.drive.protocol={protocol}"
    shutil.copy(EXAMPLES / "my_wheels.py", folder)
    runs = {}
    for engine in ("inprocess", "processes"):
        done = echelon("run", scenario, "--set", use, "--engine", engine, *QUIET, "--out", tmp_path / engine)
        assert done.returncode == 0, done.stdout + done.stderr
        runs[engine] = summary_of(tmp_path / engine)
        (folder / "my_drive.py").write_text(TEXT)
    one, many = runs.values()
    assert one["trace_digest"] == many["trace_digest"]
    assert (tmp_path / "inprocess" / "can.log").read_bytes() == (tmp_path / "processes" / "can.log").read_bytes()
    assert one["verdict"]["word"] != "FAILS"
    assert one["can"]["referee"]["findings"] == []
    for row in many["can"]["robots"].values():
        assert (row["protocol"], row["enabled"], row["fault"]) == (protocol, True, "")
        assert 0.01 < row["largest"] < 1.5
    # the run's folder contains the protocol, so the user's folder is not needed to look at the run
    shown = echelon("can", tmp_path / "inprocess")
    assert shown.returncode == 0, shown.stderr
    assert "r3" in shown.stdout


@pytest.mark.slow
def test_on_a_wall_clock_too(folder: Path, tmp_path: Path) -> None:
    sets = ("--set", "duration=1.0", "--set", "claims=[]", "--set", "can.watchdog=0.5")
    done = echelon("run", folder / "my_drive.toml", "--clock", "wall", *sets, *QUIET, "--out", tmp_path / "run")
    assert done.returncode in (0, 1), done.stderr  # a busy machine may be late
    rows = summary_of(tmp_path / "run")["can"]["robots"].values()
    assert all(row["commands"] > 50 and row["protocol"] == "my_drive.py:MyProtocol" for row in rows)


def test_the_dbc_and_the_mirrored_path(folder: Path, tmp_path: Path) -> None:
    _, plan = load(folder / "my_drive.toml")
    assert 'BO_ 770 torque_r3: 5 bridge\n SG_ flags : 32|8@1+ (1,0) [0|0] ""  r3' in plan_dbc(plan).replace("\r", "")
    sets = ("--set", "can.path=mirror", "--set", "duration=0.5", "--set", "claims=[]", "--can", "virtual")
    done = echelon("run", folder / "my_drive.toml", "--engine", "inprocess", *sets, *QUIET, "--out", tmp_path / "run")
    assert done.returncode == 0, done.stderr
    frames = [frame for _, _, frame in frames_in(tmp_path / "run" / "can.log")]
    assert len(frames) == 3 * 50 + 3  # the last of each robot takes the torque away
    assert {frame.can_id for frame in frames} == {0x300, 0x301, 0x302}
    assert all(frame.data[4] == 1 for frame in frames[:-3])
    assert all(frame.data[4] == 0 for frame in frames[-3:])
    assert summary_of(tmp_path / "run")["can"]["referee"]["findings"] == []


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["inprocess", "processes"])
@pytest.mark.parametrize(
    ("change", "says"),
    [
        (failing("command", "raise KeyError('w')"), "its host's command raised KeyError: 'w'"),
        (failing("advance", "return None", "MyDrive(CyclicDrive)"), "its drive's advance must return a list of frames"),
    ],
)
def test_what_fails_in_a_run_is_one_line_and_wheels_are_stopped_first(
    folder: Path, tmp_path: Path, engine: str, change: tuple[str, str], says: str
) -> None:
    scenario = changed(folder, change)
    done = echelon("run", scenario, "--engine", engine, *QUIET, "--out", tmp_path / "run")
    assert done.returncode == 3
    (line,) = done.stderr.splitlines()
    assert re.search(rf"my_drive\.py(:|, line \d+: )MyProtocol of r1: {says}", line)
    frames = [frame for _, _, frame in frames_in(tmp_path / "run" / "can.log")]
    assert [(frame.can_id, frame.data) for frame in frames[-3:]] == [(0x300 + robot, bytes(5)) for robot in range(3)]
    assert any(says in reason for reason in reasons(summary_of(tmp_path / "run")))
    the_bridge_has_reported(tmp_path / "run")


def the_bridge_has_reported(folder: Path) -> None:
    """Checks that a summary has the counts of the bridge, not only what can.log shows."""
    can = summary_of(folder)["can"]
    assert len(can["robots"]) == 3
    assert can["wheels_stopped"] is not None
    assert can["sent"] is not None
    # the mirrored path does not count the frames that stop the robots which had torque
    stops = 0 if can["path"] == "closed" else sum(row["commands"] > 0 for row in can["robots"].values())
    assert can["frames"] + stops == len(list(frames_in(folder / "can.log")))


@pytest.mark.slow
def test_on_a_wall_clock_wheels_are_stopped_first_too(folder: Path, tmp_path: Path) -> None:
    scenario = changed(folder, failing("command", "raise KeyError('w')"))
    sets = ("--set", "claims=[]", "--set", "can.watchdog=0.5")
    done = echelon("run", scenario, "--clock", "wall", *sets, *QUIET, "--out", tmp_path / "run")
    assert done.returncode == 3
    assert "echelon: my_drive.py, line 54: MyProtocol of r" in done.stderr
    assert "its host's command raised KeyError: 'w'" in done.stderr
    commands = [frame for _, _, frame in frames_in(tmp_path / "run" / "can.log") if frame.can_id < 0x380]
    assert [(frame.can_id, frame.data) for frame in commands[-3:]] == [(0x300 + robot, bytes(5)) for robot in range(3)]
    the_bridge_has_reported(tmp_path / "run")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("engine", "clock"), [("processes", "virtual"), ("processes", "wall"), ("inprocess", "virtual")]
)
def test_a_mirroring_bridge_reports_a_failure_its_counts_and_all_frames_that_it_sent(
    folder: Path, tmp_path: Path, engine: str, clock: str
) -> None:
    owner = "class MyHost(CyclicHost):"
    fails = (
        f"{owner}\n    said = 0\n\n    def mirror(self, *arguments):\n"
        "        self.said += self.plan.node_ids[0] == 1\n"
        "        if self.said > 30 and any(arguments[:2]): raise KeyError('w')\n"
        "        return super().mirror(*arguments)\n"
    )
    scenario, run = changed(folder, (owner, fails)), tmp_path / "run"
    sets = ("--set", "can.path=mirror", "--set", "claims=[]", "--can", "virtual", "--clock", clock)
    done = echelon("run", scenario, *sets, "--engine", engine, *QUIET, "--out", run)
    assert done.returncode == 3
    assert "its host's mirror raised KeyError: 'w'" in done.stderr
    the_bridge_has_reported(run)
    with (run / "run.mcap").open("rb") as file:
        recorded = sum(1 for _ in make_reader(file).iter_messages(topics=["/can/frames"]))
    assert recorded == summary_of(run)["can"]["frames"] > 30


def test_a_host_that_cannot_even_stop_is_made_to_ask_for_no_torque(folder: Path) -> None:
    scenario = changed(folder, failing("stop", "raise RuntimeError('no')"))
    _, plan = load(scenario, ["duration=0.5", "claims=[]"])
    engine = Engine(plan)
    engine.run()
    commander = engine.commander
    assert commander is not None
    frames, failure = commander.stop(plan.duration_ns, range(3))
    assert [timed.frame for timed in frames] == [Frame(0x300 + robot, bytes(5)) for robot in range(3)]
    assert isinstance(failure, PartRunError)
    assert str(failure) == "my_drive.py, line 54: MyProtocol of r1: its host's stop raised RuntimeError: no"


def test_a_host_that_is_stopped_by_a_time_limit_keeps_no_other_robot_from_being_stopped(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    _, plan = load(folder / "my_drive.toml", ["duration=0.5", "claims=[]"])
    engine = Engine(plan)
    engine.run()
    commander = engine.commander
    assert commander is not None

    def hangs(*_: object) -> list[Frame]:
        raise TookTooLong("more than 10 s")

    monkeypatch.setattr(commander.robots[1].host, "stop", hangs)
    frames, failure = commander.stop(plan.duration_ns, range(3))
    assert [timed.frame.can_id for timed in frames] == [0x300, 0x302]
    assert isinstance(failure, TookTooLong)


def first(plan: Plan) -> object:
    host = make_host(plan.robots[0])
    host.receive(400_000_000, Frame(0x380, bytes(5)))
    return host.command(400_000_000, 0.0, 0.0)


def advanced(plan: Plan) -> object:
    from echelon.bridge.protocols.registry import drive_places

    drive = make_drive(plan, drive_places(plan)[0])
    return drive.advance(400_000_000)


def observed(plan: Plan) -> object:
    return make_observer(plan.robots[0], True).observe(400_000_000, Frame(0x300, bytes(5)))


@pytest.mark.parametrize(
    ("change", "ask", "says"),
    [
        (failing("command", "return [(0x300, b'')]"), first, "its host's command must return frames"),
        (failing("command", "return [Frame(0x300, 'no')]"), first, "its host's command: a frame has up to 8 bytes"),
        (failing("command", "return [Frame(0x300, bytes(9))]"), first, "its host's command: a frame has up to 8 bytes"),
        (failing("command", "return [Frame(0x7FF)]"), first, "command sends identifier 0x7ff, which `identifiers`"),
        (failing("command", "return Frame(0x300)"), first, "its host's command must return a list of frames"),
        (
            failing("receive", "self.torque = 1.0, float('nan'); return"),
            first,
            "after receive: torque must be two finite",
        ),
        (
            failing("receive", "self.torque = None; return"),
            first,
            "its host after receive: torque must be two finite numbers",
        ),
        (
            ("        flags = ENABLE", "        1 / 0; flags = ENABLE"),
            first,
            "its host's encode raised ZeroDivisionError",
        ),
        (
            ("return [Frame(COMMAND", "return (COMMAND, data) or [Frame(COMMAND"),
            first,
            "its host's encode must return a list",
        ),
        (failing("receive", "1 / 0"), first, "its host's receive raised ZeroDivisionError: division by zero"),
        (failing("advance", "return [Frame(0x381)]", "MyDrive(CyclicDrive)"), advanced, "sends identifier 0x381"),
        (failing("advance", "return []", "MyDrive(CyclicDrive)"), advanced, "though advance(400000000) has done what"),
        (
            failing("observe", "return 7", "MyObserver(CyclicObserver)"),
            observed,
            "observe must return a list of Finding",
        ),
        (
            failing("observe", "raise SystemExit(3)", "MyObserver(CyclicObserver)"),
            observed,
            "its observer's observe raised SystemExit: 3",
        ),
        (
            failing("observe", "self.wheels[0].reported = 'much'", "MyObserver(CyclicObserver)"),
            observed,
            "its observer reads a torque that is no finite number: 'much'",
        ),
    ],
)
def test_what_returns_no_frames_is_named(folder: Path, change: tuple[str, str], ask: object, says: str) -> None:
    plan = load_untried(changed(folder, change), [], REGISTRY)[1]
    assert callable(ask)
    with pytest.raises(PartRunError) as caught:
        ask(plan)
    assert re.match(r"my_drive\.py(:|, line \d+: )MyProtocol of r1: ", str(caught.value))
    assert says in str(caught.value)


@pytest.mark.parametrize("given", [[], ["formation.robots.r1.drive.node_ids=[1,1]"]])
def test_node_ids_that_change_nothing_are_the_mistake(folder: Path, given: list[str]) -> None:
    scenario = changed(folder, ("by_number = True", "by_number = False"), ("COMMAND + node, F", "COMMAND, F"))
    with pytest.raises(
        ScenarioError, match=r"identifiers\(node\) names 0x300 for every node; each node needs its own"
    ) as e:
        load(scenario, given)
    assert "are needed" not in str(e.value)


@pytest.mark.parametrize(
    "changes",
    [
        [('Struct("<hhB")', 'Struct(">hhB")'), ('"tau_right", 0', '"tau_right", 7'),
         ('"tau_left", 16', '"tau_left", 23'),
         ('drive.torque_scale, "Nm"', 'drive.torque_scale, "Nm", big_endian=True')],
        [('"tau_right", 0', '"right", 0'), ('"tau_left", 16', '"left", 16'),
         ('drive.torque_scale, "Nm"', '3 * drive.torque_scale, "Nm"')],
        [('drive.torque_scale, "Nm"', '1000 * drive.torque_scale, "mNm"')],
    ],
    ids=["big endian", "other names", "other unit"],
)  # fmt: skip
def test_a_dbc_that_fits_or_names_its_signals_otherwise_is_not_refused(
    folder: Path, changes: list[tuple[str, str]]
) -> None:
    _, plan = load(changed(folder, *changes))
    assert "BO_ 768 torque_r1: 5 bridge" in plan_dbc(plan)


HOST = "    def host(self, drive: DrivePlan) -> MyHost:\n        return MyHost(drive, [FEEDBACK + drive.node_ids[0]])\n"


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        (HOST, "", "MyProtocol lacks the method host"),
        ("    def encode(", "    def encodes(", "host raised TypeError: Can't instantiate abstract class MyHost"),
        ("    def report(", "    def reports(", "drive raised TypeError: Can't instantiate abstract class MyDrive"),
        ("return MyHost(drive, [", "return (drive, [", "what host returns lacks clipped, command, enabled, estop, fault"),
        ("return MyDrive(drive, [", "return (drive, [", "what drive returns lacks advance, due_ns"),
        ("wheels = ((0, 1),)", "wheels = (0, 1)", "MyProtocol.wheels must be ((0,), (1,)) or ((0, 1),), not (0, 1)"),
        ("    by_number", "    nodes = 7\n    by_number", "MyProtocol.nodes must be a range of node ids, not 7"),
        ("COMMAND + node, FEEDBACK + node)", "COMMAND + nodes,)", "identifiers raised NameError"),
        ("return frozenset((", "return list((", "identifiers must be a set of numbers from 0 to 0x7ff, not [768"),
        ("FEEDBACK = 0x300, 0x380", "FEEDBACK = 0x300, 0x7FE", "from 0 to 0x7ff, not frozenset({"),
        ("0x380  # each", "0x301  # each", "identifier 0x301 of r2 collides with those of r1; give another bus"),
        ("COMMAND + node, FEEDBACK + node)", "COMMAND, FEEDBACK)", "its identifiers(node) names 0x300 for every node"),
        ("return frozenset((COMMAND + node", "raise SystemExit(3) or frozenset((COMMAND + node",
         "my_drive.py, line 91: MyProtocol: identifiers raised SystemExit: 3"),
        ("        return MyHost(drive", "        exit(3); return MyHost(drive", "host raised SystemExit: 3"),
        ("by_number = True", "by_number = False", "node_ids = [1, 2]: one from 0 to 126, written twice, is needed"),
        ("        return [\n            Message(", "        return [Message(1, 'a', 8, [])] + [\n            Message(",
         "messages describes identifier 0x001, which `identifiers` does not name"),
        ("        return [\n            Message(COMMAND", "        return [] and [\n            Message(COMMAND",
         "observer: identifier 0x300 comes regularly, but `messages` does not describe it"),
        ('("tau_left", 16)', '("tau_left", 8)', "messages raised Error: The signals tau_left and tau_right are overlapping"),
        ('Struct("<hhB")', 'Struct(">hhB")', "r1: torque_r1: its DBC reads tau_right = -4.865 where encode was given -0.02"),
        ('drive.torque_scale, "Nm"', '2 * drive.torque_scale, "Nm"', "its DBC reads tau_right = -0.04 where encode"),
        ('size, signals(BRIDGE, "states")', 'size, [number("tau_left", 0, 16, "x", drive.torque_scale, "Nm")]',
         "r1: feedback_r1: its DBC reads tau_left = -0.02 where report was given 0.03"),
        ("    return Feedback((right * scale, left * scale)", "    return Feedback((left * scale, right * scale)",
         "its host's decode reads 0.03 for the right wheel where report was given -0.02"),
        ("    right, left, states = BODY.unpack(data)", "    return 'never'",
         "its host's decode refuses a frame of report, ecff1e0000: never"),
        ('"tau_left", 16)', '"tau_left", 40)', "torque_r1: its DBC describes 8 bytes where encode returned 5"),
        ("return MyObserver(drive,", "return 7, (drive,", "what observer returns lacks cyclic, identifiers, observe, wheels"),
    ],
)  # fmt: skip
def test_what_is_missing_or_wrong_is_said_before_the_start(folder: Path, old: str, new: str, says: str) -> None:
    size = [("size = drive.node_ids[0], BODY.size", "size = drive.node_ids[0], 8")] if "8 bytes" in says else []
    scenario = changed(folder, (old, new), *size)
    sets = ["robot.drive.node_ids=[1,2]"] if "twice" in says else []
    with pytest.raises(ScenarioError) as caught:
        load(scenario, sets)
    assert len(str(caught.value).splitlines()) == 1
    assert "my_drive" in str(caught.value)
    assert says in str(caught.value)
