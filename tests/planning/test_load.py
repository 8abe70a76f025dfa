"""Lines about mistakes in a scenario: tables of mistakes with their lines, and random mutations of scenarios."""

import copy
import math
import string
from contextlib import suppress
from datetime import date
from pathlib import Path
from typing import Any

import pytest
import tomlkit
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from echelon import shipped
from echelon.errors import one_line
from echelon.planning.explain import TEXTS, key_text, value_text
from echelon.planning.loading import ScenarioError
from echelon.sim.parts.loading import load, parse

SCENARIOS = sorted(shipped.FOLDER.glob("*.toml"))
TEXTS_OF = {path.stem: path.read_text(encoding="utf-8") for path in SCENARIOS}
BASE = """
name = "t"
duration = 1.0
[trajectory]
kind = "circle"
radius = 1.0
rate = 0.5
[robot]
mass = 10.0
inertia = 0.5
wheel_radius = 0.1
arm = 0.4
offset = 0.2
[law]
epsilon = [0.1]
[formation]
shape = { kind = "line", spacing = 1.0 }
[formation.robots]
a = { start = [0.0, 0.0] }
b = { start = [1.0, 0.0] }
"""
JARGON = ("Input", "constrained", "union", "tagged", "items", "function-", "Value error", "dict", "tuple", "list",
          "Extra", "Field", "validation")  # fmt: skip


def said(text: str, *overrides: str) -> str:
    """Returns the line about the mistake in a scenario, or an empty string if there is no mistake."""
    try:
        parse(text, "t.toml", overrides)
    except ScenarioError as error:
        return str(error)
    return ""


def test_the_base_scenario_loads():
    assert said(BASE) == ""


@pytest.mark.parametrize(
    ("change", "line"),
    [
        # Numbers
        (("duration = 1.0", "duration = 0"), "duration = 0: must be greater than 0"),
        (("duration = 1.0", "duration = nan"), "duration = nan: must be a finite number"),
        (("duration = 1.0", "duration = inf"), "duration = inf: must be a finite number"),
        (("duration = 1.0", "duration = '1.0'"), "duration = '1.0': must be a number"),
        (("duration = 1.0", "duration = true"), "duration = true: must be a number"),
        (("duration = 1.0", "duration = 1979-05-27"), "duration = 1979-05-27: must be a number"),
        (("duration = 1.0", "duration = 07:32:00"), "duration = 07:32:00: must be a number"),
        (("duration = 1.0", "duration = [1.0]"), "duration = [1.0]: must be a number"),
        (("duration = 1.0", "duration = {}"), "duration = {...}: must be a number"),
        (
            ("duration = 1.0", f"duration = {'9' * 400}"),
            "duration = an integer of 1329 bits: is too large for a number",
        ),
        (
            ("duration = 1.0", f"duration = 0x{'f' * 5000}"),
            "duration = an integer of 20000 bits: is too large for a number",
        ),
        (("duration = 1.0", "duration = 1.0\nseed = 1.0"), "seed = 1.0: must be a whole number"),
        (("duration = 1.0", "duration = 1.0\nseed = true"), "seed = true: must be a whole number"),
        (("duration = 1.0", "duration = 1.0\nseed = -1"), "seed = -1: must be at least 0"),
        (
            ("duration = 1.0", f"duration = 1.0\nseed = {2**63}"),
            "seed = 9223372036854775808: must be less than 9223372036854775808",
        ),
        (("mass = 10.0", "torque_limit = nan"), "robot.torque_limit = nan: must be greater than 0"),
        (("epsilon = [0.1]", "epsilon = [0.1, 2]"), "law.epsilon.1 = 2: must be at most 1"),
        (("epsilon = [0.1]", "epsilon = []"), "law.epsilon = []: must have 1 or more entries, not 0"),
        (("epsilon = [0.1]", "epsilon = 0.1"), "law.epsilon = 0.1: must be an array"),
        (("epsilon = [0.1]", "epsilon = [0.1]\nlead = 1.5"), "law.lead = 1.5: must be at most 1"),
        # Pairs
        (("start = [1.0, 0.0]", "start = [1.0]"), "formation.robots.b.start = [1.0]: must be two numbers, [x, y]"),
        (("start = [1.0, 0.0]", "start = []"), "formation.robots.b.start = []: must be two numbers, [x, y]"),
        (
            ("start = [1.0, 0.0]", "start = [1, 2, 3]"),
            "formation.robots.b.start = [1, 2, 3]: must be two numbers, [x, y]",
        ),
        (("start = [1.0, 0.0]", "start = 'here'"), "formation.robots.b.start = 'here': must be two numbers, [x, y]"),
        (("start = [1.0, 0.0]", "start = [1, true]"), "formation.robots.b.start.1 = true: must be a number"),
        # Strings and names
        (('name = "t"', "name = 3"), "name = 3: must be a string"),
        (('name = "t"', 'name = "T"'), "name = 'T': a name is a lower-case letter, then up to 31"),
        (("b = { start", "B = { start"), "formation.robots.B: a name is a lower-case letter, then"),
        (("b = { start", '"x\\ty.z" = { start'), 'formation.robots."x\\ty.z": a name is a lower-case'),
        (("b = { start", "'[key]' = { start"), 'formation.robots."[key]": a name is a lower-case'),
        (("b = { start", "'[key]' = { Start"), 'formation.robots."[key]": a name is a lower-case'),
        # One of several
        (
            ("mass = 10.0", "model = 'rigid'"),
            "robot.model = 'rigid': must be one of 'paper', 'rigid_body', 'hill', or 'file.py:Class'; did you mean "
            "'rigid_body'?",
        ),
        (
            ("mass = 10.0", "model = [1]"),
            "robot.model = [1]: must be one of 'paper', 'rigid_body', 'hill', or 'file.py:Class'",
        ),
        (
            ('kind = "circle"', 'kind = "circel"'),
            "trajectory.kind = 'circel': must be one of 'line', 'circle', 'sine', 'waypoints', or 'file.py:Class'; did you "
            "mean 'circle'?",
        ),
        (
            ('kind = "circle"', "kind = 3"),
            "trajectory.kind = 3: must be one of 'line', 'circle', 'sine', 'waypoints'",
        ),
        (
            ('kind = "circle"', ""),
            "trajectory.kind: missing; must be one of 'line', 'circle', 'sine', 'waypoints'",
        ),
        # Keys
        (("radius = 1.0", ""), "trajectory.radius: missing"),
        (("radius = 1.0", "raduis = 1.0"), "trajectory.raduis: unknown key; did you mean 'radius'?"),
        (
            ("radius = 1.0", "radius = 1.0\nspeed = 2"),
            "trajectory.speed: unknown key; known here: centre, phase, radius, rate",
        ),
        (("radius = 1.0", "radius = 1.0\ncircle = 2"), "trajectory.circle: unknown key; known here: centre, phase"),
        (("duration", "duraton"), "duraton: unknown key; did you mean 'duration'?"),
        (("duration = 1.0", ""), "duration: missing"),
        (("mass = 10.0", "maas = 10.0"), "robot.maas: unknown key; did you mean 'mass'?"),
        (("b = { start", "b = { strat"), "formation.robots.b.strat: unknown key; did you mean 'start'?"),
        (("mass = 10.0", "'ma.ss\\n' = 10.0"), "robot.\"ma.ss\\\\n\": unknown key; did you mean 'mass'?"),
        (("mass = 10.0", "'[key]' = 1"), 'robot."[key]": unknown key; known here: arm, bus'),
        # Tables
        (("[trajectory]", "[[trajectory]]"), "trajectory = [{...}]: must be a table"),
        (("[robot]\n", "[[robot]]\n"), "robot = [{...}]: must be a table"),
        (("[formation.robots]\na = {", "[formation]\nrobots = 3\n[other]\na = {"), None),
        (("spacing = 1.0", "spacing = 1.0, side = 2"), "formation.shape: kind = 'line' takes 'spacing', not 'side'"),
        (("spacing = 1.0", ""), None),
        (
            ('shape = { kind = "line", spacing = 1.0 }', 'shape = { kind = "triangle" }'),
            "formation.shape: kind = 'triangle' needs the key 'side'",
        ),
    ],
)
def test_mistakes_in_a_file(change, line):
    before, after = change
    assert before in BASE
    found = said(BASE.replace(before, after, 1))
    if line is None:
        assert found.startswith("t.toml: not TOML: ")
    else:
        assert found.startswith(f"t.toml: {line}")


@pytest.mark.parametrize(
    ("override", "line"),
    [
        ("links.0.delay={min=1,max=0}", "links.0.delay: max = 0.0 must be at least min = 1.0"),
        ("links.0.delay={min=1}", "links.0.delay.max: missing"),
        ("links.0.delay={min=1,maks=2}", "links.0.delay.maks: unknown key; did you mean 'max'?"),
        ("links.0.delay={min=1,max=true}", "links.0.delay.max = true: must be a number"),
        ("links.0.delay=true", "links.0.delay = true: must be a number or a table"),
        ("links.0.delay=[1]", "links.0.delay = [1]: must be a number or a table"),
        ("links.0.delay=-1", "links.0.delay = -1: must be at least 0"),
        ("links.0.policy=zeros", "links.0.policy = 'zeros': must be one of 'hold', 'hold_then_stop', 'zero', 'extrapolate'"),
        ("law.gains.0.k1=x", "law.gains.0.k1 = 'x': must be a number or an array"),
        ("law.gains.0.k1={a=1}", "law.gains.0.k1 = {...}: must be a number or an array"),
        ("law.gains.0.k1=[1]", "law.gains.0.k1.0 = 1: must be an array"),
        ("law.gains.0.k1=[[1,nan]]", "law.gains.0.k1.0.1 = nan: must be a finite number"),
        ("law.gains.0.k1=0", "law.gains.0.k1 = 0: must be greater than 0"),
        ("law.coupling.0={}", "law.coupling.0.value: missing"),
        ("law.coupling.0=3", "law.coupling.0 = 3: must be a table"),
        ("claims=3", "claims = 3: must be an array"),
        ("avoidance.enabled=1", "avoidance.enabled = 1: must be true or false"),
        ("avoidance.enabled=yes", "avoidance.enabled = 'yes': must be true or false"),
        ("avoidance.sensing_radius=0.1", "avoidance: sensing_radius = 0.1 must be larger than avoidance_radius = 0.25"),
        ("can.torque_scale=0", "can.torque_scale = 0: must be greater than 0"),
        ("can.bitrate=9600", "can.bitrate = 9600: must be at least 10000"),
        (
            "formation.groups.coordinator.robots.c.start=[9,9]",
            "formation: 'coordinator' is the name of a process that every run has",
        ),
        ("formation.groups.a.robots.c.start=[9,9]", "formation: 'a' names a robot and a group"),
        ("formation.groups.inter.robots.c.start=[9,9]", "formation: a group cannot be called 'inter': intra"),
        ("formation.groups.g.period=1", "formation.groups.g: a group needs robots or groups"),
        ("formation.groups.g=3", "formation.groups.g = 3: must be a table"),
        ("formation.robots.a=3", "formation.robots.a = 3: must be a table"),
        ("formation.robots=3", "formation.robots = 3: must be a table"),
        ('trajectory={kind="waypoints",points=[[0,0]],times=[0]}',
         "trajectory.points = [[0, 0]]: must have 2 or more entries, not 1"),
        ('trajectory={kind="waypoints",points=[[0,0],[1,1]],times=[1,1]}',
         "trajectory: times must ascend, and no two be equal"),
        ('trajectory={kind="waypoints",points=[[0,0],[1,1]],times=[1,2,3]}',
         "trajectory: 2 points need as many times, not 3"),
        ("law.epsilon=[0.1,0.1]", "law.epsilon = [0.1, 0.1]: must have 1 number with"),
        ("duration=0.015", "duration = 0.015: must be a multiple of 0.01"),
        ("formation.robots.b.start=[0,0]", "formation.robots.b.start = [0.0, 0.0]: is where 'a' starts"),
        # Overrides that cannot be applied
        ("duration", "must read key=value"),
        ("=3", "must read key=value"),
        ("a..b=3", "must read key=value"),
        ("", "must read key=value"),
        ("links.1.loss=0", "1 must be 0, for the first entry"),
        ("links.x.loss=0", "links has no entry yet; give its number: links.0.x.loss"),
        ("links.delay=0", "links has no entry yet; give its number: links.0.delay"),
        ("links.1[2].loss=0", "1 must be 0, for the first entry"),
        ("links[1].loss=0", "1 must be 0, for the first entry"),
        ("links[0]loss=0", '"links[0]loss": unknown key'),
        ("claims.band=0.1", "claims has no entry yet; give its number: claims.0.band"),
        ("law.epsilon.x=0", "x must be a number from 0 to 1"),
        ("law.epsilon.2=0", "2 must be a number from 0 to 1"),
        ("law.epsilon.٠=0.1", "٠ must be a number from 0 to 1"),
        (f"law.epsilon.{'9' * 5000}=0", "9999"),
        ("name.first=x", "first would stand in a value, not in a table"),
        ("name.first.second=x", "second would stand in a value, not in a table"),
    ],
)  # fmt: skip
def test_mistakes_in_an_override(override, line):
    found = said(BASE, override)
    shown = override if len(override) <= 60 else override[:57] + "..."
    start = f"t.toml with --set {shown}: "
    assert found.startswith(start + line)


def test_an_override_is_named_only_where_the_mistake_is():
    assert said(BASE.replace("radius = 1.0", ""), "seed=2").startswith("t.toml: trajectory.radius: missing")
    assert said(BASE, "seed=-1", "seed=-2").startswith("t.toml with --set seed=-2: seed = -2")
    assert said(BASE, "law.lead=2", "law.epsilon=[0.2]").startswith("t.toml with --set law.lead=2: law.lead = 2")


@pytest.mark.parametrize(
    ("overrides", "value"),
    [
        (["law.epsilon=[0.5]"], [0.5]),
        (["law.epsilon.0=0.5"], [0.5]),
        (["law.epsilon.0 = 0.5 # half"], [0.5]),
        (["law={}", "law.epsilon.0=0.5"], [0.5]),
    ],
)
def test_overrides_are_applied_in_order(overrides, value):
    assert parse(BASE, "t.toml", overrides)[0].law.epsilon == value


@pytest.mark.parametrize("text", ['"new', "'new", "[0.1, 0.2", "{delay=0.1", "[0.1 0.2]", "'a' 'b'"])
def test_an_override_that_begins_as_toml_and_is_none_is_refused(text):
    assert said(BASE, f"name={text}") == (
        f"t.toml with --set name={text}: {text} begins as TOML, but is none; is a quote or a bracket missing?"
    )


def test_overrides_make_the_tables_and_arrays_they_need():
    scenario, _ = parse(
        BASE, "t.toml", ["links.0.loss=0.5", "links.1.delay.min=0", "links.1.delay.max=0.1", "name=new_name"]
    )
    assert [rule.loss for rule in scenario.links] == [0.5, 0.0]
    assert scenario.name == "new_name"
    nested, _ = parse(BASE, "t.toml", ["law.gains.0.block=centroid", "law.gains.0.k1.0.0=1.0", "law.gains.0.k1.0.1=0.0",
                                       "law.gains.0.k1.1=[0.0,1.0]"])  # fmt: skip
    assert nested.law.gains[0].k1 == [[1.0, 0.0], [0.0, 1.0]]


@pytest.mark.parametrize(
    "overrides",
    [
        ["links.0.delay=0.1", "links.0.loss=0.5"],
        ["links[0].delay=0.1", "links[0].loss=0.5"],
        ["links.0.delay=0.1", "links.loss=0.5"],
        ["links=[{delay=0.1}]", "links.loss=0.5"],
        ["links=[{delay=0.1}]", "links[ 0 ] . loss = 0.5"],
        ["links[0].delay.min=0.1", "links.delay.max=0.1", "links.delay=0.1", "links.loss=0.5"],
    ],
)
def test_an_override_of_an_array_may_omit_the_number_of_a_single_entry(overrides):
    (rule,) = parse(BASE, "t.toml", overrides)[0].links
    assert (rule.delay, rule.loss) == (0.1, 0.5)


def test_entries_of_arrays_in_arrays_and_tables():
    scenario, _ = parse(
        BASE, "t.toml", ["law.gains=[{k1=[[1.0, 0.0], [0.0, 1.0]],block='centroid'}]", "law.gains.k1[1][1]=2.0"]
    )
    assert scenario.law.gains[0].k1 == [[1.0, 0.0], [0.0, 2.0]]


@pytest.mark.parametrize(
    ("rules", "says"),
    [
        (2, "links has 2 entries; give its number: links.0.delay or links.1.delay"),
        (4, "links has 4 entries; give its number: links.0.delay, …, links.3.delay"),
    ],
)
def test_an_override_of_an_array_with_several_entries_needs_a_number(rules, says):
    text = BASE + "[[links]]\nloss = 0.1\n" * rules
    assert said(text, "links.delay=0.1") == f"t.toml with --set links.delay=0.1: {says}"


# Several at once


def lines(text: str, *overrides: str) -> list[str]:
    """Returns the lines about the mistakes in a scenario."""
    with pytest.raises(ScenarioError) as caught:
        parse(text, "t.toml", overrides)
    return str(caught.value).splitlines()


def test_all_mistakes_in_values_are_reported():
    text = BASE.replace("duration = 1.0", "duration = 0").replace("mass = 10.0", "maas = 10.0")
    assert lines(text.replace("rate = 0.5", ""), "seed=-1") == [
        "t.toml: duration = 0: must be greater than 0",
        "  with --set seed=-1: seed = -1: must be at least 0",
        "  robot.maas: unknown key; did you mean 'mass'?",
        "  trajectory.rate: missing",
    ]


def test_all_mistakes_between_tables_are_reported():
    overrides = ["duration=0.015", "law.gains=[{block='x'},{block='y'}]", "links=[{source='q'},{source='r'}]"]
    found = lines(BASE, *overrides, "formation.robots.b.start=[0,0]")
    assert [line.split(": ")[1] for line in found] == [
        "formation.robots.b.start = [0.0, 0.0]", "duration = 0.015", "law.gains.0.block = 'x'",
        "law.gains.1.block = 'y'", "links.0.source = 'q'", "links.1.source = 'r'",
    ]  # fmt: skip


def test_all_overrides_that_cannot_be_applied_are_reported():
    found = lines(BASE, "duration", "seed=2", "links.delay=1")
    assert [line.partition(": ")[0] for line in found] == ["t.toml with --set duration", "  with --set links.delay=1"]


def test_a_mistake_that_all_robots_inherit_is_reported_once():
    text = BASE.replace("mass = 10.0\n", "").replace("arm = 0.4\n", "").replace("epsilon = [0.1]", "")
    missing = "missing (neither here, nor in its group, nor in [robot]); the same holds for 1 more"
    assert lines(text)[1:] == [
        f"  formation.robots.a.mass: {missing}",
        f"  formation.robots.a.arm: {missing}",
    ]
    # Mistakes in the tree come first.
    heavy = lines(BASE, "robot.inertia=0.1", "formation.shape={kind='triangle',side=1}", "periods.torque=0.003")
    assert [line.rpartition(" = ")[0].rpartition(" ")[2] for line in heavy[:2]] == [
        "periods.acceleration", "formation.shape.kind",
    ]  # fmt: skip
    assert heavy[2].startswith("  formation.robots.a.inertia = 0.1: ")
    assert heavy[2].endswith("must be larger than mass·offset² = 0.4; the same holds for 1 more")


NEEDED = ("mass = 10.0", "inertia = 0.5", "wheel_radius = 0.1", "arm = 0.4", "offset = 0.2", "start = [1.0, 0.0]")


@pytest.mark.parametrize("given", NEEDED)
@pytest.mark.parametrize(
    ("other", "line"),
    [
        ("duration=0", "duration = 0: must be greater than 0"),
        ("duration=0.015", "duration = 0.015: must be a multiple of 0.01"),
        ("links=[{source='q'}]", "links.0.source = 'q': fits no member"),
        ("periods.torque=0.003", "periods.torque = 0.003: must divide"),
    ],
)
def test_a_missing_key_of_a_robot_is_reported_with_all_other_mistakes(given, other, line):
    key, robot = given.split(" = ")[0], "b" if given.startswith("start") else "a"
    first, missing = lines(BASE.replace(given, ""), other)
    assert first.startswith(f"t.toml with --set {other}: {line}")
    assert missing.startswith(
        f"  formation.robots.{robot}.{key}: missing (neither here, nor in its group, nor in [robot])"
    )


def test_robots_without_a_start_do_not_start_in_one_place():
    nowhere = BASE.replace("start = [0.0, 0.0]", "").replace("start = [1.0, 0.0]", "")
    missing = "missing (neither here, nor in its group, nor in [robot]); the same holds for 1 more"
    assert lines(nowhere) == [f"t.toml: formation.robots.a.start: {missing}"]


@pytest.mark.parametrize("given", NEEDED[:-1])
@pytest.mark.parametrize("table", ["robot", "formation.robot", "formation.robots.a"])
def test_a_key_of_a_robot_may_stand_on_any_level(given, table):
    key, value = given.split(" = ")
    robots = ("a", "b") if table.endswith("a") else ("a",)
    overrides = [f"{table.replace('.a', f'.{robot}')}.{key}={value}" for robot in robots]
    assert said(BASE.replace(given, ""), *overrides) == ""


@pytest.mark.parametrize("table", ["robot", "formation.robot", "formation.robots"])
def test_tables_of_robots_that_are_no_tables_are_one_mistake(table):
    text = BASE.replace("[robot]\n", "[other]\n") if table == "robot" else BASE
    found = [line for line in lines(text, f"{table}=3") if "other" not in line]
    assert found == [f"t.toml with --set {table}=3: {table} = 3: must be a table"]


def test_an_error_shows_a_limited_number_of_lines():
    robots = "".join(f"r{n} = {{ start = [{n}.0, nan] }}\n" for n in range(100))
    found = lines(BASE.replace("b = { start = [1.0, 0.0] }", robots))
    assert len(found) == 21
    assert found[-1] == "  and 80 more"


def test_an_error_about_a_default_calls_it_a_default():
    assert said(BASE.replace("[law]\nepsilon = [0.1]", "")) == (
        "t.toml: law.epsilon = [0.7, 0.7], its default (the scenario gives none): must have 1 number with "
        "time_scales = 'three', as many as layers of the tree"
    )
    huge = said(BASE.replace("epsilon = [0.1]", "epsilon = [1e-200]"))
    assert huge.startswith("t.toml: law.epsilon = [1e-200]: the gains of ")


def test_the_value_of_an_override_is_a_single_value():
    assert parse(BASE, "t.toml", ["description=1\nname='x'"])[0].description == "1\nname='x'"


# Files


@pytest.mark.parametrize(
    ("content", "line"),
    [
        (b"", "empty; a scenario needs name, duration, formation, trajectory"),
        (b"# nothing\n", "empty; a scenario needs"),
        (b"\xff\xfe", "is not UTF-8 text (byte 0)"),
        (b"a = 1\na = 2\n", "not TOML: Cannot overwrite a value (at line 2,"),
        (b"[a]\n[a]\n", "not TOML: Cannot declare"),
        (b"a = \n", "not TOML: Invalid value (at line 1,"),
        (b"a = " + b"[" * 5000, "not TOML"),
        (b"a = " + b"9" * 5000, "an integer has too many digits"),
        (b"a." * 200_000 + b"b = 1", "not TOML that can be read: a key of 1000 parts or more"),
        (b'"=".' * 200_000 + b"b = 1", "not TOML that can be read: a key of 1000 parts or more"),
        (b"[" + b"a . " * 200_000 + b"b]", "not TOML that can be read: a key of 1000 parts or more"),
        (b"a\0b = 1", "not TOML: "),
    ],
)
def test_files_that_are_not_scenarios(tmp_path, content, line):
    path = tmp_path / "x.toml"
    path.write_bytes(content)
    with pytest.raises(ScenarioError) as caught:
        load(path)
    assert str(caught.value).startswith(f"{path}: {line}")
    assert len(str(caught.value).splitlines()) == 1


@pytest.mark.parametrize(
    "more", ["name = 'x'\n", "robot.mass = 2.0\n", "[robot]\nmass = 2.0\n", "robot = { mass = 2.0 }\n", "[name]\n"]
)
@pytest.mark.parametrize("robot", ["robot = { mass = 4.0 }\n", "[robot]\nmass = 4.0\n[robot.drive]\n"])
def test_a_key_that_is_there_already_is_said_to_be_there(robot, more):
    text = f"name = 'x'\n{robot}"
    if robot.startswith("[") and "[" not in more:  # at the end it would be a key of the last table
        text = f"{more}{text}"
    with pytest.raises(ScenarioError, match="is there already: change it at its first place") as caught:
        parse(text if text.startswith("robot.") or text.count("name = ") > 1 else text + more, "t.toml")
    assert len(str(caught.value).splitlines()) == 1


def test_files_that_cannot_be_read(tmp_path):
    for path, line in (
        (tmp_path, "Is a directory"),
        (tmp_path / "none.toml", "No such file or directory"),
        (tmp_path / "x.toml" / "y", "No such file or directory"),
        (tmp_path / ("n" * 300), "File name too long"),
        (Path("zero\0byte"), "embedded null byte"),
    ):
        with pytest.raises(ScenarioError) as caught:
            load(path)
        assert str(caught.value) == one_line(f"{path}: {line}")


def test_a_byte_order_mark_and_dos_line_ends_are_no_mistakes(tmp_path):
    path = tmp_path / "x.toml"
    path.write_bytes(b"\xef\xbb\xbf" + BASE.replace("\n", "\r\n").encode())
    assert load(path)[0] == parse(BASE, "t.toml")[0]


def test_a_tree_too_deep_is_refused():
    text = BASE + "[formation.groups." + "g.groups." * 400 + "g]\n"
    assert said(text) == "t.toml: formation: groups are nested too deep"


# Parts


@pytest.mark.slow
@given(st.lists(st.text() | st.integers(0, 99), max_size=4))
def test_keys_are_one_line(keys):
    assert len(one_line(key_text(keys)).splitlines()) <= 1
    plain = [key for key in keys if isinstance(key, int) or (key and set(key) <= set(string.ascii_letters + "_-"))]
    assert key_text(plain) == ".".join(map(str, plain))


@pytest.mark.parametrize(
    ("value", "text"),
    [(True, "true"), ([False, 1], "[false, 1]"), ("a", "'a'"), (math.inf, "inf"), (date(2020, 1, 2), "2020-01-02"),
     ({"a": 1}, "{...}"), (10**4000, "an integer of 13288 bits"), ("x" * 99, "'" + "x" * 56 + "..."),
     ([1] * 99, "[" + "1, " * 18 + "1,...")],
)  # fmt: skip
def test_values(value, text):
    assert value_text(value) == text


def test_texts_are_plain_english():
    assert not [text for text in TEXTS.values() for word in JARGON if word in text]


# Mutations: any text is either a scenario, or its mistakes are explained

keys = st.text(min_size=1, max_size=8) | st.sampled_from(
    ["kind", "[key]", "delay", "line", "a number", "an array", "x y"]
)
values: st.SearchStrategy[Any] = st.recursive(
    st.one_of(
        st.booleans(),
        st.integers(-3, 3),
        st.integers(),
        st.sampled_from([10**400, -(10**30), 2**63, 0, 1]),
        st.floats(),
        st.sampled_from([math.nan, math.inf, -math.inf, 1e308, 5e-324, 1e-9, 0.1, 1e200]),
        st.text(max_size=8),
        st.sampled_from(
            ["three", "multi", "line", "circle", "sine", "waypoints", "points", "vectors", "*", "intra", "**"]
        ),
        st.dates(),
        st.times(),
        st.datetimes(),
    ),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(keys, inner, max_size=3),
    max_leaves=6,
)


def places(value: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Returns the paths to all values in a table, at any depth."""
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    return [place for key, item in inner for place in places(item, (*path, key))] + ([path] if path else [])


def is_number(value: Any, path: tuple[Any, ...]) -> bool:
    """True if the value at a path is a number (and not a bool)."""
    for key in path:
        value = value[key]
    return isinstance(value, float | int) and not isinstance(value, bool) and abs(value) < 10**300


@st.composite
def mutated(draw: st.DrawFn) -> str:
    """Returns a shipped scenario as TOML text, with a few keys or values deleted, renamed, replaced or added."""
    table = copy.deepcopy(TABLES[draw(st.sampled_from(sorted(TABLES)))])
    for _ in range(draw(st.integers(1, 2))):
        how = draw(st.sampled_from(["delete", "rename", "replace", "insert", "nudge", "nudge"]))
        paths = [path for path in places(table) if how != "nudge" or is_number(table, path)]
        if not paths:
            break
        *way, last = draw(st.sampled_from(paths))
        at: Any = table
        for key in way:
            at = at[key]
        match how:
            case "delete":
                del at[last]
            case "rename" if isinstance(at, dict):
                at[draw(keys)] = at.pop(last)
            case "insert" if isinstance(at, dict):
                at[draw(keys)] = draw(values)
            case "nudge":
                factor = draw(st.sampled_from([-1, 0, 2, 10, 1e-3, 1e9, 1e300]))
                with suppress(OverflowError):  # an integer too large for a float
                    at[last] *= factor
            case _:
                at[last] = draw(values)
    return tomlkit.dumps(table)


def check(text: str, *overrides: str) -> bool:
    """Checks that a text is a scenario, or that its mistakes are explained in plain lines; the first line names the file.
    Returns True if it is a scenario."""
    try:
        parse(text, "some file.toml", overrides)
    except ScenarioError as error:
        lines = str(error).splitlines()
        assert lines[0].startswith("some file.toml")
        assert all(line.startswith("  ") for line in lines[1:])
        assert len(set(lines)) == len(lines) <= 21
        for line in lines:
            assert len(line) < 1000
            assert line.isprintable()
            # Apart from the user's own text, no line has words of pydantic.
            for word in ("Input should", "constrained", "function-", "validation", "Value error"):
                assert word not in line or any(word in written for written in (text, *overrides))
        return False
    return True


TABLES = {name: tomlkit.parse(text).unwrap() for name, text in TEXTS_OF.items()}
fuzz = settings(max_examples=1500, suppress_health_check=list(HealthCheck))


@pytest.mark.slow
@fuzz
@given(mutated())
def test_mutated_scenarios_load_or_are_explained(text):
    check(text)


def override_keys() -> list[str]:
    """Returns keys that an override may name, as users write them."""
    found = {".".join(map(str, path)) for table in TABLES.values() for path in places(table)}
    more = [
        "links.0.delay",
        "links.0.delay.min",
        "links.0.source",
        "law.gains.0.k1",
        "law.gains.0.k1.0.0",
        "law.coupling.0",
    ]
    return sorted(found | set(more))


@pytest.mark.slow
@fuzz
@given(
    st.sampled_from(sorted(TEXTS_OF)),
    st.lists(
        st.tuples(
            st.sampled_from(override_keys()) | st.text(max_size=12),
            st.text(max_size=12) | values.map(lambda value: tomlkit.item(value).as_string()),
        ).map("=".join)
        | st.text(max_size=20),
        min_size=1,
        max_size=3,
    ),
)
def test_any_override_is_applied_or_explained(name, overrides):
    check(TEXTS_OF[name], *overrides)


@pytest.mark.slow
@fuzz
@given(st.text(max_size=200) | st.text(alphabet="[]{}=.,\"'\n#ab1 -_:T", max_size=80))
def test_any_text_is_a_scenario_or_explained(text):
    assert not check(text)


@pytest.mark.slow
@settings(fuzz, max_examples=500)
@given(st.sampled_from(sorted(TEXTS_OF)), st.data())
def test_a_damaged_file_loads_or_is_explained(name, data):
    text = TEXTS_OF[name]
    at = data.draw(st.integers(0, len(text)))
    check(text[:at] + data.draw(st.text(max_size=4)) + text[at + data.draw(st.integers(0, 40)) :])
