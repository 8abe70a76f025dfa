"""What others send to a run: `python -m chaos.attacks KIND`, a process of its own for each attack.

It prints one line, the port that it sends frames from (0: none), so that the checker knows whose they are.  It begins when it
gets a line on standard input, the `Attack` as JSON, and ends after its time.  Forged torques have values that no
robot of a plan can have.
"""

import json
import random
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from itertools import count
from typing import Any, Final

from chaos.frames import COMMAND_ID, ENABLE, FEEDBACK_ID, pack, torque_frame
from chaos.plans import robot_names

FORGED_TORQUE: Final = 31000
"""A forged torque, in bits; 31 N m, twenty times the limit of the robots"""
FORGED_PLACE: Final = 7777.0
"""The forged coordinate of a robot [m]"""
_HEADER: Final = struct.Struct("<HBBIQqII")  # docs/architecture.md, 3.7
_STATES: Final = 0x11  # both wheels enabled
_PERIOD_S: Final = 0.002


@dataclass(frozen=True, slots=True)
class Attack:
    """An attack, as it is handed to its process."""

    kind: str
    """A kind of hit that only sends something (`plans.TRAFFIC`)"""
    seed: int
    lasts_s: float
    group: str
    port: int
    """Where the frames of the run are"""
    robots: int
    host: str = "127.0.0.1"
    """The run's host, for datagrams to it alone"""
    hops: int = 0
    """How many networks a datagram may cross; 0 keeps it on this host"""
    endpoints: list[tuple[str, int]] = field(default_factory=list)
    """Where processes of the run listen"""
    ticket: dict[str, Any] = field(default_factory=dict)
    """What an observer of the run is told; empty: nothing"""
    secret: bool = False
    """True: the attack uses the observer's secret"""

    def line(self) -> str:
        """Returns what the process gets on standard input."""
        return json.dumps(asdict(self)) + "\n"


def words(kind: str) -> list[str]:
    """Returns the arguments of the process of an attack."""
    return [sys.executable, "-m", "chaos.attacks", kind]


def forged(attack: Attack, chance: random.Random) -> Iterator[bytes]:
    """Yields datagrams with frames that pass for those of the bridge and of drives."""
    for counter in count():
        robot = chance.randrange(attack.robots)
        sign = chance.choice((1, -1))
        for can_id, byte_4 in ((COMMAND_ID + robot, ENABLE), (FEEDBACK_ID + robot, _STATES)):
            yield pack(can_id, torque_frame(can_id, sign * FORGED_TORQUE, FORGED_TORQUE, byte_4, counter))


def flooding(attack: Attack, chance: random.Random) -> Iterator[bytes]:
    """Yields datagrams with whole frames of identifiers that the run does not use."""
    while True:
        yield pack(0x600 + chance.randrange(0x100), chance.randbytes(chance.randrange(9)))


def malformed(attack: Attack, chance: random.Random) -> Iterator[bytes]:
    """Yields datagrams that are no frames, and frames of the run's identifiers that are wrong in some way."""
    whole = torque_frame(COMMAND_ID, FORGED_TORQUE, FORGED_TORQUE, ENABLE, 0)
    odd: list[Callable[[], bytes]] = [
        lambda: chance.randbytes(chance.randrange(1400)),
        lambda: b"",
        lambda: pack(COMMAND_ID, whole)[: chance.randrange(160)],
        lambda: pack(COMMAND_ID, whole[:7] + bytes((whole[7] ^ 1 << chance.randrange(8),))),
        lambda: pack(COMMAND_ID, whole[: chance.randrange(8)]),
        lambda: pack(chance.choice((-1, 1 << 40, 0x1FFFFFFF)), whole),
        lambda: pack(COMMAND_ID, whole).replace(b"arbitration_id", b"arbitration_di"),
        lambda: pack(COMMAND_ID, whole).replace(b"\xcd\x01\x00", b"\xca\x43\x80\x00\x00"),  # 256.0
    ]
    while True:
        yield chance.choice(odd)()


def _attack_bus(attack: Attack, out: socket.socket) -> None:
    """Sends datagrams to the bus: to its group, and to the run's host alone."""
    makers = {"forge_bus": forged, "flood_bus": flooding, "malformed_bus": malformed}
    datagrams = makers[attack.kind](attack, random.Random(attack.seed))
    at_once = 40 if attack.kind == "flood_bus" else 2
    out.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, attack.hops)
    end_s = time.monotonic() + attack.lasts_s
    while time.monotonic() < end_s:
        for _ in range(at_once):
            datagram = next(datagrams)
            for address in (attack.group, attack.host):
                with suppress(OSError):  # a full queue
                    out.sendto(datagram, (address, attack.port))
        time.sleep(_PERIOD_S)


def _payloads(attack: Attack) -> Iterator[tuple[str, bytes]]:
    """Yields keys and messages that pass for those of robots and leaders, some periods ahead, and some that are no messages."""
    run, chance = attack.ticket.get("run", "unknown"), random.Random(attack.seed)
    while True:
        number = chance.randrange(2000)
        robot = chance.randrange(attack.robots)
        path = robot_names(attack.robots)[robot]
        width, channel = chance.choice(((16, "state"), (16, "state"), (6, "command"), (2, "torque"), (0, "state")))
        head = _HEADER.pack(1, chance.randrange(7), 0, robot, number, number * 10_000_000, width, 0)
        whole = head + struct.pack("<d", FORGED_PLACE) * width
        key = path.partition("/")[0] if channel == "command" else path
        yield f"echelon/{run}/{key}/{channel}", chance.choice((whole, whole, whole[:-3], chance.randbytes(40), b""))
        yield f"echelon/{run}/@watch/robot/{path}", struct.pack("<I", len(whole)) + whole


def _attack_zenoh(attack: Attack) -> None:
    """Joins each process of the run in turn and puts forged messages, until its time is over."""
    import zenoh

    end_s = time.monotonic() + attack.lasts_s
    ticket = attack.ticket if attack.secret else {}
    payloads = _payloads(attack)
    endpoints = [f"tcp/{address}:{port}" for address, port in attack.endpoints]
    for endpoint in [attack.ticket.get("endpoint", ""), *endpoints]:
        if not endpoint or time.monotonic() > end_s:
            continue
        config = zenoh.Config()
        settings: dict[str, Any] = {
            "mode": "peer",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": 300,
            "connect/exit_on_failure": False,
            "listen/endpoints": [],
            "scouting/multicast/enabled": False,
            # A run has none either; of an attack that is killed a file would be left, and be taken for one of the run.
            "transport/shared_memory/enabled": False,
        }
        if ticket:
            settings["transport/auth/usrpwd/user"] = ticket["user"]
            settings["transport/auth/usrpwd/password"] = ticket["password"]
        for name, value in settings.items():
            config.insert_json5(name, json.dumps(value))
        with suppress(zenoh.ZError), zenoh.open(config) as session:
            until_s = min(end_s, time.monotonic() + 0.2)
            while time.monotonic() < until_s:
                for _ in range(50):
                    key, payload = next(payloads)
                    session.put(key, payload)
                time.sleep(_PERIOD_S)


def _flood_zenoh(attack: Attack) -> None:
    """Connects to all processes of the run again and again, says nothing, or random bytes, and hangs up."""
    chance = random.Random(attack.seed)
    end_s = time.monotonic() + attack.lasts_s
    kept: list[socket.socket] = []
    while time.monotonic() < end_s:
        for endpoint in attack.endpoints:
            with suppress(OSError):
                one = socket.create_connection(endpoint, timeout=0.1)
                one.settimeout(0.05)
                kept.append(one)
                if chance.random() < 0.7:
                    one.sendall(chance.randbytes(chance.randrange(1, 3000)))
        while len(kept) > 60:
            kept.pop(0).close()
        time.sleep(_PERIOD_S)


def main(kind: str) -> None:
    """Waits for an attack's line and carries it out."""
    on_bus = kind.endswith("_bus")
    if kind == "forge_zenoh":
        import zenoh  # noqa: F401  before it is time
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
        if on_bus:
            out.bind(("", 0))
        print(out.getsockname()[1], flush=True)
        line = sys.stdin.readline()
        if not line:
            return
        attack = Attack(**json.loads(line))
        attack.endpoints[:] = [(address, port) for address, port in attack.endpoints]
        if on_bus:
            _attack_bus(attack, out)
        elif kind == "forge_zenoh":
            _attack_zenoh(attack)
        else:
            _flood_zenoh(attack)


if __name__ == "__main__":
    main(sys.argv[1])
