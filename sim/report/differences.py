"""What differs between the scenarios of several runs, and how they were run."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import tomlkit

from echelon.sim.results.records import Summary

ABSENT: Final = "–"
RUN_KEYS: Final = ("engine", "clock", "version")


def differences(scenarios: Sequence[str], summaries: Sequence[Summary]) -> list[list[str]]:
    """Returns a row for each key that has not the same value in all effective scenarios (TOML), or in how the runs were made:
    the key as `--set` takes it, then its value run by run."""
    return differing(scenarios, [{key: str(getattr(summary.run, key)) for key in RUN_KEYS} for summary in summaries])


def differing(scenarios: Sequence[str], facts: Sequence[Mapping[str, str]]) -> list[list[str]]:
    """Does the same with any `facts` about how the runs were made, by name."""
    tables = [dict(_flat(tomllib.loads(scenario))) for scenario in scenarios]
    for table, each in zip(tables, facts, strict=True):
        table |= {f"run: {key}": value for key, value in each.items()}
    keys = dict.fromkeys(key for table in tables for key in table)
    rows = [[key, *(table.get(key, ABSENT) for table in tables)] for key in keys]
    return [row for row in rows if len(set(row[1:])) > 1]


def _flat(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yields keys with their values as TOML writes them; lists of tables are taken apart, others are values."""
    if isinstance(value, Mapping) and value:
        for name, item in value.items():
            yield from _flat(item, f"{key}.{name}" if key else name)
    elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
        for number, item in enumerate(value):
            yield from _flat(item, f"{key}[{number}]")
    else:
        yield key, "{}" if value == {} else str(tomlkit.item(value).as_string())
