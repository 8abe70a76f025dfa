"""A drive protocol with a drive for each wheel.  docs/add-a-protocol.md says more.

Two frames per wheel and cycle, 3 bytes each, little endian:

    command   0x200 + node   i16 torque [0.001 N m], u8 flags: enable, clear faults, emergency stop
    feedback  0x280 + node   i16 torque [0.001 N m], u8 state: 0 disabled, 1 enabled, 2 fault

    echelon run my_drive.toml --set robot.drive.protocol=my_wheels.py:MyProtocol
"""

import struct
from typing import Any

from echelon.bridge.protocols.cyclic import Command, CyclicDrive, CyclicHost, CyclicObserver, Feedback, WheelState
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.protocol import DriveProtocol
from echelon.plan.can_plan import DrivePlan, EnvelopePlan

COMMAND, FEEDBACK = 0x200, 0x280  # each drive's node id is added
ENABLE, CLEAR, ESTOP = 1, 2, 4
BODY = struct.Struct("<hB")


# 1. The bytes of one wheel


def bits(torque: float, scale: float) -> int:
    return max(-32767, min(32767, round(torque / scale)))


def read_command(data: bytes, scale: float) -> Command | str:
    if len(data) != BODY.size:
        return "length"
    torque, flags = BODY.unpack(data)
    return Command((torque * scale,), (bool(flags & ENABLE),), bool(flags & CLEAR), bool(flags & ESTOP))


def read_feedback(data: bytes, scale: float) -> tuple[float, WheelState] | str:
    if len(data) != BODY.size:
        return "length"
    torque, state = BODY.unpack(data)
    return (torque * scale, WheelState(state)) if state <= WheelState.FAULT else "state"


# 2. A cycle is whole when the left wheel's frame has come after the right one's.  If a frame is lost or a drive is silent,
#    there is no whole cycle, and the base classes notice the silence.


class Pairs:
    def __init__(self, nodes: tuple[int, int]) -> None:
        self.nodes, self.right = nodes, dict[int, Any]()

    def put(self, base: int, can_id: int, half: Any) -> tuple[Any, Any] | None:
        if can_id == base + self.nodes[0]:
            self.right[base] = half
            return None
        right = self.right.pop(base, None)
        return None if right is None else (right, half)


# 3. Who sends and who hears them


class MyHost(CyclicHost):  # the bridge's side commands both drives
    def __init__(self, plan: DrivePlan) -> None:
        super().__init__(plan, [FEEDBACK + node for node in plan.node_ids])
        self.pairs = Pairs(plan.node_ids)

    def encode(self, command: Command, saturated: bool) -> list[Frame]:
        both, frames = CLEAR * command.clear | ESTOP * command.estop, []
        for node, torque, enable in zip(self.plan.node_ids, command.torques, command.enable, strict=True):
            data = BODY.pack(bits(torque, self.plan.torque_scale), both | ENABLE * enable)
            frames.append(Frame(COMMAND + node, data))
        return frames

    def decode(self, frame: Frame) -> Feedback | str | None:
        half = read_feedback(frame.data, self.plan.torque_scale)
        if isinstance(half, str):
            return half
        pair = self.pairs.put(FEEDBACK, frame.can_id, half)
        return pair and Feedback(*zip(*pair, strict=True), (None, None))


class MyDrive(CyclicDrive):  # one virtual drive; self.wheels is (0,) or (1,)
    def decode(self, frame: Frame) -> Command | str:
        return read_command(frame.data, self.plan.torque_scale)

    def report(self, torques: tuple[float, ...]) -> list[Frame]:
        node = self.plan.node_ids[self.wheels[0]]
        return [Frame(FEEDBACK + node, BODY.pack(bits(torques[0], self.plan.torque_scale), self.states[0]))]


class MyObserver(CyclicObserver):  # for the referee and `echelon can`
    def __init__(self, plan: DrivePlan, envelope: EnvelopePlan) -> None:
        cyclic = {base + node: plan.period_ns for base in (COMMAND, FEEDBACK) for node in plan.node_ids}
        super().__init__(plan, envelope, plan.torque_scale, cyclic)
        self.pairs = Pairs(plan.node_ids)

    def decode(self, frame: Frame, said: list[tuple[str, str]]) -> Command | Feedback | None:
        base, read = (COMMAND, read_command) if frame.can_id < FEEDBACK else (FEEDBACK, read_feedback)
        half: Any = read(frame.data, self.plan.torque_scale)
        if isinstance(half, str):
            said.append((half, frame.data.hex()))
            return None
        pair = self.pairs.put(base, frame.can_id, half)
        if pair is None:
            return None
        if base == FEEDBACK:
            return Feedback(*zip(*pair, strict=True), (None, None))
        right, left = pair
        clear, estop = right.clear or left.clear, right.estop or left.estop
        return Command(right.torques + left.torques, right.enable + left.enable, clear, estop)


# 4. The protocol itself


class MyProtocol(DriveProtocol):
    wheels = ((0,), (1,))  # a drive for each wheel
    nodes = range(1, 127)  # planning chooses two free ones for each robot

    def identifiers(self, node: int) -> frozenset[int]:  # all frames of a node, to it and from it
        return frozenset((COMMAND + node, FEEDBACK + node))

    def host(self, drive: DrivePlan) -> MyHost:
        return MyHost(drive)

    def drive(self, drive: DrivePlan, number: int) -> MyDrive:
        return MyDrive(drive, [COMMAND + drive.node_ids[number]], self.wheels[number])

    def observer(self, drive: DrivePlan, envelope: EnvelopePlan, closed: bool) -> MyObserver:
        return MyObserver(drive, envelope)

    def messages(self, drive: DrivePlan, name: str) -> list[Any]:
        from cantools.database.can import Message  # here, for it is slow to import and most processes need no DBC

        from echelon.bridge.protocols.dbc import BRIDGE, number

        found = []
        for node, wheel in zip(drive.node_ids, ("right", "left"), strict=True):
            for base, what, last, sender, receiver in (
                (COMMAND, "torque", "flags", BRIDGE, name),
                (FEEDBACK, "feedback", "state", name, BRIDGE),
            ):
                torque = number(f"tau_{wheel}", 0, 16, receiver, drive.torque_scale, "Nm")
                signals = [torque, number(last, 16, 8, receiver, signed=False)]
                found.append(Message(base + node, f"{what}_{wheel}_{name}", BODY.size, signals, senders=[sender]))
        return found
