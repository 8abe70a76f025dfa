"""A hundred thousand hostile payloads into each inbox of each process: none raises, all are counted, and nothing else changes.

A robot, a leader, the coordinator, bridge and drives each run on the messages of an honest run.  Between these they get
payloads that are wrong in one way each.  What they send must be the same as without.  Then they get messages with some bits
turned, of which they may take some.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import echelon.runtime.paced
from echelon.bridge.frame_message import FrameBounds
from echelon.bridge.stations.waiting import Mail
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.runtime.admission import AGAIN, FUTURE, MISSHAPEN, OF_ANOTHER, TIME
from echelon.runtime.lockstep import LockstepRunner
from echelon.runtime.paced import PacedRunner
from echelon.runtime.wire import data_key, encode, join
from echelon.sim.engines.in_process import Engine, make_role
from echelon.sim.processes.contract import watch_keys
from echelon.sim.processes.ends_at import EndsAt
from echelon.sim.processes.watchers import Reception
from echelon.sim.recording.time_order import speakers
from support.hostile import Heard, mutated, refused
from support.memory import memory_below
from support.runs import plan_of

COUNT = 100_000
START_NS = 1_000_000_000
MEMORY = 4_000_000
"""What a receiver may keep of hostile payloads and of its own run [bytes]"""


@cache
def story(*overrides: str) -> tuple[Plan, list[Message]]:
    """Returns a plan and all messages of its run in one process."""
    plan, messages = plan_of("lab", "duration=1.0", *overrides), list[Message]()
    Engine(plan, messages.append).run()
    return plan, messages


def heard_by(plan: Plan, index: int) -> dict[tuple[int, Channel], Heard]:
    """Returns what a role hears, by source and channel."""
    return {
        (link.source, link.channel): Heard(
            link.source, link.channel, link.first_ns, link.period_ns, link.size or 9, link.size is not None
        )
        for link in plan.links_into(index)
    }


def check_counts(counts: dict[str, dict[str, int]], ways: Counter[str]) -> None:
    """Compares the counts of refusals with the ways in which payloads were wrong."""
    found: Counter[str] = Counter()
    for reasons in counts.values():
        found.update(reasons)
    assert found.total() == ways.total()
    assert found[AGAIN] == ways["again"]
    assert found[TIME] == ways["time"]
    assert found[FUTURE] == ways["future"]
    assert found[MISSHAPEN] == ways["size"]
    assert found[OF_ANOTHER] >= ways["source"]
    assert found["another schema version"] >= ways["version"]
    assert len(found) <= 11


class Role:
    """A role that runs in this thread, on the messages that are given to it; `said` is what it sends."""

    def __init__(self, plan: Plan, index: int, *, virtual: bool) -> None:
        self.doors: dict[str, Callable[[bytes], None]] = {}
        self.said: list[bytes] = []
        self._paths = [one.path for one in plan.all_roles]
        session: Any = SimpleNamespace(
            subscribe=self.doors.__setitem__, publisher=lambda key: SimpleNamespace(put=self.said.append)
        )
        role = make_role(plan, index)
        self.runner: LockstepRunner | PacedRunner
        if virtual:
            self.runner = LockstepRunner(role, plan, session, "run", watched=False, frames=FrameBounds(plan))
        else:
            self.runner = PacedRunner(role, plan, session, "run", watched=False)
            self.runner._start_ns, self.runner._started = START_NS, True
        self.move()

    def door(self, source: int, channel: Channel) -> Callable[[bytes], None]:
        """Returns the function that takes the payloads of a source on a channel."""
        return self.doors[data_key("run", self._paths[source], channel)]

    def move(self) -> None:
        """Does what the main thread does."""
        runner = self.runner
        if isinstance(runner, PacedRunner):
            runner._pace()
        else:
            while not runner._in_handler and not runner._finished:
                runner._in_handler = not runner._advance()


Hostile = Callable[[Role, Message, dict[tuple[int, Channel], int]], None]


def run_role(plan: Plan, messages: list[Message], index: int, virtual: bool, hostile: Hostile | None) -> Role:
    """Runs a role on the messages of an honest run; before each, hostile payloads come."""
    clock = SimpleNamespace(now_ns=START_NS)
    clock.monotonic_ns = lambda: clock.now_ns
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(echelon.runtime.paced, "time", clock)
        role, heard = Role(plan, index, virtual=virtual), heard_by(plan, index)
        newest = dict.fromkeys(heard, -1)
        for message in messages:
            key = message.source, message.channel
            if key in heard:
                clock.now_ns = max(clock.now_ns, START_NS + message.time_ns)
                if hostile is not None:
                    hostile(role, message, newest)
                role.door(*key)(encode(message))
                newest[key] = message.sequence
                role.move()
        clock.now_ns += 10 * plan.duration_ns
        role.move()
    assert role.runner._failure is None
    return role


ROLES = [
    pytest.param((), 0, True, id="robot-lockstep"),
    pytest.param((), 0, False, id="robot-wall"),
    pytest.param((), 9, True, id="leader-lockstep"),
    pytest.param((), 9, False, id="leader-wall"),
    pytest.param((), 12, True, id="coordinator-lockstep"),
    pytest.param((), 12, False, id="coordinator-wall"),
    pytest.param(("can.path=closed",), 0, True, id="closed-robot-lockstep"),
    pytest.param(("can.path=closed",), 0, False, id="closed-robot-wall"),
    pytest.param(("can.path=closed",), 13, True, id="bridge-lockstep"),
    pytest.param(("can.path=closed",), 14, True, id="drives-lockstep"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("overrides", "index", "virtual"), ROLES)
def test_a_role_refuses_all_that_is_wrong_and_does_what_it_does_without(
    overrides: tuple[str, ...], index: int, virtual: bool
) -> None:
    plan, messages = story(*overrides)
    heard = heard_by(plan, index)
    honest = run_role(plan, messages, index, virtual, None)
    assert honest.said
    assert not honest.runner.refusals.total
    luck, ways = np.random.default_rng(index), Counter[str]()
    each = 1 + COUNT // sum((message.source, message.channel) in heard for message in messages)

    def hostile(role: Role, message: Message, newest: dict[tuple[int, Channel], int]) -> None:
        key = message.source, message.channel
        payloads, wrong = refused(heard[key], each, newest[key], message.time_ns, luck)
        door = role.door(*key)
        for payload in payloads:
            door(payload)
        ways.update(wrong)

    attacked = run_role(plan, messages, index, virtual, hostile)
    assert ways.total() >= COUNT
    assert attacked.said == honest.said
    check_counts(attacked.runner.refusals.by_source(), ways)


@pytest.mark.slow
@pytest.mark.parametrize(("overrides", "index", "virtual"), ROLES)
def test_nothing_that_comes_raises_or_fills_memory(overrides: tuple[str, ...], index: int, virtual: bool) -> None:
    """Messages with some bits turned are taken or not; of robots' states and of frames whatever can stand there."""
    plan, messages = story(*overrides)
    heard = heard_by(plan, index)
    luck = np.random.default_rng(index)
    each = 1 + COUNT // sum((message.source, message.channel) in heard for message in messages)

    def hostile(role: Role, message: Message, newest: dict[tuple[int, Channel], int]) -> None:
        door = role.door(message.source, message.channel)
        for payload in mutated(encode(message), each, luck):
            door(payload)

    with memory_below(MEMORY):
        role = run_role(plan, messages, index, virtual, hostile)
    assert role.runner.refusals.total > 0.5 * COUNT
    waiting = [len(slot.newer) + len(slot.link._flying) for slot in role.runner.mailbox._slots.values()]
    assert max(waiting) < 1000


@pytest.mark.slow
@pytest.mark.parametrize("index", [13, 14], ids=["bridge", "drives"])
def test_mail_of_bridge_and_drives_on_a_wall_clock(index: int) -> None:
    plan, messages = story("can.path=closed")
    mail, luck, ways = Mail(plan, index, wakes=False), np.random.default_rng(1), Counter[str]()
    heard = {key: one for key, one in heard_by(plan, index).items() if key[1] is Channel.TORQUE}
    doors, newest, now = mail.doors(), dict.fromkeys(heard, -1), [0]
    mail.now = lambda: now[0]
    torques = [message for message in messages if (message.source, message.channel) in heard]
    taken = []
    for message in torques:
        now[0], key = message.time_ns, (message.source, message.channel)
        payloads, wrong = refused(heard[key], 1 + COUNT // len(torques), newest[key], message.time_ns, luck)
        for payload in [*payloads, encode(message)]:
            doors[message.source](payload)
        newest[key] = message.sequence
        ways.update(wrong)
        taken += mail.take()
    assert [encode(message) for message in taken] == [encode(message) for message in torques]
    check_counts(mail.refusals.by_source(), ways)
    for message in torques:
        for payload in mutated(encode(message), 1 + COUNT // len(torques), luck):
            doors[message.source](payload)
    assert len(mail.take()) < 10 * len(torques)


class Copies:
    """A reception whose batches come from the test."""

    def __init__(self, plan: Plan, *, virtual: bool, sources: list[int]) -> None:
        self.kept: list[list[Message]] = []
        spec: Any = SimpleNamespace(plan=plan, run="run", virtual=virtual)
        session: Any = SimpleNamespace(checked_inbox=self._inbox)
        self._keys = watch_keys("run", plan, sources)
        self.reception = Reception(spec, session, sources, 8)
        self.reception.begin(START_NS)

    def _inbox(self, doors: dict[str, Callable[[bytes], list[Message] | None]], high_water: int) -> Any:
        self.doors = doors

        def take(timeout_s: float) -> list[list[Message]]:
            kept, self.kept = self.kept, []
            return kept

        return SimpleNamespace(take=take)

    def put(self, source: int, batch: bytes) -> None:
        """Lets a batch in at the door of a source."""
        messages = self.doors[self._keys[source]](batch)
        if messages is not None:
            self.kept.append(messages)


def batched(payloads: list[bytes]) -> Iterator[bytes]:
    """Yields payloads in batches."""
    for at in range(0, len(payloads), 50):
        yield join(payloads[at : at + 50])


@pytest.mark.slow
@pytest.mark.parametrize("virtual", [True, False])
@pytest.mark.parametrize("who", ["recorder", "closed recorder", "mirroring bridge"])
def test_receivers_of_copies(who: str, virtual: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    from echelon.sim.processes import watchers

    plan, messages = story(*(["can.path=closed"] if who == "closed recorder" else []))
    clock = SimpleNamespace(now_ns=START_NS)
    clock.monotonic_ns, clock.monotonic = lambda: clock.now_ns, lambda: clock.now_ns / 1e9
    monkeypatch.setattr(watchers, "time", clock)
    sources = list(range(9)) if who == "mirroring bridge" else list(speakers(plan, virtual, has_bus=False))
    copies = Copies(plan, virtual=virtual, sources=sources)
    heard = {}
    for link in plan.links:
        heard[link.source, link.channel] = Heard(
            link.source, link.channel, link.first_ns, link.period_ns, link.size or 9, link.size is not None
        )
    wanted = [message for message in messages if message.source in sources]
    if not virtual:  # frames are numbered otherwise on a wall clock
        wanted = [message for message in wanted if message.channel is not Channel.FRAMES]
    newest, luck, ways, out = dict.fromkeys(heard, -1), np.random.default_rng(1), Counter[str](), list[Message]()
    for message in wanted:
        clock.now_ns = max(clock.now_ns, START_NS + message.time_ns)
        key = message.source, message.channel
        payloads, wrong = refused(
            heard[key], 1 + COUNT // len(wanted), newest[key], message.time_ns, luck, without="channel"
        )
        for batch in batched(payloads):
            copies.put(message.source, batch)
        copies.put(message.source, join([encode(message)]))
        out += copies.reception.take(0.0)
        newest[key] = message.sequence
        ways.update(wrong)
    out += copies.reception._order.rest()
    in_order = sorted(wanted, key=lambda each: (each.time_ns, each.source, each.channel))
    assert [encode(message) for message in out] == [encode(message) for message in in_order]
    check_counts(copies.reception.refusals.by_source(), ways)
    assert not copies.reception.finish()


@pytest.mark.slow
@pytest.mark.parametrize("virtual", [True, False])
def test_a_recording_takes_whatever_is_admitted(virtual: bool, tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Batches and messages with some bits turned: what is admitted can be recorded."""
    from echelon.sim.processes import watchers

    plan, messages = story("can.path=closed")
    clock = SimpleNamespace(now_ns=START_NS)
    clock.monotonic_ns, clock.monotonic = lambda: clock.now_ns, lambda: clock.now_ns / 1e9
    monkeypatch.setattr(watchers, "time", clock)
    sources = list(speakers(plan, virtual, has_bus=True))
    copies = Copies(plan, virtual=virtual, sources=sources)
    recording = watchers.RunRecorder(tmp_path, plan, "scenario", {}, ends_at=EndsAt.NOWHERE)
    luck, fed = np.random.default_rng(2), 0
    wanted = [message for message in messages if message.source in sources]
    for message in wanted:
        clock.now_ns = max(clock.now_ns, START_NS + message.time_ns)
        hostile = mutated(encode(message), 1 + COUNT // len(wanted), luck)
        fed += len(hostile)
        for batch in [*batched(hostile), *mutated(join([encode(message)]), 10, luck), join([encode(message)])]:
            copies.put(message.source, batch)
        recording.add(copies.reception.take(0.0))
    recording.add(copies.reception._order.rest())
    recording.close([])
    report = recording.report()
    assert report.failure is None
    assert report.messages <= fed + 11 * len(wanted)
    assert copies.reception.refusals.total > 0.5 * COUNT
