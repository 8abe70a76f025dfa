"""sim.recording.arrivals: the file of arrivals is read back, whatever has become of it."""

from pathlib import Path

import pytest

from echelon.messages import Channel
from echelon.plan.plan import Plan
from echelon.runtime.arrivals import RECORD
from echelon.sim.recording.arrivals import read_arrivals
from support.arrivals import write_arrivals
from support.runs import plan_of

MS = 1_000_000


@pytest.fixture(scope="module")
def plan() -> Plan:
    """lab, with a period of 10 ms; link 0 goes from g1 to g1/r1."""
    plan = plan_of("lab", "duration=1.0")
    assert (plan.links[0].receiver, plan.links[0].channel, plan.links[0].period_ns) == (0, Channel.COMMAND, 10 * MS)
    return plan


ROWS = [(0, 1, 12 * MS, 13 * MS), (0, 0, 2 * MS, 5 * MS), (3, 0, 0, 7 * MS), (0, 3, 30 * MS, 31 * MS)]


def test_arrivals_are_sorted_by_link_and_number(plan: Plan, tmp_path: Path) -> None:
    arrivals = read_arrivals(write_arrivals(tmp_path, ROWS, [(0, 1010 * MS)]), plan)
    one = arrivals.links[0]
    assert (one.numbers.tolist(), one.sent_ns.tolist()) == ([0, 1, 3], [2 * MS, 12 * MS, 30 * MS])
    assert one.arrived_ns.tolist() == one.counted_ns.tolist() == [5 * MS, 13 * MS, 31 * MS]
    assert one.latencies_ns.tolist() == [3 * MS, MS, MS]
    assert len(arrivals.links) == len(plan.links)
    assert len(arrivals.links[1].numbers) == 0
    assert (arrivals.ends_ns, arrivals.damaged) == ({0: 1010 * MS}, False)


def test_a_second_record_corrects_from_when_on_a_message_counts(plan: Plan, tmp_path: Path) -> None:
    one = read_arrivals(write_arrivals(tmp_path, [*ROWS, (0, 0, 2 * MS, 4 * MS)]), plan).links[0]
    assert one.arrived_ns.tolist() == [5 * MS, 13 * MS, 31 * MS]
    assert one.counted_ns.tolist() == [4 * MS, 13 * MS, 31 * MS]


def test_a_record_that_is_cut_off_is_left_out(plan: Plan, tmp_path: Path) -> None:
    path = write_arrivals(tmp_path, ROWS)
    path.write_bytes(path.read_bytes()[:-1])
    arrivals = read_arrivals(path, plan)
    assert arrivals.links[0].numbers.tolist() == [0, 1]
    assert not arrivals.damaged


@pytest.mark.parametrize(
    "bad",
    [
        (99, 0, 0, 1),  # no such link
        (0, 1, 2 * MS, 3 * MS),  # sent in the period of another number
        (0, 0, 2 * MS, 1 * MS),  # arrived before it was sent
        (0xFFFFFFFF, 99, 0, 0),  # the end of nobody
        (0, 4_000_000_000, -1, 2**62),
    ],
)
def test_what_stands_behind_damage_is_left_out(bad: tuple[int, int, int, int], plan: Plan, tmp_path: Path) -> None:
    arrivals = read_arrivals(write_arrivals(tmp_path, [*ROWS[:2], bad, *ROWS[2:]], [(0, 1)]), plan)
    assert arrivals.damaged
    assert arrivals.links[0].numbers.tolist() == [0, 1]
    assert len(arrivals.links[3].numbers) == 0
    assert arrivals.ends_ns == {}


def test_an_empty_file_has_no_arrivals(plan: Plan, tmp_path: Path) -> None:
    arrivals = read_arrivals(write_arrivals(tmp_path, []), plan)
    assert all(len(one.numbers) == 0 for one in arrivals.links.values())
    assert arrivals.known_until_ns(0) == -1
    assert arrivals.sent(0) == 0


def test_how_many_were_sent_and_until_when_arrivals_are_known(plan: Plan, tmp_path: Path) -> None:
    """g1 ends in order after 0.5 s; of g2 only what arrived somewhere is known."""
    g1, g2 = plan.nodes[0].index, plan.nodes[1].index
    assert [plan.links[number].source for number in (0, 1, 3, 4)] == [g1, g1, g2, g2]
    assert RECORD.size == 24
    arrivals = read_arrivals(write_arrivals(tmp_path, ROWS, [(g1, 500 * MS)]), plan)
    assert [arrivals.sent(number) for number in (0, 1, 3, 4, 6)] == [50, 50, 1, 1, 0]
    assert arrivals.known_until_ns(g1) == plan.duration_ns + 1
    assert arrivals.known_until_ns(0) == 31 * MS
    assert arrivals.trace(3).delays_ns == (7 * MS, *[-1] * 100)
