"""A node of the tree: it gathers states and sends accelerations (controller.node, as arrays)."""

from typing import Any

from echelon.sim.batch.compiled import fused
from echelon.sim.batch.late_states import bring, note_commands
from echelon.sim.batch.law import desired, own_law, to_children, to_shape
from echelon.sim.batch.memory import copy, copy_four
from echelon.sim.batch.potential import add_pair_forces
from echelon.sim.batch.records import STAMP
from echelon.sim.batch.streams import hear, heard_ns, read_age_ns, room, say, take_up


@fused
def gather(
    node: Any, run: Any, links: Any, streams: Any, table: Any, index: Any, real: Any, whole: Any,
    due_ns: int, speaks: bool,
) -> None:  # fmt: skip
    """Takes the children's states in the period from `due_ns` on; sends the GROUP_STATE if the node `speaks` to its parent in
    this period."""
    count = node.count
    time_ns = due_ns
    for child in range(count):
        take_up(links[index[node.links_at + child]], index, whole)
    if node.when_heard:
        time_ns, last_ns = max(due_ns, whole[node.acted_at]), _last_ns(node, run, due_ns)
        for child in range(count):
            time_ns = heard_ns(links[index[node.links_at + child]], whole, time_ns, last_ns)
    whole[node.acted_at] = time_ns
    complete = 1
    for child in range(count):
        link = links[index[node.links_at + child]]
        said = hear(link, real, whole, time_ns)
        if said < 0:
            complete = 0
            continue
        copy_four(real, said, node.s_at + 4 * child)
        for part in range(index[node.carried_at + child], index[node.carried_at + child + 1]):
            there, here, size = index[3 * part], index[3 * part + 1], index[3 * part + 2]
            copy(real, said + there, node.state_at + here, size)
        if link.brought:
            since_ns = whole[link.marks_at + STAMP]
            if link.odd_clocks:
                since_ns = time_ns - read_age_ns(link, time_ns, since_ns)
            if since_ns != time_ns:
                bring(node, run, link, table, index, real, whole, child, said, time_ns, since_ns)
    whole[node.has_state_at] = complete
    if complete:
        _transform(node, run, table, real, time_ns)
    if speaks:
        up = streams[node.up]
        if complete:
            copy(real, node.state_at, room(up, whole), up.length)
        say(up, whole, time_ns, 1 - complete)


@fused
def _last_ns(node: Any, run: Any, due_ns: int) -> int:
    """Returns the last instant at which a node may act that is due at `due_ns`: nothing acts after the end of the run."""
    return int(max(due_ns, min(due_ns + node.period_ns - 1, run.duration_ns)))


@fused
def _transform(node: Any, run: Any, table: Any, real: Any, time_ns: int) -> None:
    """Computes shape variables, centroid and their errors, (e_x, e_y, ė_x, ė_y) of each, and the node's own part of its
    GROUP_STATE."""
    count, e, state = node.count, node.e_at, node.state_at
    to_shape(node, 4, table, real, node.s_at, e)
    to_shape(node, 4, table, real, node.s_at + 2, e + 2)
    centroid = e + 4 * (count - 1)
    copy_four(real, centroid, state)
    for variable in range(count - 1):
        e_x, e_y = real[e + 4 * variable], real[e + 4 * variable + 1]
        real[e + 4 * variable] = e_x - table[node.desired_at + 2 * variable]
        real[e + 4 * variable + 1] = e_y - table[node.desired_at + 2 * variable + 1]
    if node.own_rates >= 0:
        for variable in range(count - 1):
            real[state + node.own_rates + 2 * variable] = real[e + 4 * variable + 2]
            real[state + node.own_rates + 2 * variable + 1] = real[e + 4 * variable + 3]
    if node.link < 0:
        t = time_ns * 1e-9
        x, y, vx, vy, ax, ay = desired(run, table, t)
        if run.ahead > 0.0:
            _, _, _, _, ax, ay = desired(run, table, t + run.ahead)
        real[centroid] -= x
        real[centroid + 1] -= y
        real[centroid + 2] -= vx
        real[centroid + 3] -= vy
        real[node.c_at] = ax
        real[node.c_at + 1] = ay
        if node.own_rates >= 0:
            real[state + node.centroid_rates] = real[centroid + 2]
            real[state + node.centroid_rates + 1] = real[centroid + 3]


@fused
def steer(
    node: Any, run: Any, blocks: Any, links: Any, streams: Any, table: Any, index: Any, real: Any, whole: Any,
    due_ns: int,
) -> None:  # fmt: skip
    """Takes the parent's reference in the period from `due_ns` on; sends REFERENCE and COMMAND to the children."""
    time_ns = whole[node.acted_at]
    if node.link >= 0:
        take_up(links[node.link], index, whole)
        if node.when_heard:
            time_ns = heard_ns(links[node.link], whole, time_ns, _last_ns(node, run, due_ns))
            whole[node.acted_at] = time_ns
    complete = whole[node.has_state_at]
    rates = forces = -1
    if node.link >= 0:
        said = hear(links[node.link], real, whole, time_ns)
        if said < 0:
            complete = 0
        else:
            a = said + node.acceleration
            real[node.c_at], real[node.c_at + 1] = real[a], real[a + 1]
            rates, forces = said + node.parent_rates, said + node.parent_forces
    else:
        rates = node.state_at + node.rates
    if not complete:
        if node.reference >= 0:
            say(streams[node.reference], whole, time_ns, 1)
        if node.command >= 0:
            say(streams[node.command], whole, time_ns, 1)
        if node.commands_at >= 0:
            note_commands(node, real, whole, time_ns, False)
        return
    if node.rates_size == 0:
        rates = -1
    f_pot = -1
    if run.avoidance:
        _add_forces(node, run, table, index, real, whole, forces)
        f_pot = node.f_pot_at
    _accelerate(node, run, blocks, table, index, real, rates, f_pot)
    if node.commands_at >= 0:
        note_commands(node, real, whole, time_ns, True)
    if node.command >= 0:
        command = streams[node.command]
        copy(real, node.a_at, room(command, whole), 2 * node.count)
        say(command, whole, time_ns, 0)
    if node.reference >= 0:
        reference = streams[node.reference]
        place = room(reference, whole)
        copy(real, node.a_at, place, 2 * node.count)
        place += 2 * node.count
        copy(real, rates, place, node.rates_size)
        place += node.rates_size
        if run.avoidance:
            copy(real, node.forces_at, place, 2 * node.robots)
        say(reference, whole, time_ns, 0)


@fused
def _add_forces(node: Any, run: Any, table: Any, index: Any, real: Any, whole: Any, parent_forces: int) -> None:
    """Computes the forces on the robots below, those from above included, and F_pot of the node's blocks."""
    if parent_forces >= 0:
        copy(real, parent_forces, node.forces_at, 2 * node.robots)
    else:
        for value in range(2 * node.robots):
            real[node.forces_at + value] = 0.0
    add_pair_forces(node, run, index, real, whole)
    robot = node.forces_at
    for child in range(node.count):
        x = y = 0.0
        for _ in range(index[node.bounds_at + child], index[node.bounds_at + child + 1]):
            x += real[robot]
            y += real[robot + 1]
            robot += 2
        share = table[node.means_at + child]
        real[node.a_at + 2 * child] = x * share
        real[node.a_at + 2 * child + 1] = y * share
    to_shape(node, 2, table, real, node.a_at, node.f_pot_at)


@fused
def _accelerate(node: Any, run: Any, blocks: Any, table: Any, index: Any, real: Any, rates: int, f_pot: int) -> None:
    """Computes the children's accelerations."""
    shape = 2 * (node.count - 1)
    if shape > 0:
        own_law(run, blocks[node.block], table, index, real, node.e_at, rates, f_pot, node.eta_at)
    centroid = node.eta_at + shape
    if node.link < 0:
        if f_pot >= 0:
            f_pot += shape
        own_law(run, blocks[len(blocks) - 1], table, index, real, node.e_at + 2 * shape, rates, f_pot, centroid)
        real[centroid] += real[node.c_at]
        real[centroid + 1] += real[node.c_at + 1]
    else:
        real[centroid], real[centroid + 1] = real[node.c_at], real[node.c_at + 1]
    to_children(node, table, real, node.eta_at, node.a_at)
