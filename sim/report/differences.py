"""The table of differences between several runs: keys of their scenarios, and how they were run."""

import tomllib
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import tomlkit

from echelon.sim.results.records import Summary

ABSENT: Final = "–"
"""Shown for a key that a scenario does not have"""
RUN_KEYS: Final = ("engine", "clock", "version")
"""Fields of `RunFacts` that are compared"""


def differences(scenarios: Sequence[str], summaries: Sequence[Summary]) -> list[list[str]]:
    """Returns a row for each key whose value is not the same in all runs: the key, then its value in each run.

    `scenarios` are the effective scenarios (TOML), `summaries` those of the same runs.  A key of a scenario is written as
    `--set` takes it and as messages write it: `links.0.delay`.  `run: engine` and the like say how a run was made."""
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
    """Yields keys with their values as TOML writes them; an array of tables gives keys for each entry, any other array is one
    value."""
    if isinstance(value, Mapping) and value:
        for name, item in value.items():
            yield from _flat(item, f"{key}.{name}" if key else name)
    elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
        for number, item in enumerate(value):
            yield from _flat(item, f"{key}.{number}")
    else:
        yield key, "{}" if value == {} else str(tomlkit.item(value).as_string())
