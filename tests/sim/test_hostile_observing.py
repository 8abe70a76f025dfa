"""A hundred thousand hostile payloads to an observer of a run: what was sent is printed, and nothing is blamed on others."""

import json
import sys
from ast import literal_eval
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Self

import numpy as np
import pytest

from echelon.cli.observe import ObserveOptions, observe
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.planning.loading import effective_toml
from echelon.runtime.wire import data_key, encode
from echelon.shipped import EFFECTIVE
from echelon.sim import observing
from echelon.sim.engines.in_process import Engine
from echelon.sim.observing import new_gate
from echelon.sim.parts.loading import load
from support.hostile import Heard, mutated, refused
from support.memory import memory_below
from support.runs import SCENARIOS

COUNT = 100_000
MEMORY = 6_000_000
"""What an observer may keep of hostile payloads, with one batch of them [bytes]"""
Doors = dict[str, Callable[[bytes], Message | None]]


class Given:
    """A session whose payloads come from the test: before each `take` those of one batch, each under a key."""

    batches: Iterator[list[tuple[str, bytes]]]

    def __init__(self, **options: Any) -> None:
        self._doors: Doors = {}
        self._gone: Callable[[str], None] = str

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        pass

    def checked_inbox(self, doors: Doors, high_water: int) -> Any:
        self._doors = doors
        return SimpleNamespace(take=self._take)

    def watch_tokens(self, token: str, gone: Callable[[str], None]) -> Any:
        self._gone = gone
        return SimpleNamespace(wait=lambda tokens, timeout_s: [])

    def _take(self, timeout_s: float) -> list[Message]:
        batch = next(self.batches, [])
        if not batch:
            self._gone("token")
        return [message for key, payload in batch if (message := self._doors[key](payload)) is not None]


def never(constant: str) -> None:
    raise AssertionError(f"{constant} is no JSON")


@pytest.fixture
def opened(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Plan, list[Message]]:
    """A folder of a run that is open to observers; returns its plan and all messages that it gives on."""
    scenario, plan = load(SCENARIOS / "lab.toml", ["duration=1.0"])
    (tmp_path / EFFECTIVE).write_text(effective_toml(scenario))
    new_gate("run").ticket.write(tmp_path)
    monkeypatch.setattr(observing, "Session", Given)
    messages = list[Message]()
    Engine(plan, messages.append).run()
    heard = {(link.source, link.channel) for link in plan.links}
    return plan, [message for message in messages if (message.source, message.channel) in heard]


def key_of(plan: Plan, message: Message) -> str:
    """Returns the key under which an observer hears a message."""
    return data_key("run", plan.all_roles[message.source].path, message.channel)


def printed(tmp_path: Path, batches: Iterator[list[tuple[str, bytes]]], *, as_json: bool) -> list[str]:
    """Returns the lines that the command prints of batches of payloads."""
    Given.batches = batches
    with (tmp_path / "lines").open("w") as file, pytest.MonkeyPatch.context() as patch:
        patch.setattr(sys, "stdout", file)
        assert observe(ObserveOptions(run=tmp_path, json=as_json)) == 0
    return (tmp_path / "lines").read_text().splitlines()


def test_what_is_wrong_is_refused_and_the_rest_is_printed(
    opened: tuple[Plan, list[Message]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan, sent = opened
    links = {(link.source, link.channel): link for link in plan.links}
    names, luck = {one.index: one.name for one in plan.all_roles}, np.random.default_rng(1)
    by_source, newest, count = Counter[str](), Counter[tuple[int, Channel]](), 1 + COUNT // len(sent)

    def batches() -> Iterator[list[tuple[str, bytes]]]:
        for message in sent:
            of, key = (message.source, message.channel), key_of(plan, message)
            heard = Heard(*of, links[of].first_ns, links[of].period_ns, links[of].size or 9)
            payloads, wrong = refused(heard, count, newest[of] - 1, message.time_ns, luck)
            newest[of] = message.sequence + 1
            by_source[names[message.source]] += wrong.total()
            yield [(key, payload) for payload in (*payloads, encode(message))]

    honest = printed(tmp_path, iter([[(key_of(plan, one), encode(one))] for one in sent]), as_json=True)
    assert not capsys.readouterr().err
    with memory_below(MEMORY):
        lines = printed(tmp_path, batches(), as_json=True)
    assert by_source.total() >= COUNT
    assert lines == honest
    assert len(lines) == len(sent)
    told, _, counts = capsys.readouterr().err.partition(" messages refused: ")
    assert int(told) == by_source.total()
    assert {name: sum(found.values()) for name, found in literal_eval(counts).items()} == by_source


@pytest.mark.parametrize("as_json", [True, False])
def test_whatever_is_taken_can_be_printed(opened: tuple[Plan, list[Message]], as_json: bool, tmp_path: Path) -> None:
    """Of messages with some bits turned some are taken, and a state may hold what is not finite."""
    plan, sent = opened
    luck, count = np.random.default_rng(2), 1 + COUNT // 2 // len(sent)
    hostile = ([(key_of(plan, one), payload) for payload in mutated(encode(one), count, luck)] for one in sent)
    with memory_below(MEMORY):
        lines = printed(tmp_path, hostile, as_json=as_json)
    assert 100 < len(lines) < 0.25 * COUNT
    if as_json:
        states = [json.loads(line, parse_constant=never) for line in lines]
        assert any(None in said["values"].values() for said in states if said["channel"] == "state")
        assert {said["from"] for said in states} <= {one.name for one in plan.all_roles}
    else:
        assert all(line.isprintable() for line in lines)
        assert any("nan" in line or "inf" in line for line in lines)
