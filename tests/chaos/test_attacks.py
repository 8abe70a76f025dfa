"""What chaos sends to a bus is what it says: forged frames pass for the run's own, malformed ones never do."""

import json
import random
from contextlib import suppress
from dataclasses import asdict, replace
from itertools import islice

import pytest
import zenoh

from chaos.attacks import FORGED_PLACE, FORGED_TORQUE, Attack, _attack_zenoh, flooding, forged, malformed
from chaos.frames import Frame, command, feedback, unpack
from chaos.plans import robot_names
from chaos.subject import GROUP
from echelon.messages import Channel, Message
from echelon.runtime.credentials import Credentials, new_identity
from echelon.runtime.session import loopback_endpoints
from echelon.runtime.wire import WireError, data_key, decode, run_keys, watch_key
from echelon.sim.observing import Ticket
from support.runs import until

ATTACK = Attack("forge_bus", 1, 1.0, GROUP, 4000, 4)
SENDER = ("192.0.2.9", 4000)


def frames(datagrams: "list[bytes]") -> list[Frame | None]:
    """Returns what the listener makes of datagrams."""
    return [unpack(0, SENDER, datagram) for datagram in datagrams]


def test_forged_frames_are_commands_and_reports_of_all_robots() -> None:
    sent = [frame for frame in frames(list(islice(forged(ATTACK, random.Random(1)), 200))) if frame is not None]
    assert len(sent) == 200
    assert {frame.can_id for frame in sent} == {base + robot for base in (0x100, 0x180) for robot in range(4)}
    commands = [told for frame in sent if (told := command(frame))]
    assert len(commands) == 100
    assert all(told.moves and abs(told.right) == told.left == FORGED_TORQUE for told in commands)
    assert sum(feedback(frame) is not None for frame in sent) == 100


def test_malformed_frames_are_no_commands() -> None:
    sent = frames(list(islice(malformed(ATTACK, random.Random(1)), 3000)))
    assert sum(frame is not None for frame in sent) > 300  # frames of the run's identifiers, but wrong ones
    assert sum(frame is None for frame in sent) > 1000
    assert not any(command(frame) or feedback(frame) for frame in sent if frame is not None)


def test_a_flood_is_of_frames_that_nobody_uses() -> None:
    sent = frames(list(islice(flooding(ATTACK, random.Random(1)), 500)))
    assert all(frame is not None and frame.can_id >= 0x600 for frame in sent)


@pytest.mark.parametrize("secret", [False, True])
def test_forged_messages_pass_for_those_of_robots_where_nobody_checks_them(secret: bool) -> None:
    """Without a secret at a session that lets in anybody; with one at a session that lets in nobody else, and lets the one
    who has it say anything."""
    own, guest = new_identity("host", ()), new_identity("observer", run_keys("chaos"))
    (endpoint,) = loopback_endpoints(1)
    address, port = endpoint.removeprefix("tcp/").split(":")
    ticket = asdict(Ticket("chaos", 1, endpoint, own.zenoh_id, guest.user, guest.password))
    attack = replace(
        ATTACK, kind="forge_zenoh", lasts_s=1.0, endpoints=[(address, int(port))], ticket=ticket, secret=secret
    )
    heard: dict[str, list[bytes]] = {}
    config = zenoh.Config()
    with Credentials(own, run_keys("chaos"), guests=(guest,)).settings() as settings:
        for name, value in {
            "mode": "peer",
            "listen/endpoints": [endpoint],
            "scouting/multicast/enabled": False,
            **(settings if secret else {}),
        }.items():
            config.insert_json5(name, json.dumps(value))
        session = zenoh.open(config)
    with session:
        for keys in run_keys("chaos"):
            session.declare_subscriber(
                keys, lambda sample: heard.setdefault(str(sample.key_expr), []).append(sample.payload.to_bytes())
            )

        def all_heard() -> bool:
            """Attacks, and returns whether each robot was heard under its keys."""
            _attack_zenoh(attack)
            keys = [data_key("chaos", path, Channel.STATE) for path in robot_names(attack.robots)]
            keys += [watch_key("chaos", "robot", path) for path in robot_names(attack.robots)]
            return {*keys} <= heard.keys()

        assert until(all_heard, 60.0)
    for robot, path in enumerate(robot_names(attack.robots)):
        told = list[Message]()
        for payload in heard[data_key("chaos", path, Channel.STATE)]:
            with suppress(WireError):
                told.append(decode(payload))
        assert any((one.channel, one.source) == (Channel.STATE, robot) and FORGED_PLACE in one.values for one in told)
