"""Drive protocols in a plan: their choice in a scenario, node ids on mixed buses, and a DBC for every frame."""

import pickle
import subprocess
import sys
from itertools import combinations, permutations
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echelon.bridge.protocols.registry import PROTOCOLS, drive_places, make_drive, make_host, make_observer, protocol_of
from echelon.bridge.referee.log import judge_log
from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError
from echelon.sim.parts.loading import load, parse
from support.runs import EXAMPLES, SCENARIOS, echelon, plan_of

OWN = "my_drive.py:MyProtocol"
LAB = (SCENARIOS / "lab.toml").read_text()


def lab(*overrides: str) -> Plan:
    """Returns the plan of the lab's nine robots on one bus; file names are relative to the examples."""
    return parse(LAB, "lab", ["can.path=closed", "can.bitrate=1000000", *overrides], EXAMPLES)[1]


def refused(*overrides: str) -> str:
    with pytest.raises(ScenarioError) as caught:
        lab(*overrides)
    assert len(str(caught.value).splitlines()) == 1
    return str(caught.value)


def drives(number: int, what: str) -> str:
    """Returns the override that sets keys of the drive of robot r`number`."""
    return f"formation.groups.g{1 + (number - 1) // 3}.robots.r{number}.drive={{{what}}}"


def mixed(uses: tuple[str, ...]) -> list[str]:
    """Returns the overrides that give each robot a protocol."""
    return [drives(number, f'protocol="{use}"') for number, use in enumerate(uses, start=1)]


def identifiers(plan: Plan, robot: int) -> frozenset[int]:
    """Returns the identifiers that a robot's drives use alone."""
    one = plan.robots[robot]
    return frozenset().union(*(protocol_of(one).identifiers(node) for node in one.drive.node_ids))


def check_apart(plan: Plan) -> None:
    """Checks that no two robots on a bus use the same identifier, and none uses a shared one of a protocol there."""
    for one, other in combinations(plan.robots, 2):
        if one.drive.bus == other.drive.bus:
            assert not identifiers(plan, one.index) & identifiers(plan, other.index), (one.name, other.name)
            assert not identifiers(plan, one.index) & protocol_of(other).shared_identifiers()
            assert not identifiers(plan, other.index) & protocol_of(one).shared_identifiers()


@settings(max_examples=60, deadline=None)
@given(st.tuples(*[st.sampled_from([*PROTOCOLS, OWN])] * 9))
def test_default_node_ids_never_collide(uses: tuple[str, ...]) -> None:
    plan = lab(*mixed(uses))
    check_apart(plan)
    assert [robot.drive.protocol.use for robot in plan.robots] == list(uses)
    # hosts and drives use no other identifiers than planning knows
    places = drive_places(plan)
    for robot in plan.robots:
        own = identifiers(plan, robot.index) | protocol_of(robot).shared_identifiers()
        assert make_observer(robot, True).identifiers <= own
        assert make_host(robot).identifiers <= own
        assert {frame.can_id for frame in make_host(robot).mirror(0.5, 0.5, True)} <= own
    for place in places:
        for frame in make_drive(plan, place).advance(0):
            assert frame.can_id in identifiers(plan, place.robot)


@pytest.mark.parametrize(("use", "nodes"), [("native", [0, 1, 2]), ("odrive", [1, 3, 5]), ("cia402", [1, 3, 5])])
def test_alone_on_a_bus_node_ids_are_in_the_order_of_robots(use: str, nodes: list[int]) -> None:
    plan = lab(f"robot.drive.protocol={use}")
    assert [robot.drive.node_ids[0] for robot in plan.robots[:3]] == nodes
    step = 0 if use == "native" else 1
    assert all(left == right + step for right, left in (robot.drive.node_ids for robot in plan.robots))


def test_defaults_move_out_of_the_way_of_what_is_given() -> None:
    plan = lab("robot.drive.protocol=odrive", drives(5, "node_ids=[1,2]"), drives(1, 'protocol="cia402"'))
    check_apart(plan)
    assert plan.robots[4].drive.node_ids == (1, 2)
    assert plan.robots[0].drive.node_ids == (1, 2)  # the CANopen nodes 1 and 2 have no identifier in common with them
    assert plan.robots[1].drive.node_ids == (3, 5)  # the identifiers of node 4 would include SYNC


ODRIVES = "robot.drive.protocol=odrive"


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (
            (ODRIVES, drives(1, 'protocol="cia402"'), drives(2, "node_ids=[4,5]")),
            "formation.groups.g1.robots.r2.drive.node_ids = [4, 5]: identifier 0x080 of g1/r2 collides with what all "
            "drives of cia402 share; free are 1, 2, 3, 5, 6, 7, 8, 9, …; or give another bus",
        ),
        (
            (ODRIVES, drives(2, "node_ids=[1,2]"), drives(3, "node_ids=[2,3]")),
            "r3.drive.node_ids = [2, 3]: identifier 0x040 of g1/r3 collides with those of g1/r2; free are 3, 4, 5",
        ),
        (
            (drives(2, 'protocol="cia402", node_ids=[7,8]'),),
            "r2.drive.node_ids = [7, 8]: identifier 0x187 of g1/r2 collides with those of g3/r8; free are 1, 9, 10",
        ),
        ((ODRIVES, drives(2, "node_ids=[7,7]")), "[7, 7]: two different ones from 0 to 62 are needed for odrive"),
        ((ODRIVES, drives(2, "node_ids=[62,63]")), "[62, 63]: two different ones from 0 to 62 are needed for odrive"),
        ((drives(2, 'protocol="cia402", node_ids=[0,1]'),), "two different ones from 1 to 126 are needed for cia402"),
        ((drives(2, "node_ids=[1,2]"),), "r2.drive.node_ids: not for native, which goes by the robot's number"),
        (("robot.drive.protocol=can_open",), "must be one of 'native', 'odrive', 'cia402', or 'file.py:Class'"),
        (("robot.drive.protocol=cia40",), "did you mean 'cia402'?"),
        (("robot.drive.protocol=3",), "robot.drive.protocol = 3: must be one of"),
        (("robot.drive.protocol={use='odrive',parameters={a=1}}",), "robot.drive.protocol.parameters.a: unknown key"),
        (
            ("robot.drive.protocol=cia402", "robot.drive.rated_torque=1e-4"),
            "drive.rated_torque = 0.0001: CiA 402 says it",
        ),
    ],
)
def test_mistakes_name_what_is_allowed(overrides: tuple[str, ...], says: str) -> None:
    assert says in refused(*overrides)


def test_a_bus_that_is_full_of_nodes_says_so() -> None:
    robots = "".join(f"r{n}={{start=[{n}.0,0.0]}}," for n in range(32))
    text = "robots={" + robots[:-1] + '},shape={kind="line",spacing=1.0}'
    with pytest.raises(ScenarioError, match="no node id is free for a drive of odrive; put some robots on another bus"):
        lab(f"formation={{{text}}}", ODRIVES, "law={}", "claims=[]")


def test_a_scenario_names_a_protocol_in_three_ways(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "installed"
    (folder / "drives_of_mine-1.0.dist-info").mkdir(parents=True)
    (folder / "drives_of_mine-1.0.dist-info" / "METADATA").write_text("Name: drives-of-mine\nVersion: 1.0\n")
    entry = "[echelon.protocols]\nmine = drives_of_mine:MyProtocol\n"
    (folder / "drives_of_mine-1.0.dist-info" / "entry_points.txt").write_text(entry)
    (folder / "drives_of_mine.py").write_text((EXAMPLES / "my_drive.py").read_text())
    monkeypatch.syspath_prepend(str(folder))
    plan = lab(
        "robot.drive.protocol=odrive",
        "formation.groups.g1.robot.drive.protocol=mine",
        f'formation.groups.g2.robot.drive.protocol={{use="{OWN}",parameters={{}}}}',
    )
    uses = [robot.drive.protocol.use for robot in plan.robots]
    assert uses == ["mine"] * 3 + [OWN] * 3 + ["odrive"] * 3
    assert [robot.drive.protocol.is_own for robot in plan.robots] == [False] * 6 + [True] * 3


def test_a_level_that_names_a_protocol_takes_no_parameters_from_above(tmp_path: Path) -> None:
    """A protocol is inherited with its parameters as a whole; the other keys of the table `drive` are inherited one by one."""
    text = (EXAMPLES / "my_drive.py").read_text().replace("    wheels =", "    offset: int = 0\n    wheels =")
    (tmp_path / "p.py").write_text(text)
    (tmp_path / "lab.toml").write_text(LAB)
    above = 'robot.drive={protocol={use="p.py:MyProtocol",parameters={offset=7}},lag=0.5}'
    below = 'formation.groups.g1.robot.drive={protocol="p.py:MyProtocol",torque_slew=3}'
    _, plan = load(tmp_path / "lab.toml", [above, below])
    one, other = plan.robots[0].drive, plan.robots[8].drive
    assert (one.protocol.made.offset, other.protocol.made.offset) == (0, 7)
    assert (one.motor.lag, one.motor.torque_slew) == (0.5, 3.0)
    assert pickle.loads(pickle.dumps(plan)).robots[8].drive.protocol.made.offset == 7


def test_a_process_that_gets_a_plan_imports_no_more_of_protocols_than_their_classes(tmp_path: Path) -> None:
    """A robot's process needs no hosts and drives, and the import of cantools would take a quarter of a second."""
    (tmp_path / "plan").write_bytes(pickle.dumps(plan_of("drives")))
    code = f"import pickle, sys; pickle.load(open({str(tmp_path / 'plan')!r}, 'rb')); print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=600)
    modules = set(done.stdout.split())
    assert "echelon.bridge.protocols.cia402" in modules
    assert not [
        name
        for name in modules
        if name.startswith(("echelon.bridge.protocols.cia402.", "echelon.bridge.protocols.cyclic"))
    ]
    assert not modules & {"cantools", "can", "zenoh"}


@pytest.mark.slow
@pytest.mark.parametrize("uses", [*permutations(PROTOCOLS)][::2])
def test_all_protocols_on_one_bus_by_default(uses: tuple[str, ...], tmp_path: Path) -> None:
    """Nine robots on the closed path: the referee finds nothing, and the DBC describes every frame."""
    overrides = [f"formation.groups.g{at}.robot.drive.protocol={use}" for at, use in enumerate(uses, start=1)]
    overrides += ["can.path=closed", "can.bitrate=1000000", "duration=1", "claims=[]"]
    sets = [argument for override in overrides for argument in ("--set", override)]
    done = echelon("run", "lab", "--engine", "inprocess", "--quiet", "--no-report", "--out", tmp_path, *sets)
    assert done.returncode == 0, done.stderr
    report = judge_log(tmp_path / "can.log", plan_of("lab", *overrides))
    assert (report.findings, report.unknown) == ((), 0)
    log = (tmp_path / "can.log").read_text()
    decode = [sys.executable, "-m", "cantools", "decode", "--single-line", str(tmp_path / "torque.dbc")]
    run = subprocess.run(decode, input=log, capture_output=True, text=True, check=True, timeout=600)
    decoded = run.stdout.splitlines()
    assert len(decoded) == len(log.splitlines()) > 5000
    assert [line for line in decoded if " :: " not in line or line.endswith(":: ")] == []
    assert "Unknown" not in run.stdout
    for name in ("NMT(", "SYNC(", "bridge_heartbeat(", "SDO_request(", "SDO_answer(", "_heartbeat("):
        assert name in run.stdout
