"""Makes the text of the scenario that `echelon new` writes: groups of any size, with a comment on each part.

The robots are those of lab.toml.  They start near their desired places, each at a small distance from it."""

from bisect import bisect_left
from collections.abc import Sequence
from math import cos, hypot, sin
from typing import Final

from echelon.bridge.timing.fit import bus_fit
from echelon.errors import UsageError
from echelon.planning import shapes
from echelon.planning.loading import ScenarioError
from echelon.planning.members import MAX_ROBOTS
from echelon.planning.shapes import Point
from echelon.sim.parts.loading import parse

SIDE: Final = 1.0
"""Distance between neighbours in a group [m]"""
BETWEEN: Final = 1.4
"""Distance between the edges of neighbouring groups [m]"""
OFF: Final = 0.15
"""Distance of a robot at the start from its place in the group, and of a group from its place in the formation [m]"""
TURN: Final = 2.4
"""Angle between the directions in which two neighbours are displaced [rad]: the golden angle, which scatters them evenly"""


def sizes(text: str) -> tuple[int, ...]:
    """Returns the sizes of the groups in a text: `2x3` is two groups of three, `2,3,5` three groups.

    Raises UsageError for any other text, and if there are more than `MAX_ROBOTS` robots."""
    first, times, second = text.partition("x")
    numbers = [second] * int(first) if times and first.isdecimal() and len(first) < 4 else text.split(",")
    if not all(number.isdecimal() and 0 < int(number) <= MAX_ROBOTS for number in numbers) or not numbers:
        raise UsageError(
            f"--groups {text}: must be the number of groups x robots in each, like 2x3, or the sizes of groups, like 2,3,5"
        )
    if sum(map(int, numbers)) > MAX_ROBOTS:
        raise UsageError(
            f"--groups {text}: {sum(map(int, numbers))} robots, but a bus has identifiers for {MAX_ROBOTS}"
        )
    return tuple(map(int, numbers))


def scenario_text(name: str, groups: Sequence[int], drive: str | None) -> str:
    """Returns a scenario as TOML.

    `groups` are the sizes of the groups.  `drive` is the protocol of virtual drives that close the torque path; None: the path
    is mirrored.  Raises ScenarioError if `name` is not allowed as a name."""
    text = _text(name, groups, drive, _room(groups, drive))
    parse(text, f"{name}.toml")
    return text


def _room(groups: Sequence[int], drive: str | None) -> int:
    """Returns the largest number of robots that fit one bus, at most all of them and at least 1."""
    robots = sum(groups)
    if _fits(robots, drive):
        return robots
    return bisect_left(range(1, robots), True, key=lambda room: not _fits(room, drive)) or 1


def _fits(robots: int, drive: str | None) -> bool:
    """Returns whether the frames of this number of robots fit a bus of 1 Mbit/s."""
    try:
        _, plan = parse(_text("probe", [robots], drive, robots), "probe.toml")
    except ScenarioError:  # a bus has not enough node ids for them
        return False
    return bus_fit(plan, 0).fits


def _text(name: str, groups: Sequence[int], drive: str | None, room: int) -> str:
    """Returns the scenario with up to `room` robots on a bus."""
    head, drives = _head(name, groups, drive), [_DRIVE.format(protocol=drive)] if drive else []
    buses = _buses(groups, room)
    lines = [head, *drives, _REST, *_bus(buses, drive), *_claims(groups), *_formation(groups, buses)]
    return "\n".join(lines) + "\n"


def _head(name: str, groups: Sequence[int], drive: str | None) -> str:
    robots = sum(groups)
    what = f"{robots} robot{'s' if robots > 1 else ''} in {len(groups)} group{'s' if len(groups) > 1 else ''}"
    how = f"; {drive} drives close the torque path" if drive else ""
    return _HEAD.format(name=name, description=f"{what}, ahead in a straight line{how}")


def _bus(buses: Sequence[Sequence[int]], drive: str | None) -> list[str]:
    """Returns the lines of the table `[can]`."""
    count = len({bus for group in buses for bus in group})
    path = (
        ['path = "closed"  # the plant takes what the drives report; "mirror": the bus only shows the torques']
        if drive
        else []
    )
    several = [f"buses = {{ {', '.join(f'can{number} = {{}}' for number in range(count))} }}"] if count > 1 else []
    return ["[can]", "bitrate = 1_000_000", *path, *several, ""]


def _buses(groups: Sequence[int], room: int) -> list[list[int]]:
    """Returns the number of each robot's bus, group by group.

    If all robots fit one bus (`room`), there is one; else each group has buses of its own, as many as it needs."""
    if sum(groups) <= room:
        return [[0] * size for size in groups]
    first, found = 0, []
    for size in groups:
        found.append([first + robot // room for robot in range(size)])
        first = found[-1][-1] + 1
    return found


def _claims(groups: Sequence[int]) -> list[str]:
    """Returns the lines of the claims, for the blocks that the scenario has."""
    blocks = {"intra": (4.0, max(groups) > 1), "inter": (8.0, len(groups) > 1), "centroid": (15.0, True)}
    lines = ["# Claims: what a run must show, or its verdict is FAILS."]
    for block, (settled_by, there) in blocks.items():
        if there:
            lines += ["[[claims]]", f'block = "{block}"', f"settled_by = {settled_by}  # [s]", ""]
    return lines


def _formation(groups: Sequence[int], buses: Sequence[Sequence[int]]) -> list[str]:
    """Returns the lines of the table `[formation]`: the groups in their shape, and the robots of each in theirs."""
    radius = max(hypot(*point) for size in groups for point in _points(size, SIDE))
    apart = round(2 * radius + BETWEEN, 1)
    middles = _points(len(groups), apart, groups)
    several = max(map(max, buses)) > 0
    lines = [
        "# The tree: a formation of groups, groups of robots.  `shape` is what is desired, `start` where a robot is at time 0."
    ]
    lines += ["[formation]", *_shape(len(groups), apart)]
    robot = 0
    for number, (size, middle) in enumerate(zip(groups, middles, strict=True), start=1):
        lines += ["", f"[formation.groups.g{number}]", *_shape(size, SIDE), f"[formation.groups.g{number}.robots]"]
        for place, bus in zip(_points(size, SIDE), buses[number - 1], strict=True):
            robot += 1
            x, y = (
                middle[axis] + place[axis] + OFF * (turn(TURN * robot) + turn(TURN * number))
                for axis, turn in enumerate((cos, sin))
            )
            on = f', bus = "can{bus}"' if several else ""
            lines.append(f"r{robot} = {{ start = [{x:.2f}, {y:.2f}]{on} }}")
    return lines


def _shape(count: int, side: float) -> list[str]:
    """Returns the line of the desired shape of a number of children; none for one child."""
    if count == 1:
        return []
    kind, key = {2: ("line", "spacing"), 3: ("triangle", "side")}.get(count, ("polygon", "side"))
    return [f'shape = {{ kind = "{kind}", {key} = {side} }}']


def _points(count: int, side: float, weights: Sequence[int] = ()) -> list[Point]:
    """Returns the places of children in their shape, relative to their centroid [m].  `weights` are their numbers of robots."""
    points = {1: [(0.0, 0.0)], 2: shapes.line(2, side), 3: shapes.triangle(side)}.get(count) or shapes.polygon(
        count, side
    )
    heavy = weights or [1] * count
    middle = [sum(w * point[axis] for w, point in zip(heavy, points, strict=True)) / sum(heavy) for axis in (0, 1)]
    return [(point[0] - middle[0], point[1] - middle[1]) for point in points]


_HEAD = """\
# All keys and their meanings: `echelon schema scenario --markdown`.  All values are in SI units.
name = "{name}"
description = "{description}"
duration = 30.0  # [s]
seed = 1  # of all random draws

[periods]
acceleration = 0.01  # of the control loop [s]
torque = 0.01  # of the torque loop in each robot [s]

# Values of all robots.  The table `robot` of a group, and a robot's own table, may replace them.
[robot]
mass = 4.0
inertia = 0.12
wheel_radius = 0.05
arm = 0.15  # half the distance between the wheels
offset = 0.1  # from the axle forward to the point that is controlled
heading = 0.0  # at the start [rad]
torque_limit = 1.5
torque_rate_limit = 100.0
wheel_speed_limit = 40.0
"""
_DRIVE = """\
[robot.drive]
protocol = "{protocol}"
torque_limit = 1.8
rated_torque = 1.0
lag = 0.001  # time constant of the current loop [s]

# Limits of the torque commands on the bus.  A command beyond them is replaced by zero torque.
[robot.envelope]
torque_limit = 1.5
rise_limit = 1.05
fall_limit = 1.05
window_limit = 3.0
"""
_REST = """\
# Desired trajectory of the centroid of all robots.
[trajectory]
kind = "line"
start = [0.8, 0.0]  # its place at time 0; the robots start behind it and catch up
velocity = [0.2, 0.0]

# Each layer has a time scale: the groups settle first, then the formation, then the centroid.
[law]
epsilon = [0.5, 0.5]
lead = 0.5

[[law.gains]]
k1 = 0.25
k2 = 1.0

[avoidance]
enabled = true
avoidance_radius = 0.32
sensing_radius = 0.6
force_limit = 20.0

# Delay and loss of messages, to try out (`echelon analyse` computes how much delay is possible):
# [[links]]
# channel = "state"
# delay = 0.05
# loss = 0.1
"""
