"""Anonymous pipes: the cost of the exchange with only the kernel between the processes."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from bench.tree import COORDINATOR, FIELDS, HEADER, LEADERS, ROLES, BlockingPorts, Ports, Role, run_roles

REQUIRES = ()


class _Pipes(BlockingPorts):
    def __init__(self, senders: dict[str, list[int]], receivers: dict[str, list[int]]) -> None:
        self._senders, self._receivers = senders, receivers

    def send(self, channel: str, payload: bytes) -> None:
        for descriptor in self._senders[channel]:
            os.write(descriptor, payload)

    def receive(self, channel: str) -> list[bytes]:
        size = HEADER.size + 8 * FIELDS[channel]
        return [os.read(descriptor, size) for descriptor in self._receivers[channel]]


def run(ticks: int, folder: Path) -> None:
    """Runs the exchange."""
    edges: list[tuple[str, Role, Role]] = []
    for leader in LEADERS:
        edges += [("group", leader, COORDINATOR), ("reference", COORDINATOR, leader)]
        for robot in ROLES:
            if robot.number is not None and robot.group == leader.group:
                edges += [("state", robot, leader), ("command", leader, robot)]
    pipes = {edge: os.pipe() for edge in edges}

    def connect(role: Role, _: Path) -> Iterator[Ports]:
        senders: dict[str, list[int]] = {}
        receivers: dict[str, list[int]] = {}
        for (channel, source, sink), (read_end, write_end) in pipes.items():
            if source == role:
                senders.setdefault(channel, []).append(write_end)
            if sink == role:
                receivers.setdefault(channel, []).append(read_end)
        yield _Pipes(senders, receivers)

    try:
        run_roles(connect, ticks, folder)
    finally:
        for ends in pipes.values():
            for descriptor in ends:
                os.close(descriptor)
