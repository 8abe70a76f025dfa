"""A member of a run that turns against it: whoever has a robot's secret floods the run with payloads under the robot's keys.

What is wrong with each payload, and that each inbox refuses it, is tested in tests/runtime/test_hostile_messages.py."""

import os
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from echelon.bridge.can.bus_url import resolve_url
from echelon.messages import NULL, STATE_FIELDS, Channel, Message
from echelon.plan.plan import Plan
from echelon.runtime.credentials import Credentials, new_identity
from echelon.runtime.session import Session
from echelon.runtime.wire import data_key, encode, join, run_keys, watch_key
from echelon.sim.processes.ends_at import EndsAt
from echelon.sim.processes.supervisor import Supervisor
from echelon.sim.recording.mcap_reader import read_trace
from support.hostile import Heard, refused
from support.runs import plan_of, trace_of

ATTACKER = "g1/r1"


class HostileMember:
    """A program with the secrets of the robot `ATTACKER`, beside the true robot."""

    def __init__(self, supervisor: Supervisor, plan: Plan, payloads: Iterator[tuple[Channel, bytes]]) -> None:
        spec = next(spec for spec in supervisor._specs if spec.name == ATTACKER)
        own = replace(spec.credentials.own, zenoh_id=new_identity("x", ()).zenoh_id)
        self._credentials = Credentials(own, run_keys(spec.run), hosts=spec.credentials.hosts)
        self._run, self._connect, self._payloads = spec.run, spec.connect, payloads
        self._channels = sorted({link.channel for link in plan.links if link.source == spec.index})
        self.said = 0
        self._done = threading.Event()
        self._thread = threading.Thread(target=self._attack)

    def __enter__(self) -> "HostileMember":
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._done.set()
        self._thread.join()

    def _attack(self) -> None:
        with Session(listen=[], connect=self._connect, lockstep=False, credentials=self._credentials) as session:
            puts = {
                channel: session.publisher(data_key(self._run, ATTACKER, channel)).put for channel in self._channels
            }
            copy = session.publisher(watch_key(self._run, "robot", ATTACKER)).put
            for channel, payload in self._payloads:
                puts[channel](payload)
                copy(join([payload]))
                self.said += 1
                if self.said % 20 == 0 and self._done.wait(0.005):
                    return


def wrong(plan: Plan) -> Iterator[tuple[Channel, bytes]]:
    """Yields payloads that are refused at any time, for ever."""
    luck = np.random.default_rng(1)
    links = {link.channel: link for link in plan.links if link.source == 0}
    while True:
        for channel, link in links.items():
            heard = Heard(0, channel, link.first_ns, link.period_ns, link.size or 0)
            payloads, _ = refused(heard, 1000, -1, 0, luck)
            yield from ((channel, payload) for payload in payloads)


def ahead(plan: Plan) -> Iterator[tuple[Channel, bytes]]:
    """Yields states that are right in form, and more of them than there are instants: false, not finite, and null messages."""
    period_ns = plan.robots[0].period_ns
    for number in range(10**9):
        values = (np.full(len(STATE_FIELDS), 3.0), np.full(len(STATE_FIELDS), np.nan), NULL)[number % 3]
        yield Channel.STATE, encode(Message(Channel.STATE, 0, number, number * period_ns, values))


@pytest.mark.parametrize("virtual", [True, False])
@pytest.mark.parametrize("path", ["mirror", "closed"])
def test_a_member_that_floods_the_run_changes_nothing_and_is_named(path: str, virtual: bool, tmp_path: Path) -> None:
    plan = plan_of("lab", f"duration={6.0 if virtual else 2.0}", f"can.path={path}", "can.watchdog=2.0")
    supervisor = Supervisor(
        plan, tmp_path, run=f"hostile-{os.getpid()}", virtual=virtual, can_urls=(resolve_url("auto"),)
    )
    with HostileMember(supervisor, plan, wrong(plan)) as attacker:
        outcome = supervisor.run()
    assert outcome.failure is None
    refusals = outcome.refusals()
    assert {each.source for each in refusals} == {ATTACKER}
    expected = {"g1", "recorder", "bridge"} | ({"drives"} if path == "closed" else set())
    assert {each.receiver for each in refusals} == expected
    assert sum(each.messages for each in refusals if each.receiver == "g1") > 500
    assert attacker.said > 1000
    assert max(process.memory_bytes for process in outcome.processes) < 300_000_000
    assert read_trace(tmp_path / "run.mcap", plan).digest() == outcome.trace.digest()
    if virtual:
        assert outcome.trace.digest() == trace_of(plan).digest()


@pytest.mark.parametrize("virtual", [True, False])
def test_a_member_that_lies_ends_no_run_and_is_named(virtual: bool, tmp_path: Path) -> None:
    """Numbers that it has taken are missing from the true robot."""
    plan = plan_of("lab", "duration=2.0")
    supervisor = Supervisor(plan, tmp_path, run=f"hostile-{os.getpid()}", virtual=virtual, ends_at=EndsAt.NOWHERE)
    with HostileMember(supervisor, plan, ahead(plan)):
        outcome = supervisor.run()
    assert outcome.failure is None
    assert {each.source for each in outcome.refusals()} == {ATTACKER}
    assert len(outcome.trace.times_ns[5]) > 0.9 * plan.duration_ns / plan.robots[5].period_ns
    read_trace(tmp_path / "run.mcap", plan)
