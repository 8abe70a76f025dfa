"""What chaos sends to a bus is what it says: forged frames pass for the run's own, malformed ones never do."""

import random
from itertools import islice

from chaos.attacks import FORGED_TORQUE, Attack, flooding, forged, malformed
from chaos.frames import Frame, command, feedback, unpack
from chaos.subject import GROUP

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
