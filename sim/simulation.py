"""A run in one process that is stepped from instant to instant; in between its states can be read and its commands changed."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

import numpy as np

from echelon.errors import UserError
from echelon.messages import STATE_FIELDS, Channel, Heard, Message
from echelon.plan.layout import acceleration_of
from echelon.plan.plan import NodePlan
from echelon.runtime.mailbox import Act
from echelon.runtime.turns import Turn
from echelon.sim.engines.in_process import Engine, Row
from echelon.sim.finished_run import Records, Run
from echelon.sim.notebook import AnyScenario, load
from echelon.sim.results.block_series import block_series
from echelon.sim.results.records import RunFacts
from echelon.sim.results.summary import summarise
from echelon.sim.results.trace import Array, TraceBuilder

_STATE: Final = np.dtype([("robot", "U64"), *((name, "f8") for name in STATE_FIELDS)])


class Simulation:
    """A run in one process that goes on only when `step` or `run_until` is called.

        simulation = echelon.Simulation("lab")
        while not simulation.done:
            simulation.commands[0] = 0.1, 0.0        # [m/s²], replaces the command of the robot's leader
            simulation.step()

    Between two steps it stands at an instant `t` at which robots have said their states and leaders have said what
    accelerations they want, and no robot has acted on them yet.  What `commands` holds then is what the robots do.  A command
    that arrives before the next instant replaces it, unless you have changed it.

    Raises UserError for a scenario or changes that are wrong (`echelon.planning.loading`), and in each call if a part of
    yours fails.
    """

    def __init__(self, scenario: AnyScenario, changes: Mapping[str, Any] | None = None) -> None:
        self.plan = load(scenario, changes).plan
        self.reset()

    def reset(self) -> None:
        """Goes back to run time 0.  If the torque path is closed, the drives are brought up on the way."""
        self._trace = TraceBuilder(self.plan)
        self._last: dict[int, Array] = {}
        self._engine = Engine(self.plan, self._note)
        self._time_ns = self._engine.first_ns
        self._heard: dict[int, Heard] = {}
        self._later: dict[int, list[Act]] = {}
        """What robots hear within the period that begins at this instant"""
        self.done = False
        """True when the scenario's duration is over"""
        self.commands: Array = np.full((len(self.plan.robots), 2), np.nan)
        """Accelerations (x, y) on which the robots are about to act, (robots, 2) [m/s²]; NaN for a robot without a command.
        Values may be overwritten.  They hold for robots whose period begins at this instant; when the next period of a robot
        begins, it gets its leader's command again"""
        self._moves = self._run()
        next(self._moves)

    @property
    def t(self) -> float:
        """Run time [s]."""
        return self._time_ns / 1e9

    @property
    def states(self) -> Records:
        """The last state of each robot, one record each: its name `robot` and the fields of `echelon.messages.STATE_FIELDS`."""
        table = np.zeros(len(self.plan.robots), dtype=_STATE)
        table["robot"] = [robot.name for robot in self.plan.robots]
        for index, values in self._last.items():
            for number, name in enumerate(STATE_FIELDS):
                table[name][index] = values[number]
        return table

    def step(self) -> float:
        """Lets the robots act on `commands` and goes on to the next instant; returns its run time [s].

        Raises UserError when the run is over (`done`)."""
        if self.done:
            raise UserError(f"the simulation is over at {self.t:g} s; reset() begins anew")
        next(self._moves)
        return self.t

    def run_until(self, t: float) -> float:
        """Steps until run time `t` [s] or the end, whichever comes first; returns the run time [s]."""
        while not self.done and self.t < t:
            self.step()
        return self.t

    def result(self) -> Run:
        """Returns the run so far, as `echelon.run` returns a run.  It has no folder."""
        trace = self._trace.build()
        facts = RunFacts("inprocess", "virtual", 0.0, 0.0, None, None, self._engine.messages, None)
        return Run(trace, summarise(trace, self._engine.link_counts(), None, facts))

    @property
    def errors(self) -> dict[str, float]:
        """Norm of each block's error [m], by the block's name, in the robots' last states."""
        builder = TraceBuilder(self.plan)
        for index, values in sorted(self._last.items()):
            builder.add(Message(Channel.STATE, index, 0, self._time_ns, values))
        return {series.block.name: float(series.norm[-1]) for series in block_series(builder.build()).series}

    def _note(self, message: Message) -> None:
        if message.channel is Channel.STATE:
            self._last[message.source] = message.values
        self._trace.add(message)

    def _run(self) -> Iterator[None]:
        """Runs the whole plan; pauses at each instant from run time 0 on, before the robots act."""
        engine = self._engine
        before = [row for row in engine.timetable if row.turn.value < Turn.ACT.value]
        after = [row for row in engine.timetable if row.turn.value >= Turn.ACT.value]
        for time_ns in range(engine.first_ns, self.plan.duration_ns + 1, engine.tick_ns):
            self._time_ns = time_ns
            self._take_turns(before, time_ns)
            if time_ns >= 0:
                self._hear(time_ns)
                self.done = time_ns == self.plan.duration_ns
                yield
            self._take_turns(after, time_ns)

    def _take_turns(self, rows: Sequence[Row], time_ns: int) -> None:
        for row in rows:
            if row.is_due(time_ns):
                for role, number, run, mailbox in row.stages:
                    if row.turn is not Turn.ACT:
                        self._engine.act(time_ns, number, run, mailbox)
                        continue
                    for message in run(time_ns, self._meddled(role, time_ns)):
                        self._engine.post(message)
                    for at_ns, heard in self._later.pop(role, ()):
                        for message in run(at_ns, heard) if self._is_own(role) else ():
                            self._engine.post(message)

    def _hear(self, time_ns: int) -> None:
        """Takes what robots that act at this instant hear, so that it can be read and overwritten."""
        for row in self._engine.timetable:
            if row.turn is Turn.ACT and row.is_due(time_ns):
                for role, number, _, mailbox in row.stages:
                    (_, (command,)), *later = mailbox.acts(number, time_ns)
                    self._heard[role], self._later[role] = command, later
                    self.commands[role] = self._wanted(role)

    def _wanted(self, robot: int) -> Array:
        """Returns the acceleration that a robot's leader wants at this instant, (2,); NaN if there is no command."""
        command = self._heard.get(robot)
        return np.full(2, np.nan) if command is None else command.values[acceleration_of(self.plan.robots[robot])]

    def _is_own(self, robot: int) -> bool:
        """Returns whether `commands` still holds for a robot what its leader wants."""
        return np.array_equal(self.commands[robot], self._wanted(robot), equal_nan=True)

    def _meddled(self, robot: int, time_ns: int) -> list[Heard]:
        """Returns what a robot hears, with the acceleration that `commands` holds for it."""
        plan, command, wanted = self.plan.robots[robot], self._heard.get(robot), self.commands[robot]
        if not np.isfinite(wanted).all():
            return [None]
        if command is None:  # nothing was said, or it was too old: somebody else speaks in the leader's place
            node = self.plan.formation[plan.parent]
            assert isinstance(node, NodePlan)
            command = Message(Channel.COMMAND, node.index, -1, time_ns, np.zeros(2 * len(node.children)))
        values = command.values.copy()
        values[acceleration_of(plan)] = wanted
        return [command._replace(values=values)]
