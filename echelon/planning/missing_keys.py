"""Keys that every robot needs and that a scenario gives on no level: not to the robot, not to its groups, not in `[robot]`.

They are looked for in the tables of the file, before pydantic reads them, so that they are reported together with all other
mistakes.
"""

from collections.abc import Iterator
from typing import Any, Final

from echelon.planning.explain import close_key, key_text
from echelon.scenario.tables import RobotTable

STAND_INS: Final = {"mass": 1e-300, "inertia": 1e300, "wheel_radius": 1.0, "arm": 1.0, "offset": 1e-9}
"""Allowed values for the keys that every robot needs, except `start`.  With any of them, a robot's inertia is large enough."""
APART: Final = 1e9
"""Distance between stand-ins for `start` [m]: such robots are nowhere near others"""


def fill_missing(table: dict[str, Any]) -> list[tuple[str, str]]:
    """Gives robots stand-ins for the keys that they lack; returns the mistakes: pairs of the key and the line for the user.

    `table` is a whole scenario, as it was read; the stand-ins are put into it.  So the remaining mistakes can be found, but the
    result must not be run if there were any.  A key that several robots lack is reported for the first of them.  Tables that
    are no tables, and keys that an unknown key resembles, are left to pydantic."""
    lacking: dict[str, list[str]] = {}
    formation, shared = table.get("formation"), table.get("robot", {})
    if isinstance(formation, dict) and isinstance(shared, dict):
        for number, (robot, keys, given) in enumerate(_robots(formation, ["formation"], _known(shared))):
            for needed in (*STAND_INS, "start"):
                if needed not in given:
                    robot[needed] = STAND_INS.get(needed, [APART * (number + 1), 0.0])
                    lacking.setdefault(needed, []).append(key_text([*keys, needed]))
    where = "missing (neither here, nor in its group, nor in [robot])"
    return [
        (keys[0], f"{keys[0]}: {where}" + (f"; the same holds for {len(keys) - 1} more" if len(keys) > 1 else ""))
        for keys in lacking.values()
    ]


def _robots(
    group: dict[str, Any], keys: list[str], given: frozenset[str]
) -> Iterator[tuple[dict[str, Any], list[str], frozenset[str]]]:
    """Yields the robots below a group: the robot's table, the path of keys to it, and the keys that some level gives it.

    `keys` is the path to the group, `given` what the levels above it give."""
    shared, robots, groups = (group.get(name, {}) for name in ("robot", "robots", "groups"))
    if not isinstance(shared, dict):
        return
    given |= _known(shared)
    for name, robot in robots.items() if isinstance(robots, dict) else ():
        if isinstance(robot, dict):
            yield robot, [*keys, "robots", name], given | _known(robot)
    for name, sub in groups.items() if isinstance(groups, dict) else ():
        if isinstance(sub, dict):
            yield from _robots(sub, [*keys, "groups", name], given)


def _known(table: dict[str, Any]) -> frozenset[str]:
    """Returns the keys that a robot's table gives; an unknown key counts as the known key that it resembles."""
    return frozenset(key if key in RobotTable.model_fields else close_key(key, RobotTable) or key for key in table)
