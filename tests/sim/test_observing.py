"""A run that is open to observers: they read all of it, never write, and never hold it up."""

import json
import os
import re
import stat
import sys
import tempfile
import time
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path
from subprocess import PIPE, Popen

import numpy as np
import pytest

from echelon.errors import UsageError
from echelon.messages import Channel, Message
from echelon.runtime.admission import Refusals
from echelon.runtime.credentials import Identity, new_identity
from echelon.runtime.wire import data_key, encode, join, watch_key
from echelon.sim.observing import TICKET, Ticket, new_gate, observe
from echelon.sim.processes.outcome import Progress
from echelon.sim.processes.supervisor import Supervisor
from support.plain_zenoh import plain_session
from support.runs import echelon, plan_of, start_echelon, summary_of, trace_of, until

QUICK = ("--can", "none", "--no-report", "--quiet")
WALL = ("--clock", "wall", "--observe", *QUICK)


def opened(folder: Path) -> bool:
    """Returns whether a run has written its ticket."""
    return until(lambda: (folder / TICKET).exists())


def test_an_observer_reads_a_run_until_it_ends(tmp_path: Path) -> None:
    for duration in (4.0, 20.0, 100.0):  # on a busy machine a run may be over before the observer has started
        folder = tmp_path / f"run-{duration:g}"
        command = start_echelon("run", "lab", "--set", f"duration={duration}", *WALL, "--out", folder)
        assert opened(folder)
        assert stat.S_IMODE((folder / TICKET).stat().st_mode) == 0o600
        ticket = Ticket.read(folder)
        done = echelon("observe", folder, "--under", "g2", "--channel", "state", "--json")
        _, said = command.communicate()
        if "does not answer" not in done.stderr:
            break
    told = f"echelon observe {folder} (address {ticket.endpoint}, read-only secret in {folder / TICKET})"
    assert f"open to observers: {told}" in said.splitlines()
    assert ticket.password not in said
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert done.returncode == 0, done.stderr
    assert {line["from"] for line in lines} == {"g2/r4", "g2/r5", "g2/r6"}
    assert {line["channel"] for line in lines} == {"state"}
    assert lines[-1]["t"] > duration - 0.1
    assert all(abs(line["values"]["x"]) < 10 for line in lines)
    again = echelon("observe", folder)
    assert (again.returncode, again.stdout) == (2, "")
    assert "does not answer" in again.stderr


FROZEN = """
import os, signal, sys
from pathlib import Path
from echelon.sim.observing import Ticket, observe
from support.runs import plan_of
for message in observe(Ticket.read(Path(sys.argv[1])), plan_of("lab", "duration=15.0")):
    print(message.time_ns, flush=True)
    os.kill(os.getpid(), signal.SIGSTOP)
"""


def secrets_of(supervisor: Supervisor) -> set[str]:
    """Returns all passwords of a run."""
    credentials = [spec.credentials for spec in supervisor._specs]
    credentials += [spec.gate.credentials for spec in supervisor._specs if spec.gate is not None]
    return {who.password for each in credentials for who in (each.own, *each.guests, *each.hosts)}


def readable(secrets: set[str], folder: Path, since_s: float) -> dict[str, set[str]]:
    """Returns which secrets stand in command lines and environments of processes, in a folder, and in files that are new since
    a time, in the folder for temporary files and in shared memory: by the name of the file."""
    places = [path for one in ("cmdline", "environ") for path in Path("/proc").glob(f"[0-9]*/{one}")]
    for root in (folder, Path(tempfile.gettempdir()), Path("/dev/shm")):
        places += [Path(inside) / name for inside, _, names in os.walk(root) for name in names]
    any_secret, found = re.compile("|".join(map(re.escape, sorted(secrets))).encode()), dict[str, set[str]]()
    for place in places:
        with suppress(OSError):  # it is gone, or another user's
            told = place.lstat()
            if stat.S_ISREG(told.st_mode) and (place.is_relative_to("/proc") or told.st_mtime >= since_s):
                with place.open("rb") as file:
                    if those := set(any_secret.findall(file.read(1 << 26))):
                        found[str(place)] = {each.decode() for each in those}
    return found


def test_a_run_ends_well_though_an_observer_stands_still(tmp_path: Path) -> None:
    """Nobody can read the secrets of its processes meanwhile.  That a session on a wall clock never waits for a receiver is
    tested in tests/runtime/test_session.py."""
    plan, begun_s = plan_of("lab", "duration=15.0"), time.time()
    supervisor = Supervisor(plan, tmp_path, run=f"observed-{os.getpid()}", virtual=True, observe=True)
    ticket, secrets = supervisor.ticket, secrets_of(supervisor)
    assert ticket is not None
    assert len(secrets) == len(supervisor._specs) + 2  # those of the gate and of its guest
    ticket.write(tmp_path)
    found: list[dict[str, set[str]]] = []

    def look(progress: Progress) -> None:
        """Looks for the secrets once, while all processes are there."""
        if progress.phase == "running" and not found:
            found.append(readable(secrets, tmp_path, begun_s - 1.0))
            assert (tmp_path / "run.mcap").exists()

    supervisor._show = look
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parents[1])}
    with Popen([sys.executable, "-c", FROZEN, str(tmp_path)], stdout=PIPE, text=True, env=environment) as frozen:
        try:
            outcome = supervisor.run()
            assert frozen.stdout is not None
            assert frozen.stdout.readline()  # it heard the run before it stood still
            assert frozen.poll() is None
        finally:
            frozen.kill()
    assert outcome.failure is None
    assert outcome.trace.digest() == trace_of(plan).digest()
    found.append(readable(secrets, tmp_path, begun_s - 1.0))
    assert found == [{str(tmp_path / TICKET): {ticket.password}}] * 2


@pytest.mark.parametrize("name", ["endpoint", "user", "zenoh_id", "password", "run"])
def test_a_ticket_with_values_of_other_types_is_one_line(name: str, tmp_path: Path) -> None:
    supervisor = Supervisor(plan_of("lab"), tmp_path, run="observed", virtual=True, observe=True)
    assert supervisor.ticket is not None
    (tmp_path / TICKET).write_text(json.dumps(asdict(supervisor.ticket) | {name: 5}))
    with pytest.raises(UsageError, match=f"{name}: must be text"):
        Ticket.read(tmp_path)


def test_a_ticket_is_of_no_use_for_writing(tmp_path: Path) -> None:
    """Neither at the process `observers` nor at any other.  The session is Zenoh's own, so that nothing in it holds back what
    it says."""
    plan = plan_of("lab", "duration=5.0")
    supervisor = Supervisor(plan, tmp_path, run=f"observed-{os.getpid()}", virtual=True, observe=True)
    ticket = supervisor.ticket
    assert ticket is not None
    endpoints = [ticket.endpoint, *(endpoint for spec in supervisor._specs for endpoint in spec.listen)]
    guest = Identity(ticket.user, new_identity("x", ()).zenoh_id, ticket.password, ())
    robot, run = plan.robots[0], ticket.run
    heard: set[str] = set()
    with plain_session(endpoints, guest) as session:
        session.declare_subscriber(f"echelon/{run}/**", lambda sample: heard.add(str(sample.key_expr)))
        said = 0

        def say(progress: Progress) -> None:
            """Forges the robot's next states, just ahead of the run."""
            nonlocal said
            now = progress.time_ns // robot.period_ns
            for number in range(now, now + 30):
                forged = Message(Channel.STATE, robot.index, number, number * robot.period_ns, np.full(16, 3.0))
                session.put(data_key(run, robot.path, Channel.STATE), encode(forged))
                session.put(watch_key(run, "robot", robot.name), join([encode(forged)]))
            said += 1

        supervisor._show = say
        outcome = supervisor.run()
    assert said > 3
    assert data_key(run, robot.path, Channel.STATE) in heard  # it was let in
    assert outcome.failure is None
    assert outcome.refusals() == ()
    assert outcome.trace.digest() == trace_of(plan).digest()


def test_what_observers_hear_is_what_was_recorded(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    command = start_echelon("run", "lab", "--set", "duration=2.0", *WALL, "--out", folder)
    assert opened(folder)
    refusals = Refusals()
    heard = list(observe(Ticket.read(folder), plan_of("lab", "duration=2.0"), "g1/r1", refusals))
    command.communicate()
    assert not refusals.total
    from echelon.sim.notebook import open_run

    recorded = open_run(folder).robots["g1/r1"]
    times = [message.time_ns / 1e9 for message in heard]
    assert len(times) > 10
    rows = np.searchsorted(recorded["t"], times)
    assert np.array_equal([message.values[0] for message in heard], recorded["x"][rows])
    assert summary_of(folder)["run"]["failure"] is None


@pytest.mark.parametrize(
    ("content", "why"),
    [(None, "holds no observe.json"), ("{", "cannot be read"), ('{"run": "x"}', "cannot be read")],
)
def test_tickets_that_cannot_be_used_are_said_to_be(tmp_path: Path, content: str | None, why: str) -> None:
    if content is not None:
        (tmp_path / TICKET).write_text(content)
    with pytest.raises(UsageError, match=why):
        Ticket.read(tmp_path)
    replace(new_gate("x").ticket, schema_version=0).write(tmp_path)
    with pytest.raises(UsageError, match="speaks schema version 0"):
        Ticket.read(tmp_path)


def test_a_run_in_one_process_cannot_be_observed(tmp_path: Path) -> None:
    done = echelon("run", "lab", "--observe", "--engine", "inprocess", "--out", tmp_path / "run")
    assert (done.returncode, done.stdout) == (2, "")
    assert "--observe: needs --engine processes" in done.stderr
