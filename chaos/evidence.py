"""What a checker gets to see of a run: what was done to it, what was heard on its bus, and what it left behind."""

import json
import re
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from struct import Struct
from typing import Any, Final

from mcap.exceptions import EndOfFile, McapError
from mcap.reader import make_reader
from mcap.records import Channel, Message
from mcap.stream_reader import StreamReader

from chaos.listener import Heard
from chaos.plans import ChaosPlan, Hit

PERIOD_NS: Final = 10_000_000
"""The period of accelerations, of torques and of all cyclic frames of a plan's run"""
WATCHDOG_NS: Final = 100_000_000
TORQUE_SCALE: Final = 0.001
"""Torque of a bit in a frame [N m]"""
_LINE: Final = re.compile(r"\((\d+)\.(\d{6})\) (\S+) ([0-9A-F]{3})#((?:[0-9A-F]{2}){0,8})")
_STATE: Final = Struct("<16d")
"""The values of a RobotState: x, y, vx, vy, theta, v, omega, ax, ay, tau_right, tau_left, …"""
_FRAME: Final = Struct("<I3?B8s")
"""The end of a can_msgs/Frame: identifier, three flags, number of bytes, data"""


@dataclass(frozen=True, slots=True)
class Done:
    """A hit that was carried out, with its beginning and end [ns since 1970]."""

    hit: Hit
    begun_ns: int
    ended_ns: int | None
    """None: it never ended"""
    port: int = 0
    """The port that its frames came from; 0 if it sent none"""


@dataclass(frozen=True, slots=True)
class Logged:
    """A line of can.log."""

    time_ns: int
    can_id: int
    data: bytes


@dataclass(frozen=True, slots=True)
class RobotState:
    """A state of a robot in the recording: its number, its time [ns of run time], and its values."""

    sequence: int
    time_ns: int
    values: tuple[float, ...]


@dataclass(slots=True)
class Recording:
    """What `run.mcap` holds."""

    whole: bool = False
    """True: it has its end and its index"""
    states: dict[str, list[RobotState]] = field(default_factory=dict)
    """By robot"""
    frames: list[Logged] = field(default_factory=list)
    error: str = ""
    """Why it could not be read; "" if it could, to its end or to where it was cut off"""


@dataclass(slots=True)
class Evidence:
    """All of it."""

    plan: ChaosPlan
    done: list[Done]
    """The hits that were carried out, in their order"""
    begun_ns: int
    ended_ns: int
    """When the command began and ended [ns since 1970]"""
    code: int | None
    """Its exit code, −9 if SIGKILL ended it; None if it had to be ended"""
    stdout: str
    stderr: str
    heard: Heard
    can_log: list[Logged] | None
    """None: there is none"""
    recording: Recording | None
    """None: there is none"""
    recovered: Recording | None
    """The recording after `echelon recover`, if it was not whole"""
    summary: dict[str, Any] | None
    """summary.json; None if there is none or it cannot be read"""
    reference: dict[str, list[RobotState]] | None
    """In virtual time the states of the same run in one process, with nothing done to it"""
    left: list[str]
    """What was left behind: processes, names in the folder for temporary files, shared memory"""


def read_can_log(path: Path) -> list[Logged] | None:
    """Reads a log as `candump -l` writes it; None if there is none.  A line that is cut off is left out."""
    try:
        text = path.read_text(encoding="ascii", errors="replace")
    except FileNotFoundError:
        return None
    found = []
    for line in text.splitlines():
        if match := _LINE.fullmatch(line):
            seconds, micros, _, can_id, data = match.groups()
            time_ns = int(seconds) * 1_000_000_000 + int(micros) * 1000
            found.append(Logged(time_ns, int(can_id, 16), bytes.fromhex(data)))
    return found


def read_recording(path: Path) -> Recording | None:
    """Reads a recording to its end, or to where it was cut off; None if there is none."""
    if not path.exists():
        return None
    found, topics = Recording(), dict[int, str]()
    with path.open("rb") as file, suppress(McapError, ValueError):
        found.whole = make_reader(file).get_summary() is not None
    try:
        for record in _records(path):
            if isinstance(record, Channel):
                topics[record.id] = record.topic
            else:
                _take(found, topics.get(record.channel_id, ""), record)
    except Exception as error:  # whatever it is, the recording is not what it should be
        found.error = f"{type(error).__name__}: {error}"
    return found


def _records(path: Path) -> Iterator[Channel | Message]:
    """Yields channels and messages; ends where the file is cut off."""
    with path.open("rb") as file:
        try:
            for record in StreamReader(file, record_size_limit=1 << 26).records:
                if isinstance(record, Channel | Message):
                    yield record
        except EndOfFile:
            return


def _take(found: Recording, topic: str, message: Message) -> None:
    """Takes a message of a recording."""
    if topic == "/can/frames":
        can_id, _, _, _, length, data = _FRAME.unpack(message.data[-_FRAME.size :])
        found.frames.append(Logged(message.log_time, can_id, data[:length]))
        return
    if topic.endswith("/state") and len(message.data) >= _STATE.size + 12:
        values = _STATE.unpack(message.data[-_STATE.size :])
        state = RobotState(message.sequence, message.log_time, values)
        found.states.setdefault(topic.removesuffix("/state").lstrip("/"), []).append(state)


def read_summary(path: Path) -> dict[str, Any] | None:
    """Reads a summary; None if there is none or it is not whole."""
    try:
        summary: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return summary
