"""What is measured of a run while it goes (sim.results, as arrays): errors of blocks, settling, distances.

*Settling without the history.*  |e| has settled to the fraction f of the error S that it starts with from the instant after
the last at which |e| > f S.  S is the largest |e| of the first response time, so f S is not known before that is over.  Let M
be the largest |e| so far.  At an instant at which |e| exceeds M, it also exceeds f times the new M, because f < 1; and this
instant is later than all before.  So it is enough to keep the last instant at which |e| > f M.
"""

from math import isfinite, sqrt
from typing import Any, Final

from echelon.sim.batch.compiled import fused
from echelon.sim.batch.law import desired, to_shape
from echelon.sim.batch.memory import copy
from echelon.sim.batch.potential import sort_along
from echelon.sim.batch.records import (
    BLOCK_WHOLES,
    COS,
    M_FINITE,
    M_IAE,
    M_ISE,
    M_ITAE,
    M_LAST,
    M_OUT_FLOOR,
    M_PEAK,
    M_PEAK_NS,
    M_SOONER,
    M_START,
    OMEGA,
    SIN,
    V,
)

_SURELY: Final = 1 + 1e-9
"""More than what is lost by rounding"""
_SEEN: Final = 1.5
"""So many times the distance that counts robots look for others, so that they need not look at each instant"""


@fused
def measure(
    run: Any,
    robots: Any,
    nodes: Any,
    blocks: Any,
    table: Any,
    index: Any,
    real: Any,
    whole: Any,
    time_ns: int,
    step_ns: int,
) -> None:
    """Measures at `time_ns`, `step_ns` after the last time (0 at the first)."""
    places = run.places_at
    is_late = time_ns >= run.sooner_ns
    if is_late:
        _note_rates(run, robots, real)
    for number in range(len(nodes)):
        node = nodes[number]
        count, z = node.count, node.f_pot_at
        to_shape(node, 2, table, real, _side_by_side(node, index, real, places), z)
        centroid = places + 2 * (len(robots) + number)
        real[centroid], real[centroid + 1] = real[z + 2 * (count - 1)], real[z + 2 * (count - 1) + 1]
        square = 0.0
        for row in range(2 * (count - 1)):
            square += (real[z + row] - table[node.desired_at + row]) ** 2
        _note_error(run, blocks[node.block], table, real, whole, sqrt(square), time_ns, step_ns)
        if is_late:
            own = run.rates_at + 2 * (len(robots) + number)
            _note_amplitudes(run, node, own, blocks, table, index, real, square, time_ns)
        if node.link < 0:
            x, y, _, _, _, _ = desired(run, table, time_ns / 1e9)
            norm = sqrt((real[centroid] - x) ** 2 + (real[centroid + 1] - y) ** 2)
            _note_error(run, blocks[len(blocks) - 1], table, real, whole, norm, time_ns, step_ns)
    if step_ns > 0:
        note_distances(run, len(robots), real, whole, time_ns, step_ns)
    copy(real, places, run.before_at, 2 * len(robots))
    if step_ns == 0:
        note_distances(run, len(robots), real, whole, time_ns, step_ns)


@fused
def _side_by_side(node: Any, index: Any, real: Any, values: int) -> int:
    """Returns where the values of a node's children are side by side, two each; `values`: those of all roles."""
    if node.first_child >= 0:
        return int(values + 2 * node.first_child)
    for child in range(node.count):
        place = values + 2 * index[node.children_at + child]
        real[node.a_at + 2 * child], real[node.a_at + 2 * child + 1] = real[place], real[place + 1]
    return int(node.a_at)


@fused
def _note_rates(run: Any, robots: Any, real: Any) -> None:
    """Notes the robots' velocities."""
    for robot in range(len(robots)):
        at, place = robots[robot].at, run.rates_at + 2 * robot
        c, s, v, across = real[at + COS], real[at + SIN], real[at + V], robots[robot].offset * real[at + OMEGA]
        real[place] = v * c - across * s
        real[place + 1] = v * s + across * c


@fused
def _note_amplitudes(
    run: Any, node: Any, own: int, blocks: Any, table: Any, index: Any, real: Any, square: float, time_ns: int
) -> None:
    """Adds the squared amplitude of a node's blocks to the sum of its sixth (sim.results.ending).  z of the node is known,
    and so is |e|² of its shape, `square`.  The velocity of its centroid goes to `own`."""
    count, z, rates = node.count, node.f_pot_at, node.eta_at
    to_shape(node, 2, table, real, _side_by_side(node, index, real, run.rates_at), rates)
    centroid = 2 * (count - 1)
    real[own], real[own + 1] = real[rates + centroid], real[rates + centroid + 1]
    sixth = M_SOONER + (time_ns >= run.earlier_ns) + (time_ns >= run.last_ns)
    block = blocks[node.block]
    rest = 0.0
    for row in range(centroid):
        rest += (real[rates + row] + block.alpha * (real[z + row] - table[node.desired_at + row])) ** 2
    real[block.measures_at + sixth] += square + rest * block.per_omega_squared
    if node.link < 0:
        block = blocks[len(blocks) - 1]
        x, y, vx, vy, _, _ = desired(run, table, time_ns / 1e9)
        e_x, e_y = real[z + centroid] - x, real[z + centroid + 1] - y
        rest = (real[own] - vx + block.alpha * e_x) ** 2 + (real[own + 1] - vy + block.alpha * e_y) ** 2
        real[block.measures_at + sixth] += e_x * e_x + e_y * e_y + rest * block.per_omega_squared


@fused
def _note_error(
    run: Any, block: Any, table: Any, real: Any, whole: Any, norm: float, time_ns: int, step_ns: int
) -> None:
    at, marks = block.measures_at, block.marks_at
    before, peak, start = real[at + M_LAST], real[at + M_PEAK], real[at + M_START]
    ise, iae, itae = real[at + M_ISE], real[at + M_IAE], real[at + M_ITAE]
    if step_ns == 0 or norm > peak or (norm != norm and whole[marks + M_FINITE]):
        real[at + M_PEAK] = norm
        whole[marks + M_PEAK_NS] = time_ns
    if not isfinite(norm):
        whole[marks + M_FINITE] = 0
    if time_ns <= block.response_ns and not norm <= start:
        real[at + M_START] = start = norm
    for number in range(run.fractions):
        if norm > table[run.fractions_at + number] * start:
            whole[marks + BLOCK_WHOLES + number] = time_ns
    if norm > run.floor:
        whole[marks + M_OUT_FLOOR] = time_ns
    step = step_ns / 1e9
    real[at + M_ISE] = ise + step * (norm * norm + before * before) / 2
    real[at + M_IAE] = iae + step * (norm + before) / 2
    real[at + M_ITAE] = itae + step * (norm * (time_ns / 1e9) + before * ((time_ns - step_ns) / 1e9)) / 2
    real[at + M_LAST] = norm


@fused
def note_distances(run: Any, robots: int, real: Any, whole: Any, time_ns: int, step_ns: int) -> None:
    """Notes how close robots came since the last instant, on straight lines (sim.results.distances).

    Pairs are looked at only if one of them may have come as near as counts.  Two robots come nearer to each other by at most
    twice the largest motion relative to the first robot."""
    now, before = run.places_at, run.before_at
    common_x, common_y = real[now] - real[before], real[now + 1] - real[before + 1]
    fastest = 0.0
    for robot in range(1, robots):
        dx = real[now + 2 * robot] - real[before + 2 * robot] - common_x
        dy = real[now + 2 * robot + 1] - real[before + 2 * robot + 1] - common_y
        fastest = max(fastest, dx * dx + dy * dy)
    radius = run.avoidance_radius * run.avoidance_radius
    near, moved = sqrt(max(real[run.distance_at], radius)), 2 * sqrt(fastest)
    apart = real[run.apart_at] - moved
    if apart > near * _SURELY:
        real[run.apart_at] = apart
        return
    reach, seen = near + moved, _SEEN * near + moved
    order = run.order_at
    axis = sort_along(robots, before, order, real, whole)
    least = 1e300 if axis < 0 else seen * seen
    for place in range(robots - 1):
        one = place if axis < 0 else whole[order + place]
        x, y = real[before + 2 * one], real[before + 2 * one + 1]
        last = x + seen if axis == 0 else y + seen
        for later in range(place + 1, robots):
            other = later if axis < 0 else whole[order + later]
            if axis >= 0 and real[before + 2 * other + axis] > last:
                break
            x_apart, y_apart = real[before + 2 * other] - x, real[before + 2 * other + 1] - y
            square = x_apart * x_apart + y_apart * y_apart
            least = min(least, square)
            if square <= reach * reach:
                _note_distance(run, one, other, real, whole, time_ns, step_ns)
    real[run.apart_at] = sqrt(least) - moved


@fused
def _note_distance(run: Any, one: int, other: int, real: Any, whole: Any, time_ns: int, step_ns: int) -> None:
    """Notes how close two robots came since the last instant."""
    now, before, radius = run.places_at, run.before_at, run.avoidance_radius * run.avoidance_radius
    x = real[before + 2 * other] - real[before + 2 * one]
    y = real[before + 2 * other + 1] - real[before + 2 * one + 1]
    square = x * x + y * y
    dx = real[now + 2 * other] - real[now + 2 * one] - x
    dy = real[now + 2 * other + 1] - real[now + 2 * one + 1] - y
    change = dx * dx + dy * dy
    along = 0.0
    if change > 0.0:
        along = min(max(-(x * dx + y * dy) / change, 0.0), 1.0)
    nearest = min((x + along * dx) ** 2 + (y + along * dy) ** 2, square)
    if nearest < real[run.distance_at]:
        real[run.distance_at] = nearest
        whole[run.closest_at] = min(one, other)
        whole[run.closest_at + 1] = max(one, other)
        whole[run.closest_at + 2] = time_ns - step_ns + round(along * step_ns)
    if nearest <= radius and (step_ns == 0 or square > radius):
        whole[run.closest_at + 3] += 1
