"""What a node makes of the states of its children that are late (controller.late_states, as arrays).

*Prediction without replay.*  A node keeps of its newest commands, for each child, the acceleration a, and what all commands
before have added to velocity and position: V = ∫ a, P = ∫ V.  A child that moves with the velocity v at the instant s then
has moved by

    P(t) - P(s) + (v - V(s)) (t - s)        and        V(t) - V(s)

at t.  So the work does not grow with the delay.  The command that acted at s is remembered for each child, so a message may be
held for as long as it takes.
"""

from typing import Any

from echelon.sim.batch.compiled import fused
from echelon.sim.batch.law import desired
from echelon.sim.batch.records import COMMAND_REALS, EXTRAPOLATED, PREDICTED, REFERENCES


@fused
def begin_commands(node: Any, whole: Any) -> None:
    """Begins with one command, of no acceleration, at run time 0."""
    if node.commands_at >= 0:
        whole[node.commands_marks_at] = 1


@fused
def note_commands(node: Any, real: Any, whole: Any, time_ns: int, commanded: bool) -> None:
    """Takes the accelerations that a node commands at an instant, from `a_at`; zeros if it commands nothing."""
    marks, width = node.commands_marks_at, COMMAND_REALS * node.count
    number = whole[marks]
    last, this = (number - 1) & node.commands_mask, number & node.commands_mask
    h = (time_ns - whole[marks + 1 + last]) * 1e-9
    before, place = node.commands_at + last * width, node.commands_at + this * width
    for child in range(node.count):
        at, to = before + COMMAND_REALS * child, place + COMMAND_REALS * child
        for axis in range(2):
            a, v = real[at + axis], real[at + 2 + axis]
            real[to + 4 + axis] = real[at + 4 + axis] + h * v + h * h / 2 * a
            real[to + 2 + axis] = v + h * a
            real[to + axis] = real[node.a_at + 2 * child + axis] if commanded else 0.0
    whole[marks + 1 + this] = time_ns
    whole[marks] = number + 1


@fused
def bring(
    node: Any, run: Any, link: Any, table: Any, index: Any, real: Any, whole: Any, child: int, said: int, time_ns: int,
    since_ns: int,
) -> None:  # fmt: skip
    """Moves a child's state, which was said at `said` in `real`, from `since_ns` on to `time_ns`, by the policy of its link, or
    as the reference has moved."""
    at, tau = node.s_at + 4 * child, (time_ns - since_ns) * 1e-9
    before_x, before_y = real[at], real[at + 1]
    if link.brought == PREDICTED:
        _replay(node, index, real, whole, child, time_ns, since_ns)
    elif link.brought == EXTRAPOLATED:
        a = said + 4 if link.of_robot else _last_command(node, real, whole, child)
        ax, ay = real[a], real[a + 1]
        real[at] += real[at + 2] * tau + ax * (tau * tau / 2)
        real[at + 1] += real[at + 3] * tau + ay * (tau * tau / 2)
        real[at + 2] += ax * tau
        real[at + 3] += ay * tau
    else:
        now = _reference(run, table, real, whole, time_ns)
        x, y, vx, vy = real[now], real[now + 1], real[now + 2], real[now + 3]
        then = _reference(run, table, real, whole, max(0, since_ns))
        real[at] += x - real[then]
        real[at + 1] += y - real[then + 1]
        real[at + 2] += vx - real[then + 2]
        real[at + 3] += vy - real[then + 3]
    if not run.avoidance:
        return
    x, y = real[at] - before_x, real[at + 1] - before_y
    for part in range(index[node.carried_at + child], index[node.carried_at + child + 1]):
        here, size = index[3 * part + 1], index[3 * part + 2]
        if here >= node.positions:
            for value in range(0, size, 2):
                real[node.state_at + here + value] += x
                real[node.state_at + here + value + 1] += y


@fused
def _reference(run: Any, table: Any, real: Any, whole: Any, time_ns: int) -> int:
    """Returns where in `real` the reference and its velocity at an instant are.  They are kept, by the tick of the instant,
    because robots say their states at the same instants."""
    slot = int(time_ns * run.per_tick) & (REFERENCES - 1)
    place = int(run.references_at + 4 * slot)
    if whole[run.references_ns_at + slot] != time_ns:
        whole[run.references_ns_at + slot] = time_ns
        real[place], real[place + 1], real[place + 2], real[place + 3], _, _ = desired(run, table, time_ns * 1e-9)
    return place


@fused
def _last_command(node: Any, real: Any, whole: Any, child: int) -> int:
    """Returns where in `real` the acceleration last commanded to a child is."""
    last = (whole[node.commands_marks_at] - 1) & node.commands_mask
    return int(node.commands_at + (last * node.count + child) * COMMAND_REALS)


@fused
def _replay(node: Any, index: Any, real: Any, whole: Any, child: int, time_ns: int, since_ns: int) -> None:
    """Moves a child's state from one instant to another through the accelerations that were commanded to it."""
    if since_ns >= time_ns:
        return
    marks, mask, delay_ns = node.commands_marks_at, node.commands_mask, index[node.command_delays_at + child]
    number = whole[marks]
    # The last command that acted at `since_ns`: its number; its instant, and a copy of its numbers; those of the one before.
    known_at = marks + 2 + mask + 3 * child
    known = node.commands_at + ((mask + 1) * node.count + 2 * child) * COMMAND_REALS
    then, next_one = whole[known_at], max(whole[known_at] + 1, number - mask - 1)
    while next_one < number and whole[marks + 1 + (next_one & mask)] + delay_ns <= since_ns:
        then = next_one
        next_one += 1
    if then != whole[known_at]:
        whole[known_at] = then
        for back in range(2):
            one = (then - back) & mask
            whole[known_at + 1 + back] = whole[marks + 1 + one]
            source = node.commands_at + (one * node.count + child) * COMMAND_REALS
            for value in range(COMMAND_REALS):
                real[known + back * COMMAND_REALS + value] = real[source + value]
    acted_ns = whole[known_at + 1] + delay_ns
    if since_ns < acted_ns:  # by a clock that drifts a message that is held becomes older
        acted_ns = whole[known_at + 2] + delay_ns
        known += COMMAND_REALS
    now = number - 1
    while now > max(0, number - mask - 1) and whole[marks + 1 + (now & mask)] + delay_ns > time_ns:
        now -= 1
    latest = node.commands_at + ((now & mask) * node.count + child) * COMMAND_REALS
    before_s = (since_ns - acted_ns) * 1e-9
    after_s = (time_ns - delay_ns - whole[marks + 1 + (now & mask)]) * 1e-9
    at, tau = node.s_at + 4 * child, (time_ns - since_ns) * 1e-9
    for axis in range(2):
        a, v = real[known + axis], real[known + 2 + axis]
        b, w = real[latest + axis], real[latest + 2 + axis]
        v_then = v + before_s * a
        p_then = real[known + 4 + axis] + before_s * v + before_s * before_s / 2 * a
        p_now = real[latest + 4 + axis] + after_s * w + after_s * after_s / 2 * b
        real[at + axis] += p_now - p_then + tau * (real[at + 2 + axis] - v_then)
        real[at + 2 + axis] += w + after_s * b - v_then
