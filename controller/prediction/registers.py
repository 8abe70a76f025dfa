"""The registers of the linear run with random links, and the steps between them (docs/architecture.md, 2.11).

There are registers for what each role keeps, for the messages on their way, and for the message in use at each receiver.  The
matrix of a stage comes from unit vectors that the stage takes (`linear_roles`).
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array

from echelon.controller.prediction.linear_roles import MOTION, LinearNode, LinearRobot, LinearStage, moved, powers_of
from echelon.controller.prediction.policies import Block, Policies
from echelon.controller.prediction.random_delays import oldest, varies
from echelon.controller.prediction.random_steps import Choice, Indices, Jump, Linear, Step
from echelon.messages import Channel
from echelon.plan.link_plan import LinkPlan
from echelon.plan.plan import Array, Plan
from echelon.role import Input
from echelon.runtime.turns import Turn

Role = LinearRobot | LinearNode


@dataclass(frozen=True, slots=True)
class Taking:
    """An input that a receiver looks at: what came since `since_ns`, until now."""

    receiver: int
    heard: Input
    since_ns: int
    now_ns: int


class Registers:
    """The registers of a plan."""

    def __init__(self, plan: Plan, lossy: frozenset[int], chained: frozenset[int]) -> None:
        """`lossy` are the links, by their place in `plan.links`, that lose messages each by itself; `chained` those that lose
        the same messages, as a Markov chain says."""
        self.plan = plan
        self._lossy, self._chained = lossy, chained
        self.roles: list[Role] = [
            *(LinearRobot(plan, robot) for robot in plan.robots),
            *(LinearNode(plan, node) for node in plan.nodes),
        ]
        self.count = 0
        """Number of registers"""
        self._units: list[float] = []
        self._H = plan.root.period_ns * 1e-9
        self._kept = [self._keep(role) for role in self.roles]
        self._policies = Policies(plan, self._new)
        self._at: dict[tuple[int, int, Channel], int] = {}
        self._held: dict[int, Indices] = {}
        self._wires: dict[tuple[int, Channel], _Wire] = {}
        for (role, stage), each in ((pair, heard) for pair in self.stages() for heard in pair[1].timed.inputs):
            self._add_link(role, stage, each)

    @property
    def units(self) -> Array:
        """For each register the factor that turns its number in SI units into the register's, (count,)."""
        return np.array(self._units)

    def stages(self) -> list[tuple[Role, LinearStage]]:
        """Returns all stages with their roles, in the order of their levels."""
        found = [(role, stage) for role in self.roles for stage in role.stages]
        return sorted(found, key=lambda pair: pair[1].timed.level)

    def memory(self, role: int) -> Indices:
        """Returns the registers of what a role keeps from hyperperiod to hyperperiod; of a robot (x, y, vx, vy)."""
        return self._kept[role]["memory"]

    def link(self, receiver: int, heard: Input) -> int:
        """Returns the place of the link of an input in `plan.links`."""
        return self._at[heard.source, receiver, heard.channel]

    def held(self, link: int) -> Indices:
        """Returns the registers of the message of a link that is in use at its receiver."""
        return self._held[link]

    def commanded(self) -> Indices:
        """Returns the registers of all that goes down the tree: references, commands and torques, on their way and in use."""
        down = (Channel.REFERENCE, Channel.COMMAND, Channel.TORQUE)
        wires = [place for (_, channel), wire in self._wires.items() if channel in down for place in wire.places]
        held = [self._held[at] for (_, _, channel), at in self._at.items() if channel in down]
        return np.concatenate([*wires, *held])

    @property
    def oldest(self) -> int:
        """After how many hyperperiods a message has gone up the whole tree at the latest."""
        longest = max(-(wire.first // wire.per_hyperperiod) for wire in self._wires.values())
        return (1 + longest) * (1 + max(node.depth for node in self.plan.nodes))

    def acts(
        self, pairs: Sequence[tuple[Role, LinearStage]], time_ns: int, *, wait_ns: int = 0, came: bool = False
    ) -> list[Step]:
        """Returns the steps of stages of one level that are due at an instant, with what has come `wait_ns` later.  `came`: as
        far as all messages come."""
        now_ns = time_ns + wait_ns
        takings = [
            Taking(stage.timed.member, heard, now_ns - stage.timed.period_ns, now_ns)
            for _, stage in pairs
            for heard in stage.timed.inputs
        ]
        return [*self.take(takings, came=came), self.run(pairs, time_ns)]

    def run(self, pairs: Sequence[tuple[Role, LinearStage]], time_ns: int) -> Linear:
        """Returns the step of stages of one level that are due at an instant, with the messages in use."""
        return self._linear([block for role, stage in pairs for block in self._blocks(role, stage, time_ns)])

    def move(self, robots: Iterable[int], span_ns: int) -> Linear:
        """Returns the motion of robots for a while, under the commands in use."""
        T, blocks = span_ns * 1e-9, []
        for number in robots:
            own, mine = self.memory(number), self._command(number)
            unit = np.eye(len(MOTION) + 2)
            blocks.append((own, np.r_[own, mine], moved(unit[: len(MOTION)], unit[len(MOTION) :], T)))
        return self._linear(blocks)

    def take(self, takings: Sequence[Taking], *, came: bool = False, certain: bool = False) -> list[Step]:
        """Returns the steps in which receivers take the messages that have come, the older ones first.

        `came`: as far as all messages come, with the probability of that; `certain`: no message is lost."""
        before: list[Block] = []
        free: list[Block] = []
        jumps: list[Step] = []
        ranks: list[list[tuple[int, Indices, Indices]]] = []
        for taking in takings:
            at = self.link(taking.receiver, taking.heard)
            link, wire = self.plan.links[at], self._wires[taking.heard.source, taking.heard.channel]
            if at in self._chained and varies(link):
                number = taking.now_ns // link.period_ns
                jumps.append(
                    Jump(self._held[at], tuple(wire.of(number - age) for age in range(oldest(link) + 1)), came)
                )
                continue
            numbers = range(_newest(link, taking.since_ns) + 1, _newest(link, taking.now_ns) + 1)
            if not certain and (at in self._lossy or at in self._chained):
                for rank, number in enumerate(numbers):
                    if rank == len(ranks):
                        ranks.append([])
                    taken = self._policies.taken(at, self._held[at], wire.of(number))
                    before += taken.before
                    ranks[rank].append((at, taken.dest, taken.source))
            elif numbers:
                taken = self._policies.taken(at, self._held[at], wire.of(numbers[-1]))
                before += taken.before
                free.append((taken.dest, taken.source, np.eye(len(taken.dest))))
        steps: list[Step] = [self._linear(blocks) for blocks in (before, free) if blocks]
        steps += jumps
        for drawn in ranks:
            steps += self._drawn(drawn, came=came)
        return steps

    def shift(self) -> Linear:
        """Returns the step by which messages on their way become those of the hyperperiod before."""
        blocks: list[Block] = []
        for wire in self._wires.values():
            for number in range(wire.first, 0):
                to, source = wire.of(number), wire.of(number + wire.per_hyperperiod)
                blocks.append((to, source, np.eye(len(to))))
        return self._linear(blocks)

    def _drawn(self, drawn: Sequence[tuple[int, Indices, Indices]], *, came: bool) -> list[Step]:
        """Returns the steps in which links, each by its place, lose a message or not; with each the registers that change if it
        comes, and those whose values they take."""
        steps: list[Step] = []
        chained = [(dest, source) for at, dest, source in drawn if at in self._chained]
        if chained:
            dests, sources = (np.concatenate(each) for each in zip(*chained, strict=True))
            steps.append(Jump(dests, (sources,), came))
        draws: dict[tuple[int, Channel] | int, int] = {}
        kinds: list[int] = []
        rows: list[tuple[Indices, Indices, Indices]] = []
        for at, dest, source in drawn:
            if at in self._chained:
                continue
            link = self.plan.links[at]
            draw = draws.setdefault((link.source, link.channel) if link.loss_of_message else at, len(draws))
            if draw == len(kinds):
                kinds.append(at)
            rows.append((dest, source, np.full(len(source), draw)))
        if rows:
            dests, sources, draw_of = (np.concatenate(each) for each in zip(*rows, strict=True))
            steps.append(Choice.of(dests, sources, draw_of, np.array(kinds), came=came))
        return steps

    def _keep(self, role: Role) -> dict[str, Indices]:
        """Allocates the registers of what a role keeps."""
        if isinstance(role, LinearRobot):
            return {"memory": self._new(role.powers)}
        index = role.stages[0].timed.member
        state = powers_of(self.plan, index, Channel.GROUP_STATE)
        return {
            "memory": self._new(role.powers),
            "s": self._new(MOTION * (len(role.s) // 4)),
            "state": self._new(state),
        }

    def _add_link(self, role: Role, stage: LinearStage, heard: Input) -> None:
        """Allocates the registers of a link."""
        receiver = stage.timed.member
        at = next(
            at
            for at, link in enumerate(self.plan.links)
            if (link.source, link.receiver, link.channel) == (heard.source, receiver, heard.channel)
        )
        link, powers = self.plan.links[at], powers_of(self.plan, heard.source, heard.channel)
        powers += self._policies.further(heard.source, heard.channel)
        self._at[heard.source, receiver, heard.channel] = at
        self._held[at] = self._new(powers)
        self._policies.add(at, powers, self._new)
        wire = self._wires.setdefault((heard.source, heard.channel), _Wire(self.plan.root.period_ns // link.period_ns))
        first = -oldest(link) if varies(link) else _newest(link, -stage.timed.period_ns) + 1
        while wire.first > min(0, first) or not wire.places:
            wire.add(self._new, powers)

    def _new(self, powers: Sequence[int]) -> Indices:
        """Allocates registers for numbers with these powers of 1/s in their units."""
        self._units += [self._H**power for power in powers]
        self.count += len(powers)
        return np.arange(self.count - len(powers), self.count)

    def _blocks(self, role: Role, stage: LinearStage, time_ns: int) -> list[Block]:
        """Returns the matrix of a stage, from unit vectors of all that it uses."""
        kept = self._kept[self.roles.index(role)]
        heard = [self._held[self.link(stage.timed.member, each)] for each in stage.timed.inputs]
        columns = np.concatenate([*kept.values(), *heard])
        unit = np.eye(len(columns))
        ends = np.cumsum([len(each) for each in (*kept.values(), *heard)])
        parts = np.split(unit, ends[:-1])
        for name, part in zip(kept, parts, strict=False):
            setattr(role, name, part)
        said = stage.run([(0, parts[len(kept) :])])
        blocks = [(kept[name], columns, np.asarray(getattr(role, name))) for name in kept]
        for channel, period_ns in stage.timed.says:
            wire = self._wires.get((stage.timed.member, channel))
            if wire is not None and time_ns % period_ns == 0:
                message, values = wire.of(time_ns // period_ns), said[channel]
                blocks.append((message[: len(values)], columns, values))
                if len(message) > len(values):  # a robot's acceleration, for the policy `extrapolate`
                    blocks.append((message[len(values) :], self._command(stage.timed.member), np.eye(2)))
        if stage.timed.turn is Turn.STEER:
            blocks += self._policies.noted(stage.timed.member, next(iter(said.values())), columns)
        return blocks

    def _command(self, number: int) -> Indices:
        """Returns the registers of the acceleration that is commanded to a robot."""
        robot = self.plan.robots[number]
        command = self._held[self._at[robot.parent, number, Channel.COMMAND]]
        return command[2 * robot.child_number : 2 * robot.child_number + 2]

    def _linear(self, blocks: Sequence[Block]) -> Linear:
        """Returns the step that sets the rows of blocks, and leaves the other registers as they are."""
        same = np.ones(self.count, dtype=bool)
        found: list[tuple[Indices, Indices, Array]] = []
        units = self.units
        for rows, columns, values in blocks:
            same[rows] = False
            scaled = units[rows][:, None] * values / units[columns]
            one, two = scaled.nonzero()
            found.append((rows[one], columns[two], scaled[one, two]))
        kept = np.flatnonzero(same)
        found.append((kept, kept, np.ones(len(kept))))
        rows, columns, values = (np.concatenate(each) for each in zip(*found, strict=True))
        return Linear(csr_array(coo_array((values, (rows, columns)), (self.count, self.count))))


class _Wire:
    """The messages of one source on one channel, by number; number 0 is the first one of the hyperperiod."""

    def __init__(self, per_hyperperiod: int) -> None:
        self.per_hyperperiod = per_hyperperiod
        self.first = per_hyperperiod
        self.places: list[Indices] = []

    def add(self, new: Callable[[Sequence[int]], Indices], powers: Sequence[int]) -> None:
        """Allocates the registers of the message before `first`."""
        self.places.append(new(powers))
        self.first -= 1

    def of(self, number: int) -> Indices:
        """Returns the registers of a message."""
        return self.places[self.per_hyperperiod - 1 - number]


def _newest(link: LinkPlan, time_ns: int) -> int:
    """Returns the number of the newest message that may have come by an instant."""
    return (time_ns - link.delay_min_ns) // link.period_ns
