"""Warnings of `echelon validate`, compared with what runs do, or with numbers that are computed in another way."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest

from echelon.agents.plant import state_at
from echelon.agents.robot import make_robot
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.shipped import shipped
from echelon.sim.engines.in_process import Engine
from echelon.sim.forecast.motion import asked_of, motion_warnings, torque_loop_diverges, torque_loop_numbers
from echelon.sim.forecast.warnings import warnings
from echelon.sim.results.summary import summarise
from echelon.sim.sweep.preparing import unstable
from support.runs import plan_of, trace_of
from support.synthetic import run_facts

FREE = ("robot.torque_limit=inf", "robot.torque_rate_limit=inf", "robot.wheel_speed_limit=inf")


def only(plan: Plan) -> str:
    """Returns the only warning about a plan."""
    (found,) = warnings(plan)
    return found


@pytest.mark.parametrize("name", shipped())
def test_shipped_scenarios_are_without_warnings(name: str) -> None:
    assert warnings(plan_of(name)) == ()


def test_a_heading_that_looks_like_degrees() -> None:
    said = only(plan_of("lab", "robot.heading=90"))
    assert said.startswith("heading = 90 (g1/r1 and 8 more): is in radians")
    assert said.endswith("if degrees were meant, write 1.5708")
    assert warnings(plan_of("lab", "robot.heading=-6.28")) == ()


def test_a_claim_beyond_the_end() -> None:
    ends = "the run ends before, at 19 s; a claim that is not tested fails"
    assert only(plan_of("lab", "duration=19.0")) == f"claims.2.settled_by = 20: {ends}"
    assert warnings(plan_of("lab", "duration=20.0")) == ()


def test_a_dwell_time_beyond_the_end() -> None:
    said = only(plan_of("lab", "claims=[{block='g1', settled_by=5.0, dwell=200.0}]"))
    assert said == "claims.0: cannot be tested, its dwell time is 50 s and the run ends at 40 s"


def test_a_run_that_is_too_short_for_health_checks() -> None:
    said = only(plan_of("lab", "duration=17.9", "claims=[]"))
    assert said == "duration = 17.9: too short to tell growth of centroid; 18 s is enough"
    checks = summarise(trace_of(plan_of("lab", "duration=17.9", "claims=[]")), [], None, run_facts()).verdict.checks
    growth = [check for check in checks if check.name == "growth" and check.outcome == "not tested"]
    assert [check.about for check in growth] == [("centroid",)]  # the run has the same result
    assert warnings(plan_of("lab", "duration=18.0", "claims=[]")) == ()


@pytest.mark.parametrize(
    ("rule", "says"),
    [
        ('{channel="state", delay=0.004}', "state (9 links): a delay of 0.004 s acts as 0.01 s: messages are used at"),
        ('{source="g1/r1", delay=0.0501}', "state (1 link): a delay of 0.0501 s acts as 0.06 s"),
        ('{channel="reference", delay={min=0.0, max=0.01}}', "reference (3 links): delays from 0 to 0.01 s all act as 0.01 s"),
        ('{channel="command", delay={min=0.01, max=0.035}}',
         "command (9 links): delays from 0.01 to 0.035 s act as 0.02 to 0.04 s"),
        ('{channel="command", delay=41.0}', "command (9 links): a delay of 41 s in a run of 40 s: nothing arrives"),
        ('{channel="group_state", loss=1.0}', "group_state (3 links): loss = 1: nothing arrives"),
        ('{channel="state", delay=0.2, policy="hold_then_stop", timeout=0.1}',
         "state (9 links): what arrives is 0.2 s old, more than the timeout of 0.1 s: nothing is used"),
    ],
)  # fmt: skip
def test_links_that_do_something_else_than_they_seem_to(rule: str, says: str) -> None:
    assert only(plan_of("lab", "timing='time_driven'", f"links=[{rule}]")).startswith(f"links: {says}")


def test_what_a_rounded_delay_is_said_to_act_as_is_what_the_run_does() -> None:
    short = ("duration=1.0", "claims=[]", "timing='time_driven'")
    rounded, whole = (
        trace_of(plan_of("lab", *short, f'links=[{{channel="state", delay={delay}}}]')) for delay in (0.004, 0.01)
    )
    assert rounded.digest() == whole.digest()
    assert not [line for line in warnings(whole.plan) if "acts as" in line]


def test_on_the_closed_path_commands_are_used_at_torque_periods() -> None:
    plan = plan_of("drives", "periods.torque=0.005", 'links=[{channel="command", delay=0.005}]')
    assert not any(line.startswith("links") for line in warnings(plan))
    assert any("acts as 0.01 s" in line for line in warnings(replace_delay(plan, 6_000_000)))


def test_event_driven_nodes_and_robots_take_delays_as_they_are() -> None:
    rule = 'links=[{channel="state", delay=0.004}, {channel="command", delay={min=0.001, max=0.002}}]'
    assert not any(line.startswith("links") for line in warnings(plan_of("lab", rule)))


def replace_delay(plan: Plan, delay_ns: int) -> Plan:
    """Returns a plan in which all links with a delay have another one."""
    links = (
        replace(link, delay_min_ns=delay_ns, delay_max_ns=delay_ns) if link.delay_max_ns else link
        for link in plan.links
    )
    return replace(plan, links=tuple(links))


def test_a_time_scale_near_the_period() -> None:
    said = only(plan_of("lab", "law.epsilon=[1.0, 0.04]", "law.gains=[]", "periods.torque=0.001", *FREE))
    assert said == (
        "law.epsilon: σ of g1 (the shortest of 3) is 0.04 s, 4 × the period of 0.01 s; it should be 5 × that at least"
    )
    assert warnings(plan_of("lab", "law.epsilon=[1.0, 0.05]", "law.gains=[]", "periods.torque=0.001", *FREE)) == ()


def test_a_loop_that_does_not_settle_with_its_links() -> None:
    late = 'links=[{channel="state", delay=%s}]'
    assert warnings(plan_of("lab", late % 0.35)) == ()
    assert "does not settle" in only(plan_of("lab", late % 0.36))


def test_more_torque_than_a_robot_has() -> None:
    """The torques at the start that the warnings are about are those of the run's first period."""
    free = plan_of("lab", "duration=0.01", "claims=[]", *FREE)
    peaks = start_torques(free)
    limit = float(np.sort(peaks)[-3]) * (1 + 1e-9)
    said = only(plan_of("lab", f"robot.torque_limit={limit}"))
    assert said == (
        f"torque_limit = {limit:g}: the start asks {peaks.max():.3g} N m of a wheel of "
        f"{free.robots[int(peaks.argmax())].name} (the worst of 2 robots)"
    )


def start_torques(plan: Plan) -> np.ndarray:
    """Returns the larger torque of each robot's wheels in the first torque period of a run."""
    said: list[Message] = []
    plan = replace(plan, duration_ns=plan.root.period_ns)
    Engine(plan, said.append).run()
    states = {m.source: m.values for m in said if m.channel is Channel.STATE and m.sequence == 1}
    return np.array([np.abs(states[robot.index][-3:-1]).max() for robot in plan.robots])


def test_more_speed_than_a_wheel_has() -> None:
    said = only(plan_of("lab", "robot.wheel_speed_limit=5.9"))
    assert said.startswith("wheel_speed_limit = 5.9: start and trajectory ask ")
    slow = 'trajectory={kind="line", velocity=[3.0, 0.0]}'
    assert any(
        "ask 60" in line or "(3" in line for line in warnings(plan_of("lab", slow, "robot.wheel_speed_limit=1.0"))
    )


@pytest.mark.parametrize(("q", "dies"), [(0.5, True), (1.9, True), (2.1, False)])
def test_the_torque_loop_dies_away_up_to_its_edge(q: float, dies: bool) -> None:
    """Simulates torque loop and plant of a slightly turned robot that moves at v, with zero acceleration, for 60 periods."""
    plan = plan_of("lab", *FREE)
    robot = make_robot(plan, 0)
    say, obey = robot.stages
    h, d = plan.robots[0].torque_period_ns * 1e-9, plan.robots[0].offset
    robot.state = state_at(0.0, 0.0, 0.0, q * d / h, 1e-9)
    for tick in range(60):
        time_ns = tick * plan.robots[0].period_ns
        obey.run(time_ns, [Message(Channel.COMMAND, plan.robots[0].parent, tick, time_ns, np.zeros(6))])
        say.run(time_ns + plan.robots[0].period_ns, [])
    assert (abs(robot.state.omega) < 1e-9) == dies
    expected = 1e-9 * (1 - q + q**2 / 2) ** 60
    assert abs(robot.state.omega) == pytest.approx(expected, rel=0.05)


@pytest.mark.parametrize(("torque", "lost"), [(0.001, True), (0.0001, False)])
def test_the_paper_loses_a_robot_where_its_torque_loop_is_said_to_diverge(torque: float, lost: bool) -> None:
    plan = plan_of("paper", f"periods.torque={torque}", "duration=0.03", "claims=[]")
    asked = asked_of(plan)
    assert torque_loop_diverges(plan, asked) == lost
    assert max(torque_loop_numbers(plan, asked)) == pytest.approx(torque * 857 / 0.2, rel=0.01)
    finite = all(np.isfinite(states).all() for states in trace_of(plan).states)
    assert finite != lost
    if lost:
        assert "torque loop of g3/r9 (the worst of 6 robots) diverges" in warnings(plan)[-1]


def test_a_motion_that_diverges_is_said_with_the_instant_and_without_numbers_that_mean_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    plan = plan_of("lab", "law.epsilon=[0.02, 0.02]", "robot.wheel_speed_limit=1.0")
    said = [line.partition(":")[2].strip() for line in motion_warnings(plan)]
    assert said == [
        "the start asks 1.8e+03 N m of a wheel of g3/r9 (the worst of 9 robots)",
        "the motion that is computed for ideal links diverges within 0.04 s; what it asks of wheels is not said",
        "the trajectory asks 6 rad/s (0.3 m/s) of g1/r1 (the worst of 9 robots)",
    ]
    asked = asked_of(plan)
    assert asked.diverges_s == pytest.approx(0.04)
    assert asked.speeds.tolist() == pytest.approx([0.3] * 9)
    assert unstable(plan) == "its motion diverges within 0.04 s (echelon validate)"
    assert asked_of(plan_of("lab")).diverges_s is None
    monkeypatch.setattr("echelon.sim.forecast.motion._start_torque", lambda robot, ax, ay: inf)
    assert "the start asks more torque than there can be of a wheel of " in motion_warnings(plan)[0]
