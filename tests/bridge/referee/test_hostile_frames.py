"""A hundred thousand hostile frames into the referee: none raises, memory is bounded, and nobody is blamed for those of others.

They are a third of that in each protocol."""

from itertools import islice

import numpy as np
import pytest

from echelon.bridge.can.canlog import EPOCH_NS
from echelon.bridge.can.log_files import read_lines
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.log import PlanLog
from echelon.bridge.referee.referee import KEPT, Referee
from support.closed_run import Heard, run
from support.hostile import mutated
from support.memory import memory_below

COUNT = 34_000
MEMORY = 1_000_000
"""What a referee may keep of hostile frames [bytes]"""
ODD = (0, 1, -1, 1 << 31, -(1 << 31), 1 << 62, -(1 << 63), 1 << 70)
"""Odd times [ns]"""
TIMES = (b"nan.nan", b"inf.0", b"-1.000000", b"1e9.0", b"999999999999.999999999", b"0.0", b"0000000000.000000")
"""Odd times of lines"""
OTHERS = (
    b"20000080#0000000000000000",  # error frames, 29-bit identifiers, CAN FD, remote frames, too long and odd data
    b"1FFFFFFF#00",
    b"100##1" + b"00" * 64,
    b"100#R",
    b"180#R8",
    b"100#" + b"11" * 9,
    b"100#123",
)


def content(luck: np.random.Generator, known: list[bytes], count: int) -> list[bytes]:
    """Returns data of frames: those of a run with some bits turned, and noise of up to 64 bytes."""
    found = [each for data in known[:500] for each in mutated(data, count // 500, luck)]
    noise = luck.bytes(64 * 64)
    found += [noise[at : at + length % 65] for at, length in luck.integers(4000, size=(count - len(found), 2)).tolist()]
    return found


@pytest.mark.parametrize("protocol", ["native", "odrive", "cia402"])
def test_frames_of_one_robot_and_of_nobody_are_blamed_on_no_other(protocol: str) -> None:
    """They come among the frames of an honest run, of which they spoil nothing."""
    plan, frames = run(protocol)
    referee, luck = Referee(plan), np.random.default_rng(1)
    of_others = set[int]().union(*(robot.observer.identifiers for robot in referee.robots[1:]))
    own = sorted(referee.robots[0].observer.identifiers - of_others)
    nobody = sorted(set(range(0x800)) - of_others - set(own) - {frame.can_id for _, _, frame in frames})
    known = [frame.data for _, _, frame in frames if frame.can_id in own and frame.data]
    data = content(luck, known, COUNT)
    can_ids = np.where(luck.random(COUNT) < 0.8, luck.choice(own, COUNT), luck.choice(nobody, COUNT)).tolist()
    order, remote = luck.permutation(COUNT).tolist(), (luck.random(COUNT) < 0.05).tolist()
    hostile = map(Frame, can_ids, [data[at] for at in order], remote)
    blamed = set[int]()
    for time_ns, bus, honest in frames:
        for frame in (*islice(hostile, 1 + COUNT // len(frames)), honest):
            blamed.update(finding.can_id for finding in referee.observe(time_ns, bus, frame))
    blamed.update(finding.can_id for finding in referee.finish(plan.duration_ns))
    assert referee.frames == COUNT + len(frames)
    assert referee.unknown > 0.1 * COUNT
    assert blamed
    assert blamed <= set(own)
    assert len(referee.kept) == KEPT
    assert {finding.robot for finding in referee.report().findings} == {plan.robots[0].name}


@pytest.mark.parametrize("protocol", ["native", "odrive", "cia402"])
def test_no_frame_and_no_time_raises_or_fills_memory(protocol: str) -> None:
    """Also where times go back, are far, or are before the run, and of a bus that there is not."""
    plan, frames = run(protocol)
    referee, luck = Referee(plan, late=True), np.random.default_rng(2)
    known: list[Heard] = [frames[at] for at in luck.integers(len(frames), size=COUNT)]
    data = content(luck, [frame.data for _, _, frame in known if frame.data], len(known))
    odd, damaged = luck.integers(4 * len(ODD), size=len(known)).tolist(), luck.integers(4, size=len(known)).tolist()
    with memory_below(MEMORY):
        for (time_ns, bus, frame), other, when, how in zip(known, data, odd, damaged, strict=True):
            time_ns = ODD[when] if when < len(ODD) else time_ns
            wrong = (
                frame,
                frame._replace(data=other),
                frame._replace(remote=True),
                Frame(1 << 29 | 0x100, other, True),
            )
            for finding in referee.observe(time_ns, bus, wrong[how]):
                assert finding.can_id < 0x800 or how == 3
            if how == 3:
                with pytest.raises(ValueError, match="bus must be"):
                    referee.observe(time_ns, bus + 1 if when % 2 else -1, frame)
        referee.finish(0)
        report = referee.report()
    assert report.frames == len(known)
    assert len(report.findings) == KEPT
    assert len(referee.kinds) < 40


def lines(frames: tuple[Heard, ...], luck: np.random.Generator) -> list[bytes]:
    """Returns lines of a log: whole ones at odd times, of odd frames and of unknown buses, and damaged ones."""
    found, some = list[bytes](), luck.integers(len(frames), size=COUNT // 20).tolist()
    for at in some:
        time_ns, _, frame = frames[at]
        time, data = b"%d.%09d" % divmod(EPOCH_NS + time_ns, 10**9), frame.data.hex().encode()
        whole = b"(%s) can0 %03X#%s" % (time, frame.can_id, data)
        found += [
            whole,
            b"(%s) can0 %03X#%s" % (TIMES[at % len(TIMES)], frame.can_id, data),
            b"(%s) can0 %s" % (time, OTHERS[at % len(OTHERS)]),
            b"(%s) bus%d %03X#%s" % (time, at, frame.can_id, data),
            *mutated(whole, 16, luck),
        ]
    return found


def test_no_line_of_a_log_raises_or_fills_memory() -> None:
    plan, frames = run("native")
    referee, log = Referee(plan), PlanLog([], plan)
    hostile = lines(frames, np.random.default_rng(3))
    assert len(hostile) == COUNT
    with memory_below(MEMORY):
        log = PlanLog(read_lines(hostile), plan)
        for entry in log.entries():
            if entry is None:
                referee.tear()
            else:
                referee.observe(*entry)
        referee.finish(plan.duration_ns)
    assert referee.frames + log.left_out.total() >= 0.95 * COUNT
    assert referee.frames > 0.1 * COUNT
    assert len(log.left_out) <= 21
    assert len(referee.kept) <= KEPT
