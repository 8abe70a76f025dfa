"""On a wall clock a role does, in run time, what it does in virtual time when messages take as long: also in a slow process."""

import random
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import gcd
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import echelon.runtime.paced
from echelon.messages import Heard, Message
from echelon.plan.plan import Plan
from echelon.runtime.arrivals import END, FILE, RECORD, ArrivalFile
from echelon.runtime.mailbox import Mailbox
from echelon.runtime.paced import PacedRunner
from echelon.runtime.wire import data_key, encode
from echelon.sim.engines.in_process import make_role
from echelon.sim.recording.arrivals import read_arrivals
from support.recordings import messages_of
from support.runs import plan_of

START_NS = 1_000_000_000
PERIOD_NS = 10_000_000
TIMES_OUT = (
    'links=[{channel="state",policy="hold_then_stop",timeout=0.02},{channel="command",policy="zero",timeout=0.015}]'
)
DELAYED = (
    'links=[{channel="state",delay={min=0.0,max=0.02},loss=0.2},{channel="reference",delay=0.004,order="fifo"},'
    '{channel="command",delay={min=0.001,max=0.03}}]'
)

Act = tuple[int, tuple[tuple[int, int] | None, ...]]
"""The instant of an act; of each input the number of the message in use and its first value's hash, None without a message"""


class SlowClock:
    """Takes the place of the module `time`: each look at it takes time, now and then as long as a busy machine may take."""

    def __init__(self, luck: random.Random, stall_ns: int) -> None:
        self.now_ns, self._luck, self._stall_ns = START_NS - 5 * PERIOD_NS, luck, stall_ns

    def monotonic_ns(self) -> int:
        """Returns the time."""
        self.now_ns += self._luck.randint(1, 30_000)
        if self._luck.random() < 0.01:
            self.now_ns += self._luck.randint(0, self._stall_ns)
        return self.now_ns


def told(heard: Sequence[Heard]) -> tuple[tuple[int, int] | None, ...]:
    """Returns what a stage heard, in short."""
    return tuple(None if one is None else (one.sequence, hash(one.values.tobytes())) for one in heard)


def noting(role: Any, acts: list[Act]) -> Any:
    """Returns a role that notes its acts."""

    def noted(run: Callable[[int, Sequence[Heard]], tuple[Message, ...]]) -> Any:
        def work(time_ns: int, heard: Sequence[Heard]) -> tuple[Message, ...]:
            acts.append((time_ns, told(heard)))
            return run(time_ns, heard)

        return work

    return SimpleNamespace(
        index=role.index, stages=tuple(replace(stage, run=noted(stage.run)) for stage in role.stages)
    )


def coming_to(plan: Plan, index: int, luck: random.Random) -> list[tuple[int, Message]]:
    """Returns the messages that come to a member, each with the instant at which it is there: some soon, some late, some never,
    those of one source in their order."""
    sources = {(link.source, link.channel) for link in plan.links_into(index)}
    found, last_ns = [], dict.fromkeys(sources, 0)
    for message in messages_of(plan):
        key = message.source, message.channel
        if key in sources and luck.random() > 0.05:
            late_ns = luck.choice([0, 200_000, 1_000_000, 8_000_000, PERIOD_NS, 3 * PERIOD_NS])
            last_ns[key] = max(last_ns[key], message.time_ns + luck.randint(0, late_ns))
            found.append((START_NS + last_ns[key], message))
    return sorted(found, key=lambda each: each[0])


def run_slowly(
    plan: Plan, index: int, arrivals: ArrivalFile, luck: random.Random, stall_ns: int
) -> tuple[list[Act], PacedRunner]:
    """Runs a role in a slow process, and notes its arrivals; returns its acts and its runner."""
    clock, coming = SlowClock(luck, stall_ns), coming_to(plan, index, luck)
    acts: list[Act] = []
    beats: list[int] = []
    takes: dict[str, Callable[[bytes], None]] = {}
    paths = [one.path for one in plan.all_roles]
    session: Any = SimpleNamespace(
        subscribe=takes.__setitem__,
        publisher=lambda key: SimpleNamespace(put=lambda payload: None),
    )

    def rest(runner: PacedRunner, until_ns: int) -> None:
        """Lets time pass: until a message comes, or until `until_ns`, or longer."""
        if coming and coming[0][0] <= max(until_ns, clock.now_ns):
            clock.now_ns = max(clock.now_ns, coming[0][0])
            for _ in range(luck.choice([1, 1, 1, 5])):
                if coming and coming[0][0] <= clock.now_ns:
                    message = coming.pop(0)[1]
                    takes[data_key("test", paths[message.source], message.channel)](encode(message))
        else:
            clock.now_ns = max(clock.now_ns, until_ns)

    def beat(now_ns: int, due_ns: int) -> None:
        beats.append(due_ns)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(echelon.runtime.paced, "time", clock)
        patch.setattr(PacedRunner, "_rest", rest)
        role = noting(make_role(plan, index), acts)
        runner = PacedRunner(role, plan, session, "test", watched=False, arrivals=arrivals, beat=beat)
        runner.run(START_NS)
        runner.finish()
        count = len(beats)
        for _, message in coming:
            takes[data_key("test", paths[message.source], message.channel)](encode(message))
        assert len(beats) == count > 0  # who is done cannot be late
    return acts, runner


def in_virtual_time(plan: Plan, index: int, folder: Path) -> list[Act]:
    """Returns the acts of a role in virtual time, with the delays that were noted in the folder."""
    arrivals = read_arrivals(folder / FILE, plan)
    links = [
        replace(link, delays=arrivals.trace(number), delay_max_ns=1, loss=0.0, fifo=False, punctual=False)
        if number in arrivals.links
        else link
        for number, link in enumerate(plan.links)
    ]
    traced = replace(plan, links=tuple(links))
    acts: list[Act] = []
    role = noting(make_role(plan, index), acts)
    mailbox = Mailbox(role, traced)
    for message in messages_of(plan):
        if any((link.source, link.channel) == (message.source, message.channel) for link in plan.links_into(index)):
            mailbox.deliver(message)
    for time_ns in range(0, plan.duration_ns + 1, gcd(*[stage.period_ns for stage in role.stages])):
        for number, stage in enumerate(role.stages):
            assert not mailbox.missing(number, time_ns)
            for at_ns, heard in mailbox.acts(number, time_ns):
                stage.run(at_ns, heard)
    return acts


@pytest.mark.slow
@pytest.mark.parametrize("member", ["g1/r1", "g1", "coordinator"])
@pytest.mark.parametrize("timing", ["event_driven", "time_driven"])
@pytest.mark.parametrize("links", ["links=[]", TIMES_OUT, DELAYED], ids=["ideal", "times out", "delayed"])
@pytest.mark.parametrize("stall_ns", [0, 2 * PERIOD_NS, 8 * PERIOD_NS], ids=["quick", "late", "stalling"])
def test_a_slow_process_acts_as_in_virtual_time(
    member: str, timing: str, links: str, stall_ns: int, tmp_path: Path
) -> None:
    plan = plan_of("lab", "duration=0.5", "claims=[]", f'timing="{timing}"', links)
    index = next(one.index for one in plan.formation if one.name == member)
    luck = random.Random(f"{member}{timing}{links}{stall_ns}")
    acts, runner = run_slowly(plan, index, ArrivalFile(tmp_path), luck, stall_ns)
    assert len(acts) >= 2 * 51
    assert acts == in_virtual_time(plan, index, tmp_path)
    if stall_ns > 4 * PERIOD_NS:
        assert runner.counts.latest_ns > 0  # the process was late, indeed


def test_arrivals_are_noted_while_the_run_goes_on_and_its_end_is(tmp_path: Path) -> None:
    plan = plan_of("lab", "duration=0.5", "claims=[]")
    index = plan.root.index
    sizes: list[int] = []

    class Watched(ArrivalFile):
        """Notes the sizes of the writes."""

        def write(self, records: bytes) -> None:
            sizes.append(len(records))
            super().write(records)

    run_slowly(plan, index, Watched(tmp_path), random.Random(1), 0)
    records = list(RECORD.iter_unpack((tmp_path / FILE).read_bytes()))
    assert sum(sizes) == len(records) * RECORD.size
    assert len(sizes) >= 5  # ten times a second
    assert records[-1][:2] == (END, index)
    assert all(plan.links[link].receiver == index for link, *_ in records[:-1])
