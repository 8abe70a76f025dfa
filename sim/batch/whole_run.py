"""One whole run, and many of them: what a thread of the batch engine does."""

from math import cos, inf, isfinite, sin
from typing import Any, Final

from echelon.runtime.admission import LARGEST_SQUARE
from echelon.sim.batch.compiled import compiled, is_kept
from echelon.sim.batch.late_states import begin_commands
from echelon.sim.batch.measures import measure
from echelon.sim.batch.motion import move
from echelon.sim.batch.node import gather, steer
from echelon.sim.batch.records import (
    A_X,
    A_Y,
    COS,
    FAR,
    HELD_S,
    IN_USE,
    KEY_0,
    LAST,
    M_FINITE,
    M_LAST,
    NEXT,
    OMEGA,
    P_LEFT,
    P_PEAK,
    P_RIGHT,
    P_SATURATED,
    REFERENCES,
    S_LATE,
    S_LEFT,
    S_PEAK,
    S_PERIODS,
    S_RIGHT,
    S_SATURATED,
    SIN,
    THETA,
    V,
)
from echelon.sim.batch.streams import change_ns, finish, hear, room, say, take_up

STARTED_NS: Final = 1_000_000_000
"""Saturation in the first second is counted apart (sim.results.measures)"""

__all__ = ["is_kept", "many_runs", "whole_run"]


@compiled
def whole_run(model: Any, keys: Any, real: Any, whole: Any, trace: Any, sums: Any) -> int:
    """Runs a plan; returns the instant at which a robot's state is not finite or out of bounds [ns], or -1.  What is
    measured is in `real` and `whole` then.

    `keys`: two Philox keys of each link, (links, 4), the bits of its words as integers.  `trace`: states of the robots at the
    instants that all share, (T, robots, 7), or (0, robots, 7) if they are not wanted.  `sums`: |e|² and |e|⁴ of each block are
    added to it, (T, blocks, 2), or (0, blocks, 2)."""
    run = model.run[0]
    robots, nodes, blocks, streams, links = model.robots, model.nodes, model.blocks, model.streams, model.links
    table, index = model.table, model.indices
    _start(run, robots, nodes, blocks, links, keys, real, whole)
    lost_ns = -1
    instant = 0
    measured_ns = 0
    for time_ns in range(0, run.duration_ns + 1, run.tick_ns):
        for number in range(len(robots)):
            robot = robots[number]
            due = time_ns == whole[run.due_at + number]
            if due and not _say_state(robot, streams[robot.stream], real, whole, time_ns):
                lost_ns = time_ns
        if time_ns % run.common_ns == 0:
            measure(run, robots, nodes, blocks, table, index, real, whole, time_ns, time_ns - measured_ns)
            measured_ns = time_ns
            if len(trace) > instant:
                for number in range(len(robots)):
                    robot = robots[number]
                    trace[instant, number, 0], trace[instant, number, 1] = real[robot.place], real[robot.place + 1]
                    for value in range(5):
                        trace[instant, number, 2 + value] = real[robot.at + value]
            if len(sums) > instant:
                _add_squares(blocks, real, sums, instant)
            instant += 1
        if lost_ns >= 0:
            for later in range(instant, len(sums)):
                for number in range(len(blocks)):
                    sums[later, number, 0] = sums[later, number, 1] = inf
            return lost_ns
        for number in range(len(nodes)):
            node = nodes[number]
            if time_ns == whole[run.due_at + len(robots) + number]:
                speaks = node.up >= 0 and time_ns % node.parent_period_ns == 0
                gather(node, run, links, streams, table, index, real, whole, time_ns, speaks)
        for number in range(len(nodes) - 1, -1, -1):
            due = run.due_at + len(robots) + number
            if time_ns == whole[due]:
                steer(nodes[number], run, blocks, links, streams, table, index, real, whole, time_ns)
                whole[due] += nodes[number].period_ns
        for number in range(len(robots)):
            if time_ns == whole[run.due_at + number]:
                robot = robots[number]
                _obey(run, robot, links[robot.link], index, real, whole, time_ns)
                whole[run.due_at + number] += robot.period_ns
    return lost_ns


@compiled
def _add_squares(blocks: Any, real: Any, sums: Any, instant: int) -> None:
    """Adds |e|² and |e|⁴ of each block; infinity for what is not finite."""
    for number in range(len(blocks)):
        square = real[blocks[number].measures_at + M_LAST] ** 2
        if not isfinite(square):
            square = inf
        sums[instant, number, 0] += square
        sums[instant, number, 1] += square * square


@compiled
def _obey(run: Any, robot: Any, link: Any, index: Any, real: Any, whole: Any, due_ns: int) -> None:
    """Moves a robot through the period from `due_ns` on, with the accelerations that arrive in it."""
    now_ns, end_ns = due_ns, due_ns + robot.period_ns
    take_up(link, index, whole)
    while now_ns < end_ns:
        said, until_ns = hear(link, real, whole, now_ns), end_ns
        if robot.on_arrival:
            change = change_ns(link, whole, now_ns)
            until_ns = change if change < end_ns and change <= run.duration_ns else end_ns
        ax = ay = 0.0
        if said >= 0:
            ax, ay = real[said + robot.command], real[said + robot.command + 1]
        move(robot, real, now_ns, until_ns, ax, ay, said >= 0)
        if robot.says_acceleration:
            real[robot.at + A_X], real[robot.at + A_Y] = ax, ay
        now_ns = until_ns


@compiled
def _start(run: Any, robots: Any, nodes: Any, blocks: Any, links: Any, keys: Any, real: Any, whole: Any) -> None:
    for place in range(len(real)):
        real[place] = 0.0
    for place in range(run.zeros):
        whole[place] = 0
    for place in range(REFERENCES):
        whole[run.references_ns_at + place] = -1
    for number in range(len(robots)):
        robot = robots[number]
        real[robot.place], real[robot.place + 1] = robot.x, robot.y
        real[robot.at + THETA] = robot.heading
        real[robot.at + HELD_S] = robot.h
        real[robot.at + COS] = cos(robot.heading)
        real[robot.at + SIN] = sin(robot.heading)
    for number in range(len(links)):
        marks = links[number].marks_at
        whole[marks + IN_USE] = whole[marks + LAST] = -1
        whole[marks + NEXT] = FAR
        for word in range(4):
            whole[marks + KEY_0 + word] = keys[number, word]
    for number in range(len(blocks)):
        marks = blocks[number].marks_at
        whole[marks + M_FINITE] = 1
        for mark in range(run.fractions + 1):
            whole[marks + M_FINITE + 1 + mark] = -1
    real[run.distance_at] = 1e300
    real[run.apart_at] = -1.0
    for place in range(len(robots)):
        whole[run.order_at + place] = place
    for number in range(len(nodes)):
        begin_commands(nodes[number], whole)
        if run.avoidance:
            for place in range(nodes[number].robots):
                whole[nodes[number].order_at + place] = place


@compiled
def _say_state(robot: Any, stream: Any, real: Any, whole: Any, time_ns: int) -> bool:
    """Sends a robot's state and adds up the torques of the period that ends; returns whether the state is within the
    bounds of all messages (`echelon.runtime.admission`), and so finite."""
    at, place = robot.at, room(stream, whole)
    x, y, theta, v, omega = real[robot.place], real[robot.place + 1], real[at + THETA], real[at + V], real[at + OMEGA]
    c, s, across = real[at + COS], real[at + SIN], robot.offset * omega
    right, left, peak, saturated = real[at + P_RIGHT], real[at + P_LEFT], real[at + P_PEAK], real[at + P_SATURATED]
    all_right, all_left, highest, periods = (
        real[at + S_RIGHT],
        real[at + S_LEFT],
        real[at + S_PEAK],
        real[at + S_PERIODS],
    )
    vx, vy = v * c - across * s, v * s + across * c
    real[place], real[place + 1], real[place + 2], real[place + 3] = x, y, vx, vy
    if robot.says_acceleration:
        real[place + 4] = real[at + A_X]
        real[place + 5] = real[at + A_Y]
    say(stream, whole, time_ns, 0)
    if time_ns > 0:
        real[at + S_RIGHT] = all_right + right / robot.torque_periods
        real[at + S_LEFT] = all_left + left / robot.torque_periods
        real[at + S_PEAK] = max(highest, peak)
        real[at + S_PERIODS] = periods + 1.0
        real[at + P_RIGHT] = real[at + P_LEFT] = real[at + P_PEAK] = 0.0
        if saturated > 0.0:
            real[at + P_SATURATED] = 0.0
            real[at + S_SATURATED] += saturated
            if time_ns > STARTED_NS:
                real[at + S_LATE] += saturated
    # vx² + vy² is v² + across².  The mean squares of torques are much larger than the torques, where any of them matters here.
    # Commanded accelerations are left out, which saves time: they show in the torques, unless limits cut those.
    periods = robot.torque_periods
    moves = x * x + y * y + theta * theta + omega * omega + 2.0 * v * v + across * across
    square: float = moves + (right * right + left * left) / (periods * periods)
    return square <= LARGEST_SQUARE  # false for NaN


@compiled
def many_runs(
    model: Any, keys: Any, first: int, last: int, real: Any, whole: Any, traces: Any, sums: Any, lost_ns: Any,
    kept_reals: Any, kept_wholes: Any, reals: Any, wholes: Any,
) -> None:  # fmt: skip
    """Runs number `first` to `last` - 1; copies the results of each from the scratch (`real`, `whole`) to `reals[number]` and
    `wholes[number]`."""
    for number in range(first, last):
        lost_ns[number] = whole_run(model, keys[number], real, whole, traces[min(number, len(traces) - 1)], sums)
        for at in range(len(model.links)):
            finish(model.links[at], whole)
        for place in range(len(kept_reals)):
            reals[number, place] = real[kept_reals[place]]
        for place in range(len(kept_wholes)):
            wholes[number, place] = whole[kept_wholes[place]]
