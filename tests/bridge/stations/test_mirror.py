"""The mirroring bridge on a wall clock, on a bus that does not take every frame."""

import math
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from echelon.bridge.can.bus import Bus
from echelon.bridge.can.log_files import frames_in
from echelon.bridge.protocols.native.codec import NativeCodec, Torque
from echelon.bridge.stations.mirror import TAU_LEFT, TAU_RIGHT, MirrorBridge
from echelon.bridge.stations.waiting import RunClock
from echelon.messages import STATE_FIELDS, Channel, Message
from support.runs import plan_of

PERIOD_NS = 10_000_000


def state(number: int, torque: float) -> Message:
    """Returns a state of the first robot."""
    values = np.zeros(len(STATE_FIELDS))
    values[[TAU_RIGHT, TAU_LEFT]] = torque
    return Message(Channel.STATE, 0, number, number * PERIOD_NS, values)


def test_the_first_torque_that_a_bus_takes_after_a_stop_is_zero(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of("lab", "claims=[]", "can.watchdog=1000.0")
    bridge = MirrorBridge(plan, ["virtual:mirror"], tmp_path, RunClock())
    with closing(bridge):
        bridge.take([state(1, 0.5), state(2, math.nan)], [])
        with monkeypatch.context() as full:
            full.setattr(Bus, "send", lambda *_: False)
            bridge.take([state(3, 0.5)], [])  # the frame that enables with zero torque is lost
        bridge.take([state(4, 0.5), state(5, 0.5)], [])
    said = [NativeCodec(0.001).decode(frame.can_id, frame.data) for _, _, frame in frames_in(tmp_path / "can.log")]
    torques = [(one.enable_right, one.tau_right) for one in said if isinstance(one, Torque)]
    assert torques == [(True, 0.5), (False, 0.0), (True, 0.0), (True, 0.5)]
    assert [bus.lost for bus in bridge.report().buses] == [1]
