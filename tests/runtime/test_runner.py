"""The runner moves its role as the in-process engine does, whatever the order of messages, and reports errors."""

from __future__ import annotations

import random
import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import echelon.runtime.lockstep
import echelon.runtime.paced
from echelon.messages import Channel, Heard, Message
from echelon.plan.plan import Plan
from echelon.role import Role, Stage
from echelon.runtime.admission import AGAIN, MISSHAPEN, OF_ANOTHER
from echelon.runtime.lockstep import MAX_BATCHES, LockstepRunner
from echelon.runtime.mailbox import MAX_AHEAD
from echelon.runtime.paced import PacedRunner
from echelon.runtime.session import Receive
from echelon.runtime.wire import data_key, decode, encode, split
from echelon.sim.engines.in_process import Engine, make_role
from echelon.sim.results.trace import TraceBuilder
from support.runs import plan_of, trace_of, until

RUN = "test"
TIMEOUT_S = 600.0
LINKS = 'links=[{channel="state",delay={min=0.0,max=0.003},loss=0.1},{channel="command",delay=0.0012,loss=0.05}]'
LATE = 'links=[{channel="state",delay=5.0},{channel="command",delay=5.0}]'
LOST = 'links=[{channel="command",receiver="g1/*",loss=1.0},{channel="group_state",source="g2",loss=1.0}]'


class Network:
    """Sessions in memory.  A payload waits in a queue for its sender and receiver until it is delivered."""

    def __init__(self) -> None:
        self.receivers: dict[str, list[tuple[str, Receive]]] = {}
        self.queues: dict[tuple[str, str], deque[tuple[Receive, bytes]]] = {}
        self.watched: dict[str, list[bytes]] = {}
        self.changed = threading.Condition()

    def session(self, name: str) -> Any:
        """Returns the session of one process."""

        def subscribe(key: str, receive: Receive) -> None:
            self.receivers.setdefault(key, []).append((name, receive))

        def publisher(key: str) -> Any:
            def put(payload: bytes) -> None:
                with self.changed:
                    if "@watch" in key:
                        self.watched.setdefault(key, []).append(payload)
                    for receiver, receive in self.receivers.get(key, ()):
                        self.queues.setdefault((name, receiver), deque()).append((receive, payload))
                    self.changed.notify_all()

            return SimpleNamespace(put=put)

        return SimpleNamespace(subscribe=subscribe, publisher=publisher)

    def deliver(self, choose: random.Random, done: Callable[[], bool]) -> None:
        """Delivers bursts of payloads until `done`; the sender and the receiver of each burst are random."""
        while True:
            with self.changed:
                assert self.changed.wait_for(lambda: done() or any(self.queues.values()), TIMEOUT_S), "all stand still"
                if done():
                    return
                queue = choose.choice([queue for queue in self.queues.values() if queue])
                burst = [queue.popleft() for _ in range(min(len(queue), choose.randint(1, 9)))]
            for receive, payload in burst:
                receive(payload)


class Member:
    """A single runner; the test is its network.  `said` are the payloads that it sends, `batches` the batches of copies."""

    def __init__(self, plan: Plan, role: Role, kind: type[Any] = LockstepRunner) -> None:
        self.said: list[bytes] = []
        self.batches: list[bytes] = []
        self.data_gate, self.watch_gate = threading.Event(), threading.Event()
        self.data_gate.set()
        self.watch_gate.set()
        self.at_gate = threading.Event()
        self.doors: dict[str, Receive] = {}
        self._paths = [one.path for one in plan.all_roles]
        self.failure: BaseException | None = None
        self.waits: list[tuple[int, list[int]]] = []
        self.on_wait: Callable[[], None] = lambda: None
        self.waiting = threading.Event()

        def subscribe(key: str, receive: Receive) -> None:
            self.doors[key] = receive

        def publisher(key: str) -> Any:
            gate, out = (self.watch_gate, self.batches) if "@watch" in key else (self.data_gate, self.said)

            def put(payload: bytes) -> None:
                if not gate.is_set():
                    self.at_gate.set()
                    assert gate.wait(TIMEOUT_S)
                out.append(payload)

            return SimpleNamespace(put=put)

        session: Any = SimpleNamespace(subscribe=subscribe, publisher=publisher)
        self.runner = kind(role, plan, session, RUN, watched=True)
        self.thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        def on_wait(time_ns: int, sources: list[int]) -> None:
            self.waits.append((time_ns, sources))
            self.waiting.set()
            self.on_wait()

        try:
            self.runner.run(on_wait)
        except BaseException as error:
            self.failure = error
        finally:
            self.runner.finish()

    def receive(self, payload: bytes) -> None:
        """Gives the runner a message, under the key of its source and channel."""
        message = decode(payload)
        self.doors[data_key(RUN, self._paths[message.source], message.channel)](payload)

    def near(self, payloads: Sequence[bytes]) -> Iterator[bytes]:
        """Yields messages when a source in the same lockstep sends them: none over `MAX_AHEAD` periods ahead of the runner."""
        for payload in payloads:
            message = decode(payload)
            first_ns = message.time_ns - MAX_AHEAD * (message.time_ns // message.sequence if message.sequence else 0)
            assert until(lambda at=first_ns: self.runner._now_ns() >= at or not self.thread.is_alive(), TIMEOUT_S)  # type: ignore[misc]
            yield payload

    def feed(self, payloads: Sequence[bytes]) -> None:
        """Gives the runner messages as a source in the same lockstep does."""
        for payload in self.near(payloads):
            self.receive(payload)

    def join(self) -> BaseException | None:
        """Waits for the end of the run, and returns what it failed with."""
        self.thread.join(TIMEOUT_S)
        assert not self.thread.is_alive()
        return self.failure

    def stands(self) -> bool:
        """Returns whether the role can't move before the observer reads: enough batches wait, or the main thread sends a batch
        and the handler leaves the next stages to it."""
        assert self.at_gate.wait(TIMEOUT_S)
        return len(self.runner._copies.batches) == MAX_BATCHES or not self.runner._in_handler

    def watched(self) -> list[bytes]:
        """Returns the messages in the batches of copies."""
        return [payload for batch in self.batches for payload in split(batch)]


@cache
def plan_and_digest(name: str, *overrides: str) -> tuple[Plan, str]:
    """Returns a plan, and the digest of its run in one process."""
    plan = plan_of(name, *overrides)
    return plan, trace_of(plan).digest()


@cache
def story(*overrides: str, name: str = "paper") -> tuple[Plan, list[Message]]:
    """Returns a plan, the paper's by default, and all messages of its run in one process."""
    plan, messages = plan_of(name, "duration=0.4", *overrides), list[Message]()
    Engine(plan, messages.append).run()
    return plan, messages


def of(messages: list[Message], source: int, channel: Channel) -> list[bytes]:
    """Returns the payloads of one source on one channel."""
    return [encode(message) for message in messages if message.source == source and message.channel is channel]


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize(
    "wanted",
    [
        ("paper", "duration=0.05"),
        ("paper", "duration=0.05", LINKS),
        ("paper", "duration=0.6", LATE),
        ("paper", "duration=0.4", LOST),
        ("paper", "duration=0.06", LINKS, "formation.period=0.01", "formation.groups.g2.period=0.002"),
        ("three_levels", "duration=0.1", "avoidance.enabled=true"),
    ],
    ids=lambda wanted: "-".join(wanted)[:40],
)
def test_lockstep_gives_the_trace_of_the_engine(wanted: tuple[str, ...], seed: int) -> None:
    plan, digest = plan_and_digest(*wanted)
    network = Network()
    runners = [
        LockstepRunner(make_role(plan, one.index), plan, network.session(one.name), RUN, watched=True)
        for one in plan.formation
    ]
    ended: list[int] = []

    def run(index: int) -> None:
        runners[index].run(lambda time_ns, sources: None)
        with network.changed:
            ended.append(index)
            network.changed.notify_all()

    for index in range(len(runners)):
        threading.Thread(target=run, args=(index,), daemon=True).start()
    network.deliver(random.Random(seed), lambda: len(ended) == len(runners))
    builder = TraceBuilder(plan)
    for batches in network.watched.values():
        for batch in batches:
            for payload in split(batch):
                builder.add(decode(payload))
    assert builder.build().digest() == digest
    assert not any(runner.refusals.total for runner in runners)


def test_a_stall_names_the_members_that_it_waits_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(echelon.runtime.lockstep, "STALL_S", 0.02)
    plan, messages = story()
    leader = plan.nodes[1]
    member = Member(plan, make_role(plan, leader.index))
    states = {child: of(messages, child, Channel.STATE) for child in leader.children}
    first, second, third = leader.children
    for child, count in ((first, 3), (second, 2), (third, 3)):
        for payload in states[child][:count]:
            member.receive(payload)

    def on_wait() -> None:
        if len(member.waits) == 1:
            for payload in of(messages, plan.root.index, Channel.REFERENCE)[:2]:
                member.receive(payload)
        else:
            member.runner.stop()  # the runner ends when it next waits

    member.on_wait = on_wait
    member.thread.start()
    assert isinstance(member.join(), SystemExit)
    assert member.waits == [(0, [plan.root.index]), (2 * plan.robots[0].period_ns, [second])]
    commands = of(messages, leader.index, Channel.COMMAND)[:2]
    groups = of(messages, leader.index, Channel.GROUP_STATE)[:2]
    assert member.said == [payload for pair in zip(groups, commands, strict=True) for payload in pair]
    assert member.watched() == member.said


def test_a_second_order_to_stop_ends_nothing_more() -> None:
    """The first one comes while stages run: the run ends before it waits, and then reports."""
    plan, _ = story()
    member = Member(plan, make_role(plan, plan.robots[0].index))
    member.runner.stop()
    member.thread.start()
    assert isinstance(member.join(), SystemExit)
    member.runner.stop()  # would end the report


def test_garbage_is_counted_and_dropped() -> None:
    plan, messages = story()
    robot = plan.robots[0]
    commands = of(messages, robot.parent, Channel.COMMAND)
    member = Member(plan, make_role(plan, robot.index))
    member.thread.start()
    noise = random.Random(1)
    (door,) = member.doors.values()
    shapeless = 0
    for number, command in enumerate(member.near(commands)):
        other_version = bytes([command[0] + 1]) + command[1:]
        for garbage in (b"", noise.randbytes(noise.randint(1, 90)), command[:-1], other_version):
            door(garbage)
        door(encode(Message(Channel.COMMAND, 999, number, 0, decode(command).values)))
        if (message := decode(command)).values.size:
            for misshapen in (message.values[:-1], np.append(message.values, 0.0)):
                door(encode(message._replace(values=misshapen)))
                shapeless += 1
        door(command)
        door(command)  # the second copy changes nothing
    assert member.join() is None
    refused = member.runner.refusals.by_source()[plan.all_roles[robot.parent].name]
    assert sum(refused.values()) == member.runner.refusals.total == 6 * len(commands) + shapeless
    assert refused[OF_ANOTHER] == refused[AGAIN] == len(commands)
    assert refused[MISSHAPEN] == shapeless > 0
    assert member.said == of(messages, robot.index, Channel.STATE)


def test_an_observer_that_reads_nothing_blocks_the_role_and_loses_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(echelon.runtime.lockstep, "BATCH_BYTES", 300)
    plan, messages = story()
    robot = plan.robots[0]
    states = of(messages, robot.index, Channel.STATE)
    member = Member(plan, make_role(plan, robot.index))
    member.watch_gate.clear()
    member.thread.start()
    commands = of(messages, robot.parent, Channel.COMMAND)
    for command in commands[:MAX_AHEAD]:
        member.receive(command)  # returns at once
    assert member.at_gate.wait(TIMEOUT_S)
    per_batch = 1 + 300 // len(states[0])
    assert len(member.said) <= (MAX_BATCHES + 1) * per_batch < MAX_AHEAD
    assert member.batches == []
    member.watch_gate.set()
    member.feed(commands[MAX_AHEAD:])
    assert member.join() is None
    assert member.said == states
    assert member.watched() == states


def test_while_a_role_stands_still_all_its_copies_are_sent(monkeypatch: pytest.MonkeyPatch) -> None:
    """So a process that is killed then has nothing that others lack; nothing but time lets it send."""
    monkeypatch.setattr(echelon.runtime.lockstep, "STALL_S", 1e6)
    plan, messages = story()
    robot = plan.robots[0]
    states = of(messages, robot.index, Channel.STATE)
    commands = of(messages, robot.parent, Channel.COMMAND)
    member = Member(plan, make_role(plan, robot.index))
    member.thread.start()
    sent = 0
    for most in (1, 3, len(commands)):
        member.feed(commands[sent:most])
        sent = most
        assert until(lambda most=most: member.watched() == states[: most + 1], TIMEOUT_S)  # type: ignore[misc]
    assert member.join() is None
    assert member.said == states


def test_the_last_batch_is_sent_though_the_handler_ends_the_run() -> None:
    plan, messages = story()
    robot = plan.robots[0]
    for _ in range(20):
        member = Member(plan, make_role(plan, robot.index))
        member.runner.finish = lambda: None  # type: ignore[method-assign]  # lockstep alone has to do it
        member.thread.start()
        member.feed(of(messages, robot.parent, Channel.COMMAND))
        assert member.join() is None
        assert member.watched() == of(messages, robot.index, Channel.STATE)


def test_receiving_never_waits_for_a_put_of_the_main_thread() -> None:
    plan, messages = story()
    robot = plan.robots[0]
    member = Member(plan, make_role(plan, robot.index))
    member.data_gate.clear()
    member.thread.start()
    assert member.at_gate.wait(TIMEOUT_S)  # the main thread puts the first state, and moves the role

    commands = of(messages, robot.parent, Channel.COMMAND)

    def feed() -> None:
        for command in commands[:MAX_AHEAD]:
            member.receive(command)

    feeder = threading.Thread(target=feed, daemon=True)
    feeder.start()
    feeder.join(TIMEOUT_S)
    assert not feeder.is_alive()
    member.data_gate.set()
    member.feed(commands[MAX_AHEAD:])
    assert member.join() is None
    assert member.said == of(messages, robot.index, Channel.STATE)


def test_a_role_whose_links_lose_everything_still_waits_for_its_sources(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(echelon.runtime.lockstep, "STALL_S", 0.02)
    plan, messages = story(LOST)
    robot = plan.robots[0]
    member = Member(plan, make_role(plan, robot.index))
    member.thread.start()
    assert member.waiting.wait(TIMEOUT_S)
    assert MAX_AHEAD <= len(member.said) <= MAX_AHEAD + 2
    assert member.waits[0][1] == [robot.parent]
    member.feed(of(messages, robot.parent, Channel.COMMAND))
    assert member.join() is None
    assert member.said == of(messages, robot.index, Channel.STATE)


@pytest.mark.parametrize("at", [0, 30])
def test_an_exception_in_a_stage_reaches_the_caller(at: int) -> None:
    plan, messages = story()
    robot = plan.robots[0]
    role = make_role(plan, robot.index)

    def spoiled(time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        if time_ns == at * robot.period_ns:
            raise ArithmeticError("spoiled")
        return say.run(time_ns, heard)

    say, move = role.stages
    stub: Any = SimpleNamespace(index=role.index, stages=(replace(say, run=spoiled), move))
    member = Member(plan, stub)
    member.thread.start()
    member.feed(of(messages, robot.parent, Channel.COMMAND))
    assert isinstance(member.join(), ArithmeticError)
    assert member.watched() == member.said == of(messages, robot.index, Channel.STATE)[:at]


class Clock:
    """Takes the place of the module `time`.  Only sleeping and waiting move the clock."""

    def __init__(self) -> None:
        self.now_ns = 0

    def monotonic_ns(self) -> int:
        """Returns the time."""
        return self.now_ns


def on_the_clock(delay_of: Callable[[int], int | None]) -> tuple[Plan, list[tuple[int, int | None]], PacedRunner]:
    """Runs a robot's stages on a wall clock.  Command `number` comes `delay_of(number)` [ns] after its instant, or never if
    that is None.  Returns when the robot acts, and the number of the command that it then uses."""
    plan, messages = story()
    robot = plan.robots[0]
    start_ns = 1_000_000_000
    clock = Clock()
    payloads = [
        (start_ns + number * robot.period_ns + delay, payload)
        for number, payload in enumerate(of(messages, robot.parent, Channel.COMMAND))
        if (delay := delay_of(number)) is not None
    ]
    acts: list[tuple[int, int | None]] = []

    def move(time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        message = heard[0]
        acts.append((time_ns, None if message is None else message.sequence))
        return stages[1].run(time_ns, heard)

    role = make_role(plan, robot.index)
    stages: tuple[Stage, ...] = tuple(role.stages)
    stub: Any = SimpleNamespace(index=role.index, stages=(stages[0], replace(stages[1], run=move)))
    coming = deque(sorted(payloads, key=lambda each: each[0]))

    def rest(runner: PacedRunner, until_ns: int) -> None:
        """Lets time pass until a command comes, which the handler takes, or until `until_ns`."""
        if coming and coming[0][0] <= max(until_ns, clock.now_ns):
            came_ns, payload = coming.popleft()
            clock.now_ns = max(clock.now_ns, came_ns)
            member.receive(payload)
        else:
            clock.now_ns = max(clock.now_ns, until_ns)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(echelon.runtime.paced, "time", clock)
        patch.setattr(PacedRunner, "_rest", rest)
        member = Member(plan, stub, PacedRunner)
        member.runner.run(start_ns)
    assert member.watched() == member.said
    assert clock.now_ns >= start_ns + plan.duration_ns
    return plan, acts, member.runner


def test_on_a_clock_a_robot_acts_when_a_command_comes() -> None:
    plan, acts, runner = on_the_clock(lambda number: 10)
    last, period_ns = plan.duration_ns // plan.robots[0].period_ns, plan.robots[0].period_ns
    expected: list[tuple[int, int | None]] = []
    for n in range(last + 1):
        expected += [(n * period_ns, n - 1 if n else None), (n * period_ns + 10, n)]
    assert acts == expected[:-1]  # nothing acts after the end of the run
    assert (runner.counts.late, runner.counts.latest_ns) == (0, 0)
    assert runner.counts.stages == 2 * (last + 1)


def test_on_a_clock_the_newest_is_used_and_lateness_counted() -> None:
    plan = story()[0]
    last, period_ns = plan.duration_ns // plan.robots[0].period_ns, plan.robots[0].period_ns
    stopped = range(100, 120)  # the leader stands still, then sends all at once

    def delay_of(number: int) -> int | None:
        if number == 50:
            return None  # lost
        return (stopped.stop - number) * period_ns + 10 if number in stopped else 10

    _, acts, runner = on_the_clock(delay_of)
    newest: int | None = None
    expected = []
    for n in range(last + 1):
        expected.append((n * period_ns, newest))
        came = [] if n == 50 or n in stopped else [*stopped, n] if n == stopped.stop else [n]
        expected += [(n * period_ns + 10, number) for number in came]
        newest = came[-1] if came else newest
    assert acts == expected[:-1]
    assert runner.counts.late == 1 + len(stopped)
    assert runner.counts.latest_ns == 0  # stages ran at their deadline, not after it


def test_on_a_clock_a_command_that_comes_before_the_start_is_known_is_used() -> None:
    plan, messages = story()
    robot, start_ns, clock = plan.robots[0], 1_000_000_000, Clock()
    clock.now_ns = start_ns - 10
    role = make_role(plan, robot.index)
    used: list[int | None] = []

    def obey(time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
        used.append(None if heard[0] is None else heard[0].sequence)
        return ()

    stub: Any = SimpleNamespace(index=role.index, stages=(role.stages[0], replace(role.stages[1], run=obey)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(echelon.runtime.paced, "time", clock)
        patch.setattr(
            PacedRunner, "_rest", lambda runner, until_ns: setattr(clock, "now_ns", max(clock.now_ns, until_ns))
        )
        member = Member(plan, stub, PacedRunner)
        member.receive(next(iter(of(messages, robot.parent, Channel.COMMAND))))
        member.runner.run(start_ns)
    assert used[0] == 0


def test_keys_of_the_inputs_of_a_member() -> None:
    plan = story()[0]
    heard: list[str] = []
    session: Any = SimpleNamespace(
        subscribe=lambda key, receive: heard.append(key), publisher=lambda key: SimpleNamespace(put=lambda data: None)
    )
    LockstepRunner(make_role(plan, plan.nodes[1].index), plan, session, RUN, watched=False)
    g1 = [data_key(RUN, plan.formation[child].path, Channel.STATE) for child in plan.nodes[1].children]
    assert sorted(heard) == sorted([*g1, data_key(RUN, "", Channel.REFERENCE)])
