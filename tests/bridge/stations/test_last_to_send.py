"""Who stops the wheels, in another thread than the one that sends torques, has the last word: on the bus and in can.log."""

import threading
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

from echelon.bridge.can.bus import Bus
from echelon.bridge.can.log_files import frames_in
from echelon.bridge.protocols.native.codec import NativeCodec, Torque
from echelon.bridge.stations import waiting
from echelon.bridge.stations.closed import ClosedBridge
from echelon.bridge.stations.mirror import TAU_LEFT, TAU_RIGHT, MirrorBridge
from echelon.bridge.stations.waiting import RunClock
from echelon.bridge.stations.wall_bridge import WallBridge
from echelon.messages import STATE_FIELDS, Channel, Message
from support.runs import plan_of

CLOSED = ("lab", "claims=[]", "can.path=closed", "can.watchdog=1000.0")


class StopInTheMiddle:
    """Stops the wheels in another thread while frame number `at` is being sent; notes what the bus took, in order."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, at: int) -> None:
        self.frames: list[tuple[int, bytes]] = []
        self.by_stop: list[bool] = []
        """Of each frame whether the thread that stops the wheels has sent it"""
        self._at, self._send = at, Bus.send
        self.thread: threading.Thread | None = None
        self.stop: Callable[[], None] = lambda: None
        self.has_stopped: Callable[[], bool] = lambda: True
        monkeypatch.setattr(waiting, "LAST_S", 600.0)  # on a busy machine the frame below takes long
        monkeypatch.setattr(Bus, "send", lambda bus, *args, **named: self.send(bus, *args, **named))

    def send(self, bus: Bus, can_id: int, data: bytes, time_ns: int = 0, remote: bool = False) -> bool:
        if len(self.frames) == self._at and self.thread is None:
            self.thread = threading.Thread(target=self.stop)
            self.thread.start()
            while not self.has_stopped():  # it has said that it stops, and waits for this frame
                threading.Event().wait(0.001)
            self.thread.join(0.05)  # who does not wait is done by then
        taken = self._send(bus, can_id, data, time_ns, remote)
        self.frames.append((can_id, bytes(data)))
        self.by_stop.append(threading.current_thread() is self.thread)
        return taken

    def check(self, log: Path, stops: int) -> None:
        """Asserts that the last frames, on the bus and in the log, are those that stop the wheels, after others."""
        assert self.thread is not None
        self.thread.join()
        logged = [(frame.can_id, bytes(frame.data)) for _, _, frame in frames_in(log)]
        assert logged == self.frames
        assert self.by_stop == sorted(self.by_stop)
        said = [
            found for can_id, data in logged if isinstance(found := NativeCodec(0.001).decode(can_id, data), Torque)
        ]
        assert [one.enable_right for one in said[-stops:]] == [False] * stops
        assert stops <= sum(self.by_stop) < len(self.by_stop)


def states(robots: int, instants: Sequence[int], period_ns: int) -> list[Message]:
    values = np.zeros(len(STATE_FIELDS))
    values[[TAU_RIGHT, TAU_LEFT]] = 0.5
    return [
        Message(Channel.STATE, robot, number, number * period_ns, values)
        for number in instants
        for robot in range(robots)
    ]


@pytest.mark.parametrize("clock", ["virtual", "wall"])
def test_mirrored_torques_end_in_the_middle_of_a_batch(
    clock: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of("lab", "claims=[]", "can.watchdog=1000.0")
    middle = StopInTheMiddle(monkeypatch, at=7)
    bridge = MirrorBridge(plan, ["virtual:middle"], tmp_path, None if clock == "virtual" else RunClock())
    with closing(bridge):
        middle.stop, middle.has_stopped = bridge.stop, lambda: bridge._stopped
        copies: list[Message] = []
        bridge.take(states(len(plan.robots), range(1, 20), plan.robots[0].period_ns), copies)
        assert middle.thread is not None
        middle.thread.join()
    middle.check(tmp_path / "can.log", stops=len(plan.robots))
    assert len(middle.frames) == 8 + len(plan.robots)
    assert copies  # what was sent before is recorded


def test_torques_on_a_wall_clock_end_in_the_middle_of_a_period(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = plan_of(*CLOSED)
    middle = StopInTheMiddle(monkeypatch, at=10)
    bridge = WallBridge(plan, ["virtual:middle"], tmp_path, lambda payload: None, None)
    with closing(bridge):
        middle.stop, middle.has_stopped = bridge.stop, lambda: bridge._stopped
        while middle.thread is None:
            bridge.serve()
        bridge.serve()
        middle.thread.join()
        bridge.serve()
    middle.check(tmp_path / "can.log", stops=len(plan.robots))


def test_torques_over_the_time_rail_end_in_the_middle_of_a_message(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = plan_of(*CLOSED)
    middle = StopInTheMiddle(monkeypatch, at=10)
    bridge = ClosedBridge(plan, ["virtual:middle"], tmp_path, paired=True)

    def halt() -> None:
        bridge.interrupt()
        bridge.stop()

    with closing(bridge):
        middle.stop, middle.has_stopped = halt, bridge.rail.stopping.is_set
        heard = [[None] * len(stage.inputs) for stage in bridge.stages]

        def run() -> None:
            for number in range(1000):
                for stage, inputs in zip(bridge.stages, heard, strict=True):
                    stage.run(stage.first_ns + number * stage.period_ns, inputs)

        with pytest.raises(SystemExit):
            run()
        assert middle.thread is not None
        middle.thread.join()
    middle.check(tmp_path / "can.log", stops=len(plan.robots))
