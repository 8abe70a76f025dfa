"""From a plan to arrays (`records`): once for each plan, before its runs."""

from collections.abc import Sequence
from itertools import accumulate
from math import ceil, gcd, lcm
from typing import Any

import numpy as np

from echelon.controller.late_states import EXTRAPOLATE, PREDICT
from echelon.controller.laws import Integral, Linear, TerminalSliding
from echelon.controller.laws.law import Block, law_block
from echelon.controller.trajectory import Circle, Line, Sine
from echelon.controller.transformation import desired_shape
from echelon.messages import Channel
from echelon.plan.layout import NodeLayout, length
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import (
    Array,
    BlockPlan,
    NodePlan,
    Plan,
    RobotPlan,
)
from echelon.sim.batch import records as r
from echelon.sim.batch.link_model import LinkMaker
from echelon.sim.batch.outcomes import fractions, late_sixths_ns
from echelon.sim.batch.pools import Pools, records_of
from echelon.sim.batch.robots import motion_of
from echelon.sim.results.rates import oscillation
from echelon.sim.results.settling import response_ns


class ModelMaker:
    """Makes the arrays of a plan."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.pools = Pools()
        self.of_links = LinkMaker(plan, self.pools)
        self._shared: dict[str, int] = {}
        self.fractions = fractions(plan)

    def make(self) -> r.Model:
        """Returns the arrays."""
        plan, pools = self.plan, self.pools
        self.places = pools.real(2 * len(plan.formation))
        streams, links = self.of_links.make()
        robots = [self._robot(robot) for robot in plan.robots]
        nodes = [self._node(node) | self._passing() for node in plan.nodes]
        blocks = [self._block(block) for block in plan.blocks]
        run = self._run()
        # What is seldom touched comes last: what is touched at each instant lies close together.
        for link, record in zip(plan.links, links, strict=True):
            record |= self.of_links.ages(link)
        run["zeros"] = pools.wholes
        for record in links:
            record["bins_at"] = pools.whole(record["bins"])
        table, index = pools.arrays()
        return r.Model(
            records_of(r.RUN, [run]),
            records_of(r.ROBOT, robots),
            records_of(r.NODE, nodes),
            records_of(r.BLOCK, blocks),
            records_of(r.STREAM, streams),
            records_of(r.LINK, links),
            table,
            index,
        )

    def _robot(self, robot: RobotPlan) -> dict[str, Any]:
        return motion_of(robot) | {
            "on_arrival": robot.event_driven and not all(link.prompt for link in self.plan.links_into(robot.index)),
            "at": self.pools.real(r.ROBOT_REALS),
            "place": self.places + 2 * robot.index,
            "stream": self.of_links.streams[robot.index, Channel.STATE],
            "link": self.of_links.numbers[robot.parent, robot.index, Channel.COMMAND],
            "command": 2 * robot.child_number,
            "says_acceleration": self.of_links.state_length(robot.index) > 4,
        }

    def _node(self, node: NodePlan) -> dict[str, Any]:
        plan, pools, layout = self.plan, self.pools, NodeLayout.of(self.plan, node)
        count, first, state, mine = len(node.children), node.children[0], layout.state, layout.mine
        kinds = [Channel.STATE if child < len(plan.robots) else Channel.GROUP_STATE for child in node.children]
        links = [
            self.of_links.numbers[child, node.index, kind] for child, kind in zip(node.children, kinds, strict=True)
        ]
        parent = None if node.parent is None else plan.formation[node.parent]
        coupled = length(state.rates) > 0
        return {
            "period_ns": node.period_ns,
            "parent_period_ns": 1 if parent is None else parent.period_ns,
            "when_heard": node.event_driven and not all(link.prompt for link in plan.links_into(node.index)),
            "count": count,
            "robots": node.robots,
            "links_at": pools.index(links),
            "children_at": pools.index(node.children),
            "first_child": first if list(node.children) == [*range(first, first + count)] else -1,
            "shares_at": pools.table(
                [w / total for w, total in zip(node.weights, accumulate(node.weights), strict=True)]
            ),
            "means_at": pools.table([1 / weight for weight in node.weights]),
            "bounds_at": pools.index(list(accumulate(node.weights, initial=0))),
            "child_of_at": pools.index([child for child, weight in enumerate(node.weights) for _ in range(weight)]),
            "carried_at": self._carried(layout, count),
            "up": self.of_links.streams.get((node.index, Channel.GROUP_STATE), -1),
            "reference": self.of_links.streams.get((node.index, Channel.REFERENCE), -1),
            "command": self.of_links.streams.get((node.index, Channel.COMMAND), -1),
            "link": -1 if node.parent is None else self.of_links.numbers[node.parent, node.index, Channel.REFERENCE],
            "acceleration": 0 if mine is None else mine.acceleration.start,
            "parent_rates": 0 if mine is None else mine.rates.start,
            "parent_forces": 0 if mine is None else mine.forces.start,
            "block": next(at for at, block in enumerate(plan.blocks) if block.node == node.index),
            "desired_at": pools.table(desired_shape(node.shape, node.weights)),
            "e_at": pools.real(4 * count),
            "c_at": pools.real(2),
            "order_at": pools.whole(node.robots + 1 if plan.avoidance.enabled else 0),
            "state_at": pools.real(state.size),
            "has_state_at": pools.whole(1),
            "acted_at": pools.whole(1),
            "own_rates": state.own_rates.start if coupled else -1,
            "centroid_rates": state.centroid_rates.start,
            "rates": state.rates.start,
            "rates_size": 2 * len(plan.robots) if plan.coupled else 0,
            "positions": state.positions.start,
        } | self._commands(node, [plan.links[link] for link in links])

    def _passing(self) -> dict[str, int]:
        """Returns scratch that nodes need only while they act: all have the same."""
        if not self._shared:
            count, pools = max(len(node.children) for node in self.plan.nodes), self.pools
            self._shared = {
                "s_at": pools.real(4 * count),
                "eta_at": pools.real(2 * count),
                "a_at": pools.real(2 * count),
                "f_pot_at": pools.real(2 * count),
                "forces_at": pools.real(2 * len(self.plan.robots) if self.plan.avoidance.enabled else 0),
            }
        return self._shared

    def _commands(self, node: NodePlan, links: Sequence[LinkPlan]) -> dict[str, int]:
        """Returns where a node keeps its commands: those that may act later than a message was sent that comes into use."""
        plan, pools, count = self.plan, self.pools, len(links)
        policies = {link.policy for link in links}
        of_nodes = any(link.policy == EXTRAPOLATE and link.channel is Channel.GROUP_STATE for link in links)
        if not (of_nodes or PREDICT in policies):
            return {"commands_at": -1, "commands_marks_at": -1, "command_delays_at": -1}
        down = {link.receiver: link.delay_min_ns for link in plan.links if link.source == node.index}
        delays_ns = [down[link.source] for link in links]
        most = 1
        for link, delay_ns in zip(links, delays_ns, strict=True):
            if link.policy == PREDICT:
                # A message is used at the latest two periods after its arrival.
                late_ns = link.delay_max_ns + 2 * node.period_ns + delay_ns + _clocks_differ_ns(link, plan.duration_ns)
                most = max(most, min(late_ns, plan.duration_ns) // node.period_ns + 5)
        depth = 1 << (most - 1).bit_length()
        return {
            "commands_at": pools.real((depth + 2) * count * r.COMMAND_REALS),
            "commands_marks_at": pools.whole(1 + depth + 3 * count),
            "commands_mask": depth - 1,
            "command_delays_at": pools.index(delays_ns),
        }

    def _carried(self, layout: NodeLayout, count: int) -> int:
        """Returns the place of what a node copies of each child's message: bounds, then (there, here, length)."""
        entries = [(part.child, part.there.start, part.here.start, length(part.there)) for part in layout.carried]
        self.pools.index([0] * (-self.pools.index([]) % 3))  # places of threes are counted in threes
        place = self.pools.index([number for entry in entries for number in entry[1:]]) // 3
        bounds = [place + sum(entry[0] < child for entry in entries) for child in range(count + 1)]
        return self.pools.index(bounds)

    def _block(self, block: BlockPlan) -> dict[str, Any]:
        pools, seen = self.pools, law_block(self.plan, block)
        K_1, K_2, K_i, weight, bound = self._gains(seen)
        matrices = K_1, K_2, K_i, weight / block.sigma
        diagonal = all(np.array_equal(matrix, np.diag(np.diag(matrix))) for matrix in matrices)
        places = [pools.table(np.diag(matrix) if diagonal else matrix) for matrix in matrices]
        coupling = weight @ self.plan.coupling[block.offset : block.offset + block.size]
        alpha, omega_squared = oscillation(block)
        rows = [np.flatnonzero(row).tolist() for row in coupling]
        bounds = list(accumulate(map(len, rows), initial=0))
        return {
            "rows": block.size,
            "is_diagonal": diagonal,
            "k1_at": places[0],
            "k2_at": places[1],
            "ki_at": places[2],
            "pot_at": places[3],
            "rows_at": pools.index([*bounds, *(column for row in rows for column in row)]),
            "values_at": pools.table(coupling[coupling != 0]),
            "integral_at": pools.real(block.size if isinstance(self.plan.law.made, Integral) else 0),
            "measures_at": pools.real(r.BLOCK_REALS),
            "marks_at": pools.whole(r.BLOCK_WHOLES + len(self.fractions)),
            "sigma": block.sigma,
            "ahead": seen.ahead_s,
            "period": seen.period_s,
            "bound": bound,
            "response_ns": response_ns(block),
            "alpha": alpha,
            "per_omega_squared": 1 / omega_squared if omega_squared > 0 else 0.0,
        }

    def _gains(self, block: Block) -> tuple[Array, Array, Array, Array, float]:
        """Returns K_1, K_2, K_i and W of a block, with look-ahead, and the bound of its integral."""
        law = self.plan.law.made
        if isinstance(law, Linear | Integral):
            gains = law.linear(block)
            bound = law.limit * block.sigma**3 / law.k_i if isinstance(law, Integral) else 0.0
            return gains.K_1, gains.K_2, gains.K_i, gains.weight, bound
        none = np.zeros((block.size, block.size))
        return none, none, none, law.weight(block), 0.0

    def _run(self) -> dict[str, Any]:
        plan, pools, avoidance = self.plan, self.pools, self.plan.avoidance
        kind, numbers = self._trajectory()
        law = plan.law.made
        sliding = isinstance(law, TerminalSliding)
        tick_ns = gcd(*[one.period_ns for one in plan.formation])
        return {
            "duration_ns": plan.duration_ns,
            **dict(zip(("sooner_ns", "earlier_ns", "last_ns"), late_sixths_ns(plan), strict=True)),
            "tick_ns": tick_ns,
            "common_ns": lcm(*[robot.period_ns for robot in plan.robots]),
            "avoidance": avoidance.enabled,
            "law": r.SLIDING if sliding else r.INTEGRAL if isinstance(law, Integral) else r.LINEAR,
            "trajectory": kind,
            "trajectory_at": pools.table(numbers),
            "trajectory_legs": len(numbers) - 1,
            "fractions_at": pools.table(self.fractions),
            "fractions": len(self.fractions),
            "due_at": pools.whole(len(plan.formation)),
            "places_at": self.places,
            "rates_at": pools.real(2 * len(plan.formation)),
            "before_at": pools.real(2 * len(plan.robots)),
            "order_at": pools.whole(len(plan.robots) + 1),
            "distance_at": pools.real(1),
            "apart_at": pools.real(1),
            "closest_at": pools.whole(4),
            "references_at": pools.real(4 * r.REFERENCES),
            "references_ns_at": pools.whole(r.REFERENCES),
            "avoidance_radius": avoidance.avoidance_radius,
            "sensing_radius": avoidance.sensing_radius,
            "force_limit": avoidance.force_limit,
            "floor": plan.health.floor,
            "gamma": law.gamma if sliding else 0.0,
            "beta": law.beta if sliding else 0.0,
            "kappa": law.kappa if sliding else 0.0,
            "ahead": plan.lead * plan.root.period_ns * 1e-9,
            "per_tick": 1 / tick_ns,
        }

    def _trajectory(self) -> tuple[int, list[Any]]:
        """Returns the kind of the trajectory and its numbers, for waypoints rows of (time, x, y)."""
        made = self.plan.trajectory.made
        if isinstance(made, Line):
            return r.LINE, [*made.start, *made.velocity]
        if isinstance(made, Circle):
            return r.CIRCLE, [*made.centre, made.radius, made.rate, made.phase]
        if isinstance(made, Sine):
            return r.SINE, [*made.start, made.speed, made.amplitude, made.rate]
        return r.WAYPOINTS, [(t, *point) for t, point in zip(made.times, made.points, strict=True)]


def _clocks_differ_ns(link: LinkPlan, duration_ns: int) -> int:
    """Returns by how much the age that a receiver reads may differ from the true one."""
    clocks = link.source_clock, link.receiver_clock
    return sum(abs(clock.offset_ns) + ceil(abs(clock.drift) * duration_ns) for clock in clocks)
