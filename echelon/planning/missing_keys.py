"""Finds the keys that a robot needs but gets from no table: not from its own, its groups' or `[robot]`.

They are found in the tables as they were read, before validation, so that they are reported together with all other mistakes.
"""

from collections.abc import Iterator
from typing import Any, Final

from echelon.planning.explain import close_key, key_text
from echelon.scenario.tables import RobotTable

STAND_INS: Final = {"mass": 1e-300, "inertia": 1e300, "wheel_radius": 1.0, "arm": 1.0, "offset": 1e-9}
"""Values that stand in for missing keys, except `start`.  They are allowed together with any values of the other keys."""
APART: Final = 1e9
"""Distance between the stand-ins for `start` of two robots [m]; they are far from all other robots, too"""


def fill_missing(table: dict[str, Any]) -> list[tuple[str, str]]:
    """Returns the mistakes about missing keys of robots, as pairs of the key and the line for the user.

    `table` is a whole scenario as it was read.  Stand-ins for the missing keys are put into it, so that validation can find
    the remaining mistakes; a plan made with stand-ins must not be used.  A key that several robots lack is reported for the
    first of them.  A misspelled key, or a value where a table should be, is reported by validation and not here."""
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
