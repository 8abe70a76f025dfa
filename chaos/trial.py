"""A trial: a plan is carried out on a run of the command line, and what the run leaves behind is gathered.

The command gets a session, a mark in its environment, a folder for temporary files and a multicast port of its own.  Plans
that need another host, or a small disk, are carried out in namespaces of their own (`room`).
"""

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from chaos import listener, victims
from chaos.attacks import Attack, words
from chaos.evidence import Done, Evidence, read_can_log, read_recording, read_summary
from chaos.frames import command
from chaos.plans import FOREVER, TRAFFIC, ChaosPlan, Hit
from chaos.room import HOST, INSIDE, enter_other
from chaos.subject import GROUP, free_port, listening, scenario, start

STANDING: Final = ("full_disk", "no_reader")
"""Kinds of hits that are there from the start"""
START_S: Final = 60.0
"""How long a run may take until its first torque [s]"""
END_S: Final = 90.0
"""How long a run may take after the last hit ended and its run time is over [s]"""
UNENDING_S: Final = 8.0
"""When a supervisor that is frozen for ever is killed, as its user would do in the end [s]"""
ORPHANS_S: Final = 5.0
"""How long processes may outlive the command [s]"""


@dataclass(slots=True)
class _Run:
    """The command while it runs, and what was done to it so far."""

    plan: ChaosPlan
    process: "subprocess.Popen[bytes]"
    token: str
    folder: Path
    port: int
    done: list[Done]
    attacks: "list[tuple[subprocess.Popen[str], int]]"
    """Attacks that go on, with the places of their hits in `done`"""
    waiting: "dict[Hit, subprocess.Popen[str]]" = field(default_factory=dict)
    """Processes of attacks that have not begun"""
    frozen: dict[int, int] = field(default_factory=dict)
    """Processes that stand still, by the places of their hits in `done`"""

    def hit(self, hit: Hit) -> None:
        """Carries out a hit; nothing happens if the target is not there (any more)."""
        if hit.kind in ("kill", "freeze", "signal"):
            number = {"kill": signal.SIGKILL, "freeze": signal.SIGSTOP}.get(hit.kind) or signal.Signals[
                f"SIG{hit.signal}"
            ]
            target = self._target(hit.target)
            if target is not None and self._send(target, number):
                self.done.append(Done(hit, time.time_ns(), None))
                if hit.kind == "freeze":
                    self.frozen[len(self.done) - 1] = target
        elif hit.kind not in STANDING:
            self._attack(hit)

    def _target(self, name: str) -> int | None:
        """Returns the process with a name, or minus the process group; None if it is gone."""
        if self.process.poll() is not None:
            return None
        if name in ("supervisor", "group"):
            return self.process.pid if name == "supervisor" else -self.process.pid
        return victims.find(name, self.token)

    @staticmethod
    def _send(target: int, number: signal.Signals) -> bool:
        """Sends a signal; returns whether there was somebody to take it."""
        try:
            os.kill(target, number)
        except ProcessLookupError:
            return False
        return True

    def prepare(self) -> None:
        """Starts the processes of all attacks; they wait for their time."""
        for hit in self.plan.hits:
            if hit.kind in TRAFFIC and (hit.origin == "here" or INSIDE in os.environ):
                command_line = [*(enter_other() if hit.origin == "elsewhere" else []), *words(hit.kind)]
                pipe = subprocess.PIPE
                self.waiting[hit] = subprocess.Popen(command_line, stdin=pipe, stdout=pipe, text=True)

    def _attack(self, hit: Hit) -> None:
        """Lets an attack begin; nothing happens if there is no other host for it to come from, or no secret for it to use."""
        if hit not in self.waiting:
            return
        elsewhere = hit.origin == "elsewhere"
        try:
            ticket: dict[str, Any] = json.loads((self.folder / "run" / "observe.json").read_text())
        except (OSError, ValueError):
            ticket = {}
        if hit.secret == "observer" and not ticket:
            return
        attack = Attack(
            hit.kind,
            self.plan.seed,
            hit.lasts_s,
            GROUP,
            self.port,
            self.plan.robots,
            host=HOST if elsewhere else "127.0.0.1",
            hops=4 if elsewhere else 0,
            endpoints=victims.listening(victims.marked(self.token)) if hit.kind.endswith("_zenoh") else [],
            ticket=ticket,
            secret=hit.secret == "observer",
        )
        process = self.waiting.pop(hit)
        assert process.stdout is not None
        assert process.stdin is not None
        port = int(process.stdout.readline() or 0)
        self.done.append(Done(hit, time.time_ns(), None, port))
        process.stdin.write(attack.line())
        process.stdin.close()
        self.attacks.append((process, len(self.done) - 1))

    def look_after(self) -> None:
        """Notes the end of attacks that are over, and of processes that were frozen for long enough."""
        for process, index in list(self.attacks):
            if process.poll() is not None:
                self.done[index] = replace(self.done[index], ended_ns=time.time_ns())
                self.attacks.remove((process, index))
        for index, target in list(self.frozen.items()):
            done, now_ns = self.done[index], time.time_ns()
            if now_ns - done.begun_ns > done.hit.lasts_s * 1e9:
                del self.frozen[index]
                if self._send(target, signal.SIGCONT):  # it may speak before this process goes on
                    self.done[index] = replace(done, ended_ns=now_ns)


def carry_out(plan: ChaosPlan, folder: Path, reference: Path | None) -> Evidence:
    """Carries out a plan in a new folder and returns what came of it.

    `reference` is the recording of the same run in one process, with nothing done to it; None on a wall clock."""
    run_folder, temporary = folder / "run", folder / "tmp"
    temporary.mkdir(parents=True)
    (folder / "scenario.toml").write_text(scenario(plan))
    shared = victims.shared_memory()
    port, token = free_port(), f"{os.getpid()}-{plan.seed}-{time.time_ns()}"
    with listening(port, folder / "heard.txt"):
        begun_ns = time.time_ns()
        process = start(plan, folder, run_folder, temporary, port, token)
        run = _Run(plan, process, token, folder, port, [], [])
        try:
            run.prepare()
            for hit in plan.hits:
                if hit.kind in STANDING:
                    run.done.append(Done(hit, begun_ns, None))
            code = _watch(run, folder / "heard.txt", begun_ns)
        except BaseException:  # the user ends the trial: frozen processes would stay for ever
            victims.kill(victims.marked(token))
            raise
        ended_ns = time.time_ns()
        left = _left_behind(token, temporary, shared)
        time.sleep(0.1)  # for datagrams on their way
    summary = read_summary(run_folder / "summary.json")
    whole = read_recording(run_folder / "run.mcap")
    recovered = None
    if whole is not None and not whole.whole:
        subprocess.run(
            [sys.executable, "-m", "echelon", "recover", str(run_folder)],
            stdout=(folder / "recover.txt").open("wb"),
            stderr=subprocess.STDOUT,
            timeout=120,
            check=False,
        )
        recovered = read_recording(run_folder / "run.mcap")
    unharmed = None if reference is None else read_recording(reference)
    return Evidence(
        plan,
        run.done,
        begun_ns,
        ended_ns,
        code,
        (folder / "stdout.txt").read_text(errors="replace") if (folder / "stdout.txt").exists() else "",
        (folder / "stderr.txt").read_text(errors="replace"),
        listener.read(folder / "heard.txt"),
        read_can_log(run_folder / "can.log"),
        whole,
        recovered,
        summary,
        unharmed.states if unharmed else None,
        left,
    )


def _watch(run: _Run, heard: Path, begun_ns: int) -> int | None:
    """Hits the run as its plan says until the command has ended; returns its exit code, None if it had to be ended."""
    hits = [hit for hit in run.plan.hits if hit.kind not in STANDING]
    torque_ns: int | None = None
    with heard.open(encoding="ascii") as lines:
        rest = ""
        while run.process.poll() is None:
            now_ns = time.time_ns()
            if torque_ns is None:
                rest += lines.read()
                *whole, rest = rest.split("\n")
                torque_ns = _first_torque(whole)
            since_start_s = (now_ns - begun_ns) / 1e9
            since_torque_s = -1.0 if torque_ns is None else (now_ns - torque_ns) / 1e9
            for hit in list(hits):
                if since_torque_s >= hit.at_s >= 0 or (hit.at_s < 0 and since_start_s >= -hit.at_s):
                    run.hit(hit)
                    hits.remove(hit)
            run.look_after()
            _give_up(run, begun_ns if torque_ns is None else torque_ns, now_ns)
            if since_start_s > START_S + END_S:
                run.process.kill()
                run.process.wait()
                return None
            time.sleep(0.002)
    for process in (*run.waiting.values(), *(attack for attack, _ in run.attacks)):
        process.kill()
        process.wait()
    run.look_after()
    return run.process.returncode


def _give_up(run: _Run, torque_ns: int, now_ns: int) -> None:
    """Kills a supervisor that is frozen for ever, as its user does in the end."""
    if now_ns - torque_ns < (run.plan.duration_s + UNENDING_S) * 1e9:
        return
    for done in run.done:
        if done.hit.target in ("supervisor", "group") and done.hit.lasts_s == FOREVER and done.ended_ns is None:
            kill = Hit("kill", done.hit.at_s, "supervisor")
            if all(other.hit != kill for other in run.done):
                run.hit(kill)


def _first_torque(lines: list[str]) -> int | None:
    """Returns when the first frame with torque was heard [ns since 1970]."""
    heard = listener.Heard()
    for line in lines:
        heard.add(line)
    for frame in heard.frames:
        if (told := command(frame)) is not None and told.moves:
            return frame.time_ns
    return None


def _left_behind(token: str, temporary: Path, shared: frozenset[str]) -> list[str]:
    """Waits for what belongs to a run to go, and returns in words what has not."""
    deadline_s = time.monotonic() + ORPHANS_S
    while (left := victims.marked(token)) and time.monotonic() < deadline_s:
        time.sleep(0.05)
    found = [f"process {victims.described(pid)}" for pid in left]
    victims.kill(left)
    found += [f"temporary {path.relative_to(temporary)}" for path in sorted(temporary.rglob("*"))]
    new = victims.shared_memory() - shared
    found += [f"shared memory {name}" for name in sorted(new - victims.in_use(new))]
    return found
