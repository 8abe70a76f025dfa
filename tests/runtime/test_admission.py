"""What a receiver takes and refuses: each check alone, at its bound, and all of what an honest run sends."""

from collections.abc import Callable

import numpy as np
import pytest

from echelon.messages import NULL, Channel, Message, Values
from echelon.runtime.admission import (
    AGAIN,
    EMPTY,
    FUTURE,
    LARGEST,
    MISSHAPEN,
    OF_ANOTHER,
    TIME,
    VALUES,
    Admission,
    Refusals,
    within,
)
from echelon.runtime.admission_rules import admissions_into, admissions_of, lockstep_lead_ns, torque_bounds
from echelon.runtime.mailbox import MAX_AHEAD
from echelon.runtime.wire import encode
from echelon.shipped import shipped
from echelon.sim.engines.in_process import Engine
from support.runs import plan_of

PERIOD = 10
LATE = 'links=[{channel="state",delay={min=0.0,max=0.03},loss=0.1},{channel="reference",delay=0.004}]'


def admission(channel: Channel = Channel.COMMAND, **given: int) -> tuple[Admission, Refusals]:
    """Returns an admission of messages with two values, every `PERIOD` from 100 on."""
    refusals = Refusals()
    times = {"first_ns": 100, "period_ns": PERIOD} | given
    return Admission(refusals, "g1", 3, channel, 2, **times), refusals  # type: ignore[arg-type]


def command(number: int, late_ns: int = 0, values: Values | None = None) -> bytes:
    """Returns a message that the admission takes, if `late_ns` is 0."""
    at_ns = 100 + number * PERIOD + late_ns
    return encode(Message(Channel.COMMAND, 3, number, at_ns, np.array([1.0, 2.0]) if values is None else values))


def test_what_is_taken_is_what_was_sent() -> None:
    door, refusals = admission(ahead_ns=1000)
    values = np.array([0.1, -LARGEST / 2])
    message = door.admit(command(7, values=values), 0)
    assert message is not None
    assert message[:4] == (Channel.COMMAND, 3, 7, 170)
    assert message.values.tobytes() == values.tobytes()
    assert not message.values.flags.writeable
    null = door.admit(command(8, values=NULL), 0)
    assert null is not None
    assert null.is_null
    assert (door.newest, door.time_ns, refusals.total) == (8, 180, 0)


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "too short"),
        (command(1)[:31], "too short"),
        (command(1)[:-1], "length does not match"),
        (command(1) + b"\0", "length does not match"),
        (command(1)[:28] + b"\1\0\0\0" + command(1)[32:], "reserved bytes are not zero"),
        (b"\7" + command(1)[1:], "another schema version"),
        (encode(Message(Channel.COMMAND, 4, 1, 110, np.zeros(2))), OF_ANOTHER),
        (encode(Message(Channel.STATE, 3, 1, 110, np.zeros(2))), OF_ANOTHER),
        (command(1, values=np.zeros(1)), MISSHAPEN),
        (command(1, values=np.zeros(3)), MISSHAPEN),
        (command(0), AGAIN),
        (command(1, -1), TIME),
        (command(1, 1), TIME),
        (encode(Message(Channel.COMMAND, 3, 2**64 - 1, -(2**63), np.zeros(2))), TIME),
        (command(6), FUTURE),
        (command(2**58), FUTURE),
    ],
)
def test_what_is_dropped_is_counted_and_changes_nothing(payload: bytes, reason: str) -> None:
    door, refusals = admission(ahead_ns=5 * PERIOD - 1)
    assert door.admit(command(0), 100) is not None
    assert door.admit(payload, 110) is None
    assert refusals.by_source() == {"g1": {reason: 1}}
    assert (door.newest, door.time_ns) == (0, 100)
    assert door.admit(command(5), 111) is not None  # what is due is taken as before


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1.1 * LARGEST, 1e308])
@pytest.mark.parametrize("size", [2, 40])
def test_of_impossible_values_a_null_message_is_left(value: float, size: int) -> None:
    refusals = Refusals()
    door = Admission(refusals, "g1", 3, Channel.COMMAND, size, first_ns=100, period_ns=PERIOD)
    values = np.zeros(size)
    values[-1] = value
    message = door.admit(command(0, values=values), 100)
    assert message is not None
    assert message.is_null
    assert refusals.by_source() == {"g1": {VALUES: 1}}
    assert door.admit(command(0, values=np.zeros(size)), 100) is None  # its number is taken


def test_a_robot_always_has_a_state() -> None:
    door, refusals = admission(Channel.STATE)
    message = door.admit(encode(Message(Channel.STATE, 3, 0, 100, NULL)), 100)
    assert message is not None
    assert message.is_null
    assert refusals.by_source() == {"g1": {EMPTY: 1}}


@pytest.mark.parametrize(
    ("values", "fits"),
    [
        ((1.5, -1.5, 1, 1, 9.0, -9.0), True),
        ((0, 0, 0, 0, 9.0, 9.0), True),
        ((1.51, 0, 1, 0, 0, 0), False),
        ((0, -1.51, 1, 0, 0, 0), False),
        ((1.0, 0, 0, 0, 0, 0), False),  # not commanded
        ((0, 0, 0.5, 0, 0, 0), False),
        ((0, 0, 1, 2, 0, 0), False),
        ((0, 0, 1, 0, 1e16, 0), False),
        ((0, 0, 1, 0, 0, np.nan), False),
        ((np.nan, 0, 1, 0, 0, 0), False),
    ],
)
def test_bounds_of_torques(values: tuple[float, ...], fits: bool) -> None:
    assert torque_bounds(1.5)(np.array(values, float), 0) is fits


@pytest.mark.parametrize("size", [1, 16, 17, 200])
def test_bounds_are_of_the_root_of_the_sum_of_squares(size: int) -> None:
    each = LARGEST / np.sqrt(size)
    assert within(np.full(size, each * (1 - 1e-9)))
    assert not within(np.full(size, each * (1 + 1e-9)))


@pytest.mark.slow
@pytest.mark.parametrize("overrides", [(), (LATE,), ("can.path=closed",)], ids=["ideal", "late", "closed"])
@pytest.mark.parametrize("scenario", sorted(shipped()))
def test_what_roles_send_is_taken_by_all_who_hear_it(scenario: str, overrides: tuple[str, ...]) -> None:
    plan = plan_of(scenario, "duration=0.1", *overrides)
    refusals = Refusals()
    always: Callable[[Values, int], bool] = lambda values, time_ns: True  # noqa: E731
    doors = [
        each
        for virtual in (True, False)
        for role in plan.all_roles
        for each in admissions_into(plan, role.index, refusals, virtual=virtual, frames=always)
    ]
    doors += admissions_of(plan, range(len(plan.all_roles)), refusals, virtual=True, frames=always)
    now_ns = taken = 0

    def hear(message: Message) -> None:
        nonlocal now_ns, taken
        now_ns = max(now_ns, message.time_ns)
        for door in doors:
            if (door.source, door.channel) == (message.source, message.channel):
                taken += door.admit(encode(message), now_ns) is not None

    engine = Engine(plan, hear)
    engine.run()
    assert refusals.by_source() == {}
    assert taken >= 2 * engine.messages


def test_a_lockstep_allows_more_lead_where_members_hear_each_other_through_others() -> None:
    plan = plan_of("three_levels")
    robot, leader = plan.robots[0], plan.formation[plan.robots[0].parent]
    lead_ns = lockstep_lead_ns(plan, robot.index)
    step_ns = (MAX_AHEAD + 2) * max(link.period_ns for link in plan.links)
    assert lead_ns[leader.index] == step_ns
    assert lead_ns[plan.root.index] == leader.depth * step_ns + step_ns  # type: ignore[union-attr]
    assert lead_ns[plan.robots[-1].index] > lead_ns[plan.root.index]
