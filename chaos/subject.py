"""The run that a trial is about: its scenario, and its command with a listener beside it."""

import os
import resource
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

from chaos import listener, victims
from chaos.plans import ChaosPlan, Hit, robot_names
from chaos.room import INSIDE

GROUP: Final = "239.74.163.2"
STALL_S: Final = 4
"""`--stall-timeout` of runs in virtual time [s]"""
STARTS: Final = {
    "north": ((0.0, 1.5), (1.0, 1.5), (0.0, 2.5)),
    "south": ((0.0, -1.0), (1.2, -1.0)),
}


def scenario(plan: ChaosPlan) -> str:
    """Returns the scenario of a plan's run."""
    groups = []
    for group, name in zip(("triangle", "line"), ("north", "south"), strict=True):
        robots = [robot for robot in robot_names(plan.robots) if robot.startswith(name)]
        if robots:
            places = zip(robots, STARTS[name], strict=False)
            starts = "\n".join(f"robots.{robot.rpartition('/')[2]} = {{ start = {[*at]} }}" for robot, at in places)
            size = "side" if group == "triangle" else "spacing"
            shape = f'shape = {{ kind = "{group}", {size} = 1.0 }}\n' if len(robots) > 1 else ""
            groups.append(f"[formation.groups.{name}]\n{shape}{starts}\n")
    shape = '[formation]\nshape = { kind = "line", spacing = 3.0 }\n' if len(groups) > 1 else ""
    return f"""\
name = "chaos"
duration = {plan.duration_s}
[periods]
acceleration = 0.01
torque = 0.01
[robot]
mass = 4.0
inertia = 0.12
wheel_radius = 0.05
arm = 0.15
offset = 0.1
torque_limit = 1.5
drive = {{ recover_after = 0.3 }}
[law]
epsilon = [0.5, 0.5]
lead = 0.5
[trajectory]
kind = "circle"
radius = 1.5
rate = 0.6
[can]
path = "{plan.path}"
torque_scale = 0.001
{shape}{"".join(groups)}"""


def free_port() -> int:
    """Returns a port that nobody uses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port: int = probe.getsockname()[1]
    return port


@contextmanager
def listening(port: int, path: Path) -> Iterator[None]:
    """A context in which the listener notes what is on the bus."""
    listen = [sys.executable, "-m", "chaos.listener", GROUP, str(port), str(path)]
    with subprocess.Popen(listen, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        if process.stdout.readline() != listener.READY:
            raise RuntimeError("the listener does not listen")
        try:
            yield
        finally:
            process.terminate()


def start(
    plan: ChaosPlan, folder: Path, run_folder: Path, temporary: Path, port: int, token: str
) -> "subprocess.Popen[bytes]":
    """Starts the command."""
    command_line = [sys.executable, "-m", "echelon", "run", str(folder / "scenario.toml"), "--clock", plan.clock]
    command_line += ["--can", f"udp_multicast:{GROUP}:{port}", "--out", str(run_folder), "--quiet"]
    command_line += ["--stall-timeout", str(STALL_S)] if plan.clock == "virtual" else []
    command_line += ["--observe"] if plan.observed else []
    command_line += [] if plan.report else ["--no-report"]
    disk = next((hit.room for hit in plan.hits if hit.kind == "full_disk"), 0)
    output = next((hit for hit in plan.hits if hit.kind == "no_reader"), None)
    small = disk and INSIDE not in os.environ

    def prepare() -> None:
        for number in (
            signal.SIGINT,
            signal.SIGHUP,
            signal.SIGTERM,
        ):  # a shell in the background, or nohup, ignores some
            signal.signal(number, signal.SIG_DFL)
        if small:  # without a small disk: no file may grow beyond its size
            resource.setrlimit(resource.RLIMIT_FSIZE, (disk, disk))

    if disk and not small:
        run_folder.mkdir()
        subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={disk}", "none", str(run_folder)], check=True)
    environment = os.environ | {victims.MARK: token, "TMPDIR": str(temporary), "OPENBLAS_NUM_THREADS": "1"}
    with (folder / "stderr.txt").open("wb") as stderr, _output(output, folder) as stdout:
        return subprocess.Popen(
            command_line,
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
            preexec_fn=prepare,
            env=environment,
        )


@contextmanager
def _output(hit: Hit | None, folder: Path) -> Iterator[int]:
    """A context with the standard output of the command: a file, a pipe that nobody reads, or a full device."""
    if hit is None:
        output = os.open(folder / "stdout.txt", os.O_WRONLY | os.O_CREAT)
    elif hit.room:
        output = os.open("/dev/full", os.O_WRONLY)
    else:
        reading, output = os.pipe()
        os.close(reading)
    try:
        yield output
    finally:
        os.close(output)
