"""Tests that need a vcan0 that is up.  Without one, tests/test_vcan.py runs them in a guest that has one."""

import pytest

from echelon.bridge.can.bus_url import interface_is_up

if not interface_is_up("vcan0"):
    collect_ignore_glob = ["test_*.py"]


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "vcan: needs a real SocketCAN interface")
