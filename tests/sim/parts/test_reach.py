"""A robot beyond its reach has diverged; large errors at the start, slow robots and robots that are not driven have not."""

from collections.abc import Callable
from math import inf

import numpy as np
import pytest

from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.plan.plan import Plan
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.reach import FACTOR, Reach, ReachWatch
from support.runs import plan_of

S = 1_000_000_000
DIVERGING = "law.epsilon=[0.02,0.02]"
"""Time scales much shorter than the period: the errors grow, as fast as the limits of torque and speed allow"""


def states_of(plan: Plan) -> list[Message]:
    """Returns the states of a run."""
    said: list[Message] = []
    Engine(plan, said.append).run()
    return [message for message in said if message.channel is Channel.STATE]


@pytest.mark.parametrize(
    "changes",
    [
        ("formation.groups.g1.robots.r1.start=[60, 0]",),
        ('trajectory={kind="line", velocity=[1.9, 0.0]}',),  # the wheels allow 2 m/s
        ('trajectory={kind="circle", radius=3.0, rate=1.0}',),  # as fast as nobody can be
        ("robot.torque_limit=0.05", "robot.wheel_speed_limit=15.0"),
    ],
    ids=["far away", "to catch up with", "too fast", "weak"],
)
def test_an_honest_run_is_within_its_reach(changes: tuple[str, ...]) -> None:
    plan = plan_of("lab", "claims=[]", "duration=8", *changes)
    states = states_of(plan)
    assert ReachWatch(plan).first(states) is None
    reach = Reach(plan)
    most = max(np.hypot(m.values[0] - reach.x, m.values[1] - reach.y) / reach.at(m.time_ns) for m in states)
    assert 0.1 < most < 0.5  # also with half the reach


def test_a_diverged_run_is_found_at_the_same_instant_however_its_states_come() -> None:
    plan = plan_of("lab", "claims=[]", "duration=10", DIVERGING)
    states = states_of(plan)
    found = ReachWatch(plan).first(states)
    assert found is not None
    robot, time_ns, far = found
    assert 4 * S < time_ns < 9 * S
    assert far > Reach(plan).at(time_ns)
    (values,) = (m.values for m in states if (m.source, m.time_ns) == (robot, time_ns))
    assert far == np.hypot(values[0] - Reach(plan).x, values[1] - Reach(plan).y)
    watch = ReachWatch(plan)
    assert next(at for state in states if (at := watch.first([state])) is not None) == found


def state(robot: int, time_ns: int, x: float, torque: float = 0.0) -> Message:
    """Returns a state with one torque."""
    values = np.zeros(len(STATE_FIELDS))
    values[0], values[STATE_FIELDS.index("tau_left")] = x, torque
    return Message(Channel.STATE, robot, time_ns // 10_000_000, time_ns, values)


def found_if(plan: Plan, far: int, idle: int, at_work: Callable[[int], bool], *, silent: bool) -> bool:
    """Returns whether something is found in 10 s in which robot `far` goes out to three times the reach, and all others stay.

    Robot `idle` has no torque while it is not `at_work`, or says nothing then if it is `silent`."""
    out_m = 3 * Reach(plan).at(10 * S)
    states = [
        state(robot, time_ns, out_m * min(1.0, time_ns / (5 * S)) if robot == far else 0.0, 1.0 if works else 0.0)
        for time_ns in range(0, 10 * S, S // 10)
        for robot in range(len(plan.robots))
        if (works := robot != idle or at_work(time_ns)) or not silent
    ]
    return ReachWatch(plan).first(states) is not None


@pytest.mark.parametrize("silent", [False, True])
@pytest.mark.parametrize("far", [0, 1])
def test_how_far_robots_get_while_one_is_not_driven_is_no_fault_of_the_law(far: int, silent: bool) -> None:
    plan = plan_of("lab", "claims=[]", "duration=10")
    assert found_if(plan, far, 0, lambda time_ns: True, silent=silent)
    assert not found_if(plan, far, 0, lambda time_ns: time_ns > 6 * S, silent=silent)


def test_a_trajectory_that_cannot_be_asked_gives_no_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echelon.sim.parts.reach.PATIENCE_S", 0.05)

    class Hangs:
        def at(self, t: float) -> None:
            while True:
                pass

    monkeypatch.setattr("echelon.sim.parts.reach.make_trajectory", lambda part: Hangs())
    assert Reach(plan_of("lab")).at(S) == inf


def test_the_reach_grows_with_the_way_of_the_trajectory_up_to_then() -> None:
    plan = plan_of("lab", "claims=[]", 'trajectory={kind="line", velocity=[0.5, 0.0]}', "duration=100")
    reach = Reach(plan)
    assert reach.at(90 * S) - reach.at(10 * S) == pytest.approx(FACTOR * 40)
    assert reach.at(1000 * S) == reach.at(100 * S)
