"""Runs that are to be stopped, with a listener of its own on their bus.

The listener is python-can's, in this process.  It shares no code with what is tested.
"""

import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import Popen
from typing import Final

import can
import pytest

from support.runs import kill_session, pid_of, session_members, start_echelon, until

GROUP: Final = "239.74.163.7"
RECEIVE_BUFFER: Final = 33
"""SO_RCVBUFFORCE"""
COMMAND: Final = 0x100
FEEDBACK: Final = 0x180
WATCHDOG_S: Final = 1.0
REPORT: Final = "--report"
SCENARIO: Final = f"""
name = "stopped"
duration = 1000.0
robot = {{ mass = 4.0, inertia = 0.12, wheel_radius = 0.05, arm = 0.15, offset = 0.1 }}
law = {{ epsilon = [0.5], lead = 0.5 }}
trajectory = {{ kind = "circle", radius = 3.0, rate = 0.3 }}
formation.robots = {{ solo = {{ start = [0, 1.5] }} }}
can = {{ path = "closed", watchdog = {WATCHDOG_S} }}
"""


@dataclass
class Ear:
    """Hears the frames of the robot `solo` on a bus: native frames, torques as two whole numbers."""

    port: int
    commands: list[tuple[float, bytes]] = field(default_factory=list)
    """Commands, each with the instant of `time.time` at which the kernel had it"""
    turning_s: float = 0.0
    """When a drive last reported torque"""
    torque: bool = False
    """Whether the last report was of torque"""
    reports: int = 0
    last_s: float = 0.0
    """When the last frame came"""
    commanding_s: float = 0.0
    """When the last command of torque came"""

    @property
    def enabled(self) -> bool:
        """Whether the last command enables the drives."""
        return bool(self.commands) and self.commands[-1][1][4] != 0

    @property
    def has_driven(self) -> bool:
        """Whether a command enabled the drives and was of torque."""
        return self.commanding_s > 0.0

    @property
    def commands_torque(self) -> bool:
        """Whether the last command is of torque."""
        return bool(self.commands) and self.commands[-1][1][:4] != bytes(4)

    def hear(self, bus: can.BusABC, done: threading.Event) -> None:
        """Listens until `done`."""
        while not done.is_set():
            message = bus.recv(0.05)
            if message is None:
                continue
            self.last_s = message.timestamp
            if message.arbitration_id == COMMAND:
                data = bytes(message.data)
                self.commands.append((message.timestamp, data))
                if data[4] and data[:4] != bytes(4):
                    self.commanding_s = message.timestamp
            elif message.arbitration_id == FEEDBACK:
                self.reports += 1
                self.torque = bytes(message.data[:4]) != bytes(4)
                if self.torque:
                    self.turning_s = message.timestamp


@contextmanager
def listening() -> Iterator[Ear]:
    """A context with an ear on a bus that nobody uses yet."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("", 0))
        port = probe.getsockname()[1]
    ear, done = Ear(port), threading.Event()
    try:
        bus = can.Bus(interface="udp_multicast", channel=GROUP, port=port, hop_limit=0, fd=False, ignore_config=True)
    except (OSError, can.CanError) as error:
        pytest.skip(f"no multicast: {error}")
    with socket.socket(fileno=os.dup(bus.fileno())) as through, suppress(PermissionError):
        through.setsockopt(
            socket.SOL_SOCKET, RECEIVE_BUFFER, 1 << 24
        )  # the last frames matter, and this process may be busy
    thread = threading.Thread(target=ear.hear, args=(bus, done))
    thread.start()
    try:
        yield ear
    finally:
        done.set()
        thread.join()
        bus.shutdown()


@contextmanager
def running(folder: Path, *options: str, text: str = SCENARIO) -> Iterator[tuple[Popen[str], Ear]]:
    """A run in a session of its own, whose drives report torque already; what is left of it is killed afterwards."""
    scenario = folder / "stopped.toml"
    scenario.write_text(text)
    with listening() as ear:
        command = start_echelon(
            *("run", scenario, "--can", f"udp_multicast:{GROUP}:{ear.port}", "--quiet", "--out", folder / "run"),
            *(("--no-report",) if REPORT not in options else ()),
            *(option for option in options if option != REPORT),
        )
        try:
            assert until(lambda: ear.has_driven or command.poll() is not None)
            assert ear.has_driven, command.communicate()
            yield command, ear
        finally:
            kill_session(command.pid)
            command.communicate()


def ended(command: Popen[str], timeout_s: float = 600) -> tuple[int, str]:
    """Waits for the end of a run and of all its processes; returns its exit code and standard error."""
    _, err = command.communicate(timeout=timeout_s)
    assert until(lambda: not session_members(command.pid)), session_members(command.pid)
    return command.returncode, err


def whom(command: Popen[str], who: str) -> int:
    """Returns the process with a role."""
    return command.pid if who == "supervisor" else pid_of(who, session_members(command.pid))
