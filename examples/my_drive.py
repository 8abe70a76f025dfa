"""A drive protocol of your own: the smallest one that works.  docs/add-a-protocol.md says more.

Two frames per robot and cycle, 5 bytes each, little endian:

    command   0x300 + robot   i16 torque right, i16 torque left [0.001 N m], u8 flags: enable, clear faults, emergency stop
    feedback  0x380 + robot   i16 torque right, i16 torque left [0.001 N m], u8 states: bits 0..3 right, bits 4..7 left

Copy this file beside your scenario, say `robot.drive.protocol = "my_drive.py:MyProtocol"`, and change the bytes.
"""

import struct
from typing import Any

from echelon.bridge.protocols.cyclic import Command, CyclicDrive, CyclicHost, CyclicObserver, Feedback, WheelState
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.protocol import DriveProtocol
from echelon.plan.can_plan import DrivePlan, EnvelopePlan

COMMAND, FEEDBACK = 0x300, 0x380  # each robot's number is added
ENABLE, CLEAR, ESTOP = 1, 2, 4
BODY = struct.Struct("<hhB")


# 1. The bytes.  What comes from a bus may be anything: check it, and say why it is refused, in a word or two.


def bits(torque: float, scale: float) -> int:
    return max(-32767, min(32767, round(torque / scale)))


def read_command(data: bytes, scale: float) -> Command | str:
    if len(data) != BODY.size:
        return "length"
    right, left, flags = BODY.unpack(data)
    enable = bool(flags & ENABLE)
    return Command((right * scale, left * scale), (enable, enable), bool(flags & CLEAR), bool(flags & ESTOP))


def read_feedback(data: bytes, scale: float) -> Feedback | str:
    if len(data) != BODY.size:
        return "length"
    right, left, states = BODY.unpack(data)
    if states & 15 > WheelState.FAULT or states >> 4 > WheelState.FAULT:
        return "state"
    # These bytes do not say what is wrong with a wheel, only that something is.
    return Feedback((right * scale, left * scale), (WheelState(states & 15), WheelState(states >> 4)), (None, None))


# 2. Who sends and who hears them.  When to enable, clear or stop, and what a drive does then, the base classes know.


class MyHost(CyclicHost):  # the bridge's side: sends commands
    def encode(self, command: Command, saturated: bool) -> list[Frame]:
        scale = self.plan.torque_scale
        flags = ENABLE * all(command.enable) | CLEAR * command.clear | ESTOP * command.estop
        data = BODY.pack(*(bits(torque, scale) for torque in command.torques), flags)
        return [Frame(COMMAND + self.plan.node_ids[0], data)]

    def decode(self, frame: Frame) -> Feedback | str:
        return read_feedback(frame.data, self.plan.torque_scale)


class MyDrive(CyclicDrive):  # the virtual drive: both motors, watchdog, faults
    def decode(self, frame: Frame) -> Command | str:
        return read_command(frame.data, self.plan.torque_scale)

    def report(self, torques: tuple[float, ...]) -> list[Frame]:
        scale = self.plan.torque_scale
        data = BODY.pack(*(bits(torque, scale) for torque in torques), self.states[0] | self.states[1] << 4)
        return [Frame(FEEDBACK + self.plan.node_ids[0], data)]


class MyObserver(CyclicObserver):  # for the referee and `echelon can`: hears both
    def decode(self, frame: Frame, said: list[tuple[str, str]]) -> Command | Feedback | None:
        read = read_command if frame.can_id < FEEDBACK else read_feedback
        heard = read(frame.data, self.plan.torque_scale)
        if isinstance(heard, str):
            said.append((heard, frame.data.hex()))
            return None
        return heard


# 3. The protocol itself: what a scenario names.


class MyProtocol(DriveProtocol):
    wheels = ((0, 1),)  # one drive for both wheels (0 right, 1 left); ((0,), (1,)) is a drive for each
    by_number = True  # a robot's number is its node id; otherwise planning chooses free ones

    def identifiers(self, node: int) -> frozenset[int]:  # all frames of a node, to it and from it
        return frozenset((COMMAND + node, FEEDBACK + node))

    def host(self, drive: DrivePlan) -> MyHost:
        return MyHost(drive, [FEEDBACK + drive.node_ids[0]])

    def drive(self, drive: DrivePlan, number: int) -> MyDrive:
        return MyDrive(drive, [COMMAND + drive.node_ids[0]])

    def observer(self, drive: DrivePlan, envelope: EnvelopePlan, closed: bool) -> MyObserver:
        cyclic = {base + drive.node_ids[0]: drive.period_ns for base in (COMMAND, FEEDBACK)}
        return MyObserver(drive, envelope, drive.torque_scale, cyclic)

    def messages(self, drive: DrivePlan, name: str) -> list[Any]:  # the DBC, for cantools, SavvyCAN and the like
        from cantools.database.can import Message  # here, for it is slow to import and most processes need no DBC

        from echelon.bridge.protocols.dbc import BRIDGE, number

        def signals(receiver: str, last: str) -> list[Any]:
            sides = (("tau_right", 0), ("tau_left", 16))
            torques = [number(side, start, 16, receiver, drive.torque_scale, "Nm") for side, start in sides]
            return [*torques, number(last, 32, 8, receiver, signed=False)]

        node, size = drive.node_ids[0], BODY.size
        return [
            Message(COMMAND + node, f"torque_{name}", size, signals(name, "flags"), senders=[BRIDGE]),
            Message(FEEDBACK + node, f"feedback_{name}", size, signals(BRIDGE, "states"), senders=[name]),
        ]
