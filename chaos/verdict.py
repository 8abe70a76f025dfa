"""What a checker says, and what all its rules need to know of a run."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Final

from chaos.evidence import PERIOD_NS, WATCHDOG_NS, Done, Evidence
from chaos.frames import COMMAND_ID, FEEDBACK_ID, Command, Frame, command, feedback
from chaos.plans import TRAFFIC, group_names, robot_names

MARGIN_NS: Final = 30_000_000
"""Room for the harness itself, which sends a signal some milliseconds before or after it notes the time [ns]"""
DEADLY: Final = ("TERM", "HUP")
"""Signals that end a process of a run.  SIGINT reaches all processes of a terminal, so only the supervisor heeds it"""


@dataclass(frozen=True, slots=True)
class Violation:
    """A promise that a run did not keep."""

    rule: str
    text: str

    def __str__(self) -> str:
        return f"{self.rule}: {self.text}"


@dataclass(frozen=True, slots=True)
class Report:
    """The mean torques of both wheels that drives gave at some time between two instants [ns since 1970], in bits."""

    since_ns: int
    time_ns: int
    torques: tuple[int, int]


@dataclass(frozen=True)
class Case:
    """The evidence of a run, and what follows from it."""

    evidence: Evidence

    @cached_property
    def forgers(self) -> frozenset[int]:
        """The ports that attacks sent from."""
        return frozenset(done.port for done in self.evidence.done if done.port)

    @cached_property
    def owned(self) -> list[Frame]:
        """The frames that were heard from processes of the run."""
        return [frame for frame in self.evidence.heard.frames if frame.sender[1] not in self.forgers]

    @cached_property
    def forged(self) -> list[Frame]:
        """The frames of others that were heard under the run's own identifiers."""
        bases = (COMMAND_ID, FEEDBACK_ID)
        own = {base + number for base in bases for number in range(len(self.robots))}
        return [one for one in self.evidence.heard.frames if one.sender[1] in self.forgers and one.can_id in own]

    @cached_property
    def commands(self) -> dict[str, list[tuple[int, Command]]]:
        """By robot, the torque commands of the bridge with their times [ns since 1970]."""
        found: dict[str, list[tuple[int, Command]]] = {robot: [] for robot in self.robots}
        for frame in self.owned:
            if 0 <= (number := frame.can_id - COMMAND_ID) < len(self.robots) and (told := command(frame)):
                found[self.robots[number]].append((frame.time_ns, told))
        return found

    @cached_property
    def reports(self) -> dict[str, list[Report]]:
        """By robot, the torques that its drives reported."""
        found: dict[str, list[Report]] = {robot: [] for robot in self.robots}
        for frame in self.owned:
            if 0 <= (number := frame.can_id - FEEDBACK_ID) < len(self.robots) and (told := feedback(frame)):
                before = found[self.robots[number]]
                since_ns = frame.time_ns - PERIOD_NS
                if before:  # reports that come at once are late; each may be of any time since those before
                    last = before[-1]
                    at_once = frame.time_ns - last.time_ns < PERIOD_NS // 2
                    since_ns = last.since_ns if at_once else last.time_ns
                before.append(Report(since_ns, frame.time_ns, told))
        return found

    @property
    def robots(self) -> tuple[str, ...]:
        """The names of the robots."""
        return robot_names(self.evidence.plan.robots)

    @property
    def closed(self) -> bool:
        """True: the torque path is closed."""
        return self.evidence.plan.path == "closed"

    @property
    def wall(self) -> bool:
        """True: the run is on a wall clock."""
        return self.evidence.plan.clock == "wall"

    @cached_property
    def run_ns(self) -> tuple[int, int] | None:
        """When torque was first heard, and when the run time is over then on a wall clock [ns since 1970]; None if never."""
        first = min(
            (time_ns for heard in self.commands.values() for time_ns, told in heard if told.moves), default=None
        )
        return None if first is None else (first, first + round(self.evidence.plan.duration_s * 1e9))

    @property
    def passed(self) -> bool:
        """True: exit code or summary call the run a good one."""
        return self.evidence.code == 0 or self.word in ("HOLDS", "HEALTHY")

    @property
    def word(self) -> str:
        """The word of the verdict; "" without a summary."""
        return "" if self.evidence.summary is None else str(self.evidence.summary["verdict"]["word"])

    @property
    def complete(self) -> bool:
        """True: the listener heard everything that was on the bus."""
        return self.evidence.heard.missed == 0

    def driven_by(self, target: str) -> tuple[str, ...]:
        """Returns the robots whose torque comes from a process, or over it, so that it ends when the process is silent.

        On a wall clock a robot on the mirrored path follows its last acceleration for ever: that is the policy `hold`."""
        if target in ("supervisor", "group", "bridge", "drives") or (target != "recorder" and not self.wall):
            return self.robots
        if target in self.robots:
            return (target,)
        if not self.closed:
            return ()
        if target in group_names(self.evidence.plan.robots):
            return tuple(robot for robot in self.robots if robot.startswith(f"{target}/"))
        return self.robots if target == "coordinator" else ()

    def silences(self) -> Iterator[tuple[Done, int, int]]:
        """Yields the hits that silence a process, with the beginning and the end of its silence [ns since 1970]."""
        never_ns = self.evidence.ended_ns + 10_000_000_000
        for done in self.evidence.done:
            hit = done.hit
            if hit.kind == "freeze":
                yield done, done.begun_ns, done.ended_ns or never_ns
            elif hit.kind == "kill" or (hit.kind == "signal" and self.heeds(done)):
                yield done, done.begun_ns, never_ns

    def heeds(self, done: Done) -> bool:
        """Returns whether a signal ends its target: members leave SIGINT to the supervisor."""
        return done.hit.signal in DEADLY or done.hit.target in ("supervisor", "group")

    def mattered(self, done: Done) -> str:
        """Returns in words why a run that was hit so is no good one; "" if it may be."""
        hit, run_ns = done.hit, self.run_ns
        if hit.kind in TRAFFIC or hit.kind in ("full_disk", "no_reader"):
            return ""
        over_ns = self.evidence.ended_ns if run_ns is None or not self.wall else run_ns[1]
        if done.begun_ns > over_ns - MARGIN_NS:
            return ""  # it came after the last instant of the run
        if hit.kind == "kill":
            return f"{hit.target} was killed"
        if hit.kind == "signal":
            return f"SIG{hit.signal} reached {hit.target}" if self.heeds(done) else ""
        if hit.target == "supervisor" or (hit.target == "recorder" and done.ended_ns is not None):
            return "" if done.ended_ns is not None else "the supervisor was frozen for ever"
        if done.ended_ns is None:
            return f"{hit.target} was frozen for ever"
        if not self.wall:
            return ""  # virtual time waits
        begun_ns = max(done.begun_ns, run_ns[0]) if run_ns else done.begun_ns
        lasted_ns = min(done.ended_ns, over_ns) - begun_ns
        too_long = lasted_ns > WATCHDOG_NS + PERIOD_NS + MARGIN_NS
        return f"{hit.target} was frozen for {lasted_ns / 1e9:.2f} s, beyond the watchdog" if too_long else ""

    def slack_ns(self, begun_ns: int) -> int:
        """Returns what a busy machine adds to a deadline after an instant: the longest delay of a process around it [ns]."""
        return self.evidence.heard.lateness_ns(begun_ns - MARGIN_NS, begun_ns + WATCHDOG_NS + PERIOD_NS) + MARGIN_NS


def names(name: str, text: str) -> bool:
    """Returns whether a text names a process: `north` is not named by `north/n1`."""
    return re.search(rf"(?<![\w/]){re.escape(name)}(?![\w/])", text) is not None
