"""The frames of a short run with a closed torque path."""

from functools import cache

from echelon.bridge.frame_message import unpack
from echelon.bridge.protocols.frame import Frame
from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.sim.engines.in_process import Engine
from support.runs import plan_of

Heard = tuple[int, int, Frame]
"""Run time [ns], number of the bus, frame"""


@cache
def run(protocol: str, *overrides: str) -> tuple[Plan, tuple[Heard, ...]]:
    """Returns the plan of a short closed run, and all frames that its buses carried."""
    plan = plan_of(
        "lab",
        "can.path=closed",
        "can.bitrate=1000000",
        "can.bring_up=0.7",
        "duration=1",
        "claims=[]",
        f"robot.drive.protocol={protocol}",
        *overrides,
    )
    carried: list[Heard] = []

    def take(message: Message) -> None:
        if message.channel is Channel.FRAMES and message.source == plan.bridge.index:
            carried.extend((timed.time_ns, timed.bus, timed.frame) for timed in unpack(message.values))

    Engine(plan, take).run()
    return plan, tuple(carried)
