"""Tests that need a vcan0 that is up.  Without one, tests/test_vcan.py runs them in a guest that has one."""

from collections.abc import Generator

import pytest

from echelon.bridge.can.bus_url import interface_is_up
from support.vcan import vcan_required

if not interface_is_up("vcan0"):
    collect_ignore_glob = ["test_*.py"]


def pytest_configure(config: pytest.Config) -> None:
    config.addinivalue_line("markers", "vcan: needs a real SocketCAN interface")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(
    item: pytest.Item, call: pytest.CallInfo[None]
) -> Generator[None, pytest.TestReport, pytest.TestReport]:
    """Makes a skip a failure where a vcan must be, also beside a vcan0 of the host."""
    report = yield
    if report.skipped and vcan_required() and not hasattr(report, "wasxfail"):
        report.outcome, report.longrepr = "failed", f"skipped, though a vcan is required: {report.longrepr}"
    return report
