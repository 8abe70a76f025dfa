"""Policies for late states: against motion under known accelerations, and against the loop without delay."""

from dataclasses import replace

import numpy as np
import pytest

from echelon.controller.late_states import LateStates
from echelon.controller.prediction.analysis import analyse
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.trajectory import make_trajectory
from echelon.messages import STATE_FIELDS, Channel, Message
from echelon.plan.plan import Plan
from echelon.plan.punctuality import with_punctuality
from support.growth import single
from support.points import at_rest, point_run, time_driven
from support.runs import plan_of

MS = 1_000_000


def late(plan: Plan, delay_ns: int, policy: str, channel: Channel = Channel.STATE) -> Plan:
    """Returns a plan whose messages of a channel are late, and brought to the present by a policy."""
    links = [
        replace(link, delay_min_ns=delay_ns, delay_max_ns=delay_ns, policy=policy) if link.channel is channel else link
        for link in plan.links
    ]
    return replace(plan, links=tuple(with_punctuality(links, plan.nodes)))


def moved(p: np.ndarray, v: np.ndarray, pieces: list[tuple[float, np.ndarray]]) -> np.ndarray:
    """Returns (x, y, vx, vy) after accelerations that hold for some time each."""
    for h, a in pieces:
        p, v = p + h * v + h**2 / 2 * a, v + h * a
    return np.concatenate((p, v))


def state(time_ns: int, p: np.ndarray, v: np.ndarray, a: np.ndarray) -> Message:
    """Returns the STATE of robot 0."""
    values = np.zeros(len(STATE_FIELDS))
    values[:4] = *p, *v
    values[STATE_FIELDS.index("ax") : STATE_FIELDS.index("ax") + 2] = a
    return Message(Channel.STATE, 0, time_ns // (100 * MS), time_ns, values)


P, V, A, B = np.array([1.0, 2.0]), np.array([0.3, -0.1]), np.array([0.5, 0.2]), np.array([-0.4, 0.7])


def test_extrapolation_is_motion_under_the_last_acceleration():
    plan = late(single(0.1), 50 * MS, "extrapolate")
    states = LateStates(plan, plan.root, make_trajectory(plan.trajectory))
    (found,) = states.present(350 * MS, [state(300 * MS, P, V, A)])
    np.testing.assert_allclose(found[:4], moved(P, V, [(0.05, A)]), atol=1e-15)


def test_prediction_replays_what_was_commanded_since():
    """The commands take 20 ms; what was commanded before the state's time acts until the next one arrives."""
    plan = late(late(single(0.1), 250 * MS, "predict"), 20 * MS, "hold", Channel.COMMAND)
    states = LateStates(plan, plan.root, make_trajectory(plan.trajectory))
    states.note(100 * MS, A)
    states.note(230 * MS, B)
    states.note(400 * MS, None)
    (found,) = states.present(450 * MS, [state(200 * MS, P, V, A)])
    np.testing.assert_allclose(found[:4], moved(P, V, [(0.05, A), (0.17, B), (0.03, 0 * A)]), atol=1e-15)


def test_what_is_not_late_is_taken_as_it_is():
    for policy in ("extrapolate", "predict"):
        plan = late(single(0.1), 0, policy)
        states = LateStates(plan, plan.root, make_trajectory(plan.trajectory))
        message = state(300 * MS, P, V, A)
        assert states.present(300 * MS, [message])[0] is message.values


@pytest.mark.parametrize("ticks", [1, 5, 17])
def test_with_prediction_late_points_move_as_points_without_delay(ticks, monkeypatch):
    """Once the first state has come, the loop is that without delay: the run from that state on is the same."""
    T = 0.2
    plan = time_driven(at_rest(single(T, k1=4.0, k2=2.0)))
    plan = replace(plan, robots=(replace(plan.robots[0], start=(1.0, -2.0)),))
    prompt = point_run(plan, 60, monkeypatch)
    found = point_run(late(plan, ticks * plan.root.period_ns, "predict"), 60 + ticks, monkeypatch)
    np.testing.assert_allclose(found[ticks:], prompt[: len(found) - ticks], atol=1e-12)


@pytest.mark.slow
def test_a_state_older_than_five_times_what_hold_bears_is_no_matter_with_prediction(monkeypatch):
    """Below the period, in an event-driven tree with coupling: points under delays of 1.76 s, where `hold` bears 0.35 s."""
    plan = at_rest(plan_of("lab", "duration=10"))
    found = point_run(late(plan, 1_763 * MS, "predict"), 6000, monkeypatch)
    assert np.abs(found[-1]).max() < 1e-6 * np.abs(found[0]).max()
    lost = point_run(late(plan, 1_763 * MS, "hold"), 1000, monkeypatch)
    assert np.abs(lost[-1]).max() > 100 * np.abs(lost[0]).max()


def test_analyse_says_that_it_does_not_know_them():
    with pytest.raises(PredictionError, match="9 state links have the policy predict"):
        analyse(late(plan_of("lab"), 50 * MS, "predict"))
