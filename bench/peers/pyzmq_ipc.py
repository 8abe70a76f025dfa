"""pyzmq over ipc: PUSH/PULL up the tree, PUB/SUB down."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bench.tree import GROUPS, ROBOTS, BlockingPorts, Ports, Role, run_roles

if TYPE_CHECKING:
    import zmq

REQUIRES = ("zmq",)


def connect(role: Role, folder: Path) -> Iterator[Ports]:
    """Yields a role's sockets when every publisher knows its subscribers."""
    import zmq

    context = zmq.Context()

    def up(name: str, receive: bool) -> zmq.Socket[bytes]:
        found = context.socket(zmq.PULL if receive else zmq.PUSH)
        address = f"ipc://{folder}/{name}"
        if receive:
            found.bind(address)
        else:
            found.connect(address)
        return found

    def down(name: str, receivers: int) -> zmq.Socket[bytes]:
        address = f"ipc://{folder}/{name}"
        if receivers:
            publisher = context.socket(zmq.XPUB)
            publisher.setsockopt(zmq.XPUB_VERBOSE, 1)  # every subscription, not each topic once
            publisher.bind(address)
            return publisher
        subscriber = context.socket(zmq.SUB)
        subscriber.setsockopt(zmq.SUBSCRIBE, b"")
        subscriber.connect(address)
        return subscriber

    sockets: dict[str, zmq.Socket[bytes]] = {}
    if role.number is not None:
        sockets = {"state": up(f"up{role.group}", False), "command": down(f"down{role.group}", 0)}
    elif role.group is not None:
        sockets = {"state": up(f"up{role.group}", True), "command": down(f"down{role.group}", ROBOTS)}
        sockets |= {"group": up("up", False), "reference": down("down", 0)}
        for _ in range(ROBOTS):
            sockets["command"].recv()  # a subscription has arrived
    else:
        sockets = {"group": up("up", True), "reference": down("down", GROUPS)}
        for _ in range(GROUPS):
            sockets["reference"].recv()
    yield _Sockets(sockets)
    context.destroy()


class _Sockets(BlockingPorts):
    def __init__(self, sockets: dict[str, zmq.Socket[bytes]]) -> None:
        self._sockets = sockets

    def send(self, channel: str, payload: bytes) -> None:
        self._sockets[channel].send(payload)

    def receive(self, channel: str) -> list[bytes]:
        receive = self._sockets[channel].recv
        return [receive() for _ in range(_SENDERS[channel])]


_SENDERS = {"state": ROBOTS, "group": GROUPS, "reference": 1, "command": 1}


def run(ticks: int, folder: Path) -> None:
    """Runs the exchange."""
    run_roles(connect, ticks, folder)


def run_batch(ticks: int, folder: Path) -> None:
    """Runs the exchange with the scheduling policy that a lockstep session sets, SCHED_BATCH."""

    def connect_batch(role: Role, folder: Path) -> Iterator[Ports]:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        yield from connect(role, folder)

    run_roles(connect_batch, ticks, folder)
