"""What unmodified clients from PyPI do with a virtual ODrive axis."""

import time
from collections.abc import Callable
from typing import Any

LIMIT_S = 100.0


def drive_by_pyodrivecan(client: Any) -> None:
    """Turns the wheel forward and backward with pyodrivecan, then stops it in an emergency, and clears the errors.

    The axis must be in CLOSED_LOOP_CONTROL already."""

    def until(done: Callable[[], bool], torque: float | None = None) -> None:
        deadline_s = time.monotonic() + LIMIT_S
        while not done():
            assert time.monotonic() < deadline_s, vars(client)
            if torque is not None:
                client.set_torque(torque)
            if (message := client.canBus.recv(timeout=0.02)) is not None:
                client.process_can_message(message)

    until(lambda: (client.velocity or 0.0) > 0.5, 0.25)
    assert client.torque_target == 0.25
    until(lambda: (client.velocity or 0.0) < -0.5, -0.25)
    until(lambda: client.bus_voltage is not None and client.motor_temp is not None, -0.25)
    assert 23.0 < client.bus_voltage < 24.5
    client.estop()
    deadline_s = time.monotonic() + LIMIT_S
    while not client.is_odrive_idle():  # by the next heartbeat, which may be from before
        assert time.monotonic() < deadline_s
    client.clear_errors()
    client.flush_can_buffer()
    client.setAxisState()
    client.set_torque(0.0)
    until(lambda: (client.velocity or 0.0) > 0.5, 0.25)
    client.setAxisState("idle")
