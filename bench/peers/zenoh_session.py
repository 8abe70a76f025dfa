"""Zenoh, through the session all roles of this project use: a tree of links over TCP on the loopback."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from bench.tree import COORDINATOR, LEADERS, ROBOTS, Ports, Role, run_roles

if TYPE_CHECKING:
    from echelon.session import Inbox, Publisher

REQUIRES = ("zenoh",)


def run(ticks: int, folder: Path) -> None:
    """Run the exchange."""
    from echelon.session import Session, loopback_endpoints

    endpoints = dict(zip((COORDINATOR, *LEADERS), loopback_endpoints(1 + len(LEADERS)), strict=True))

    def connect(role: Role, folder: Path) -> Iterator[Ports]:
        run = f"echelon/{folder.name}"
        above: list[Role] = []
        below: list[Role] = []
        if role.number is not None:
            above = [Role(role.group)]
            sends, receives = {"state": role}, {"command": above}
        elif role.group is not None:
            above, below = [COORDINATOR], [Role(role.group, number) for number in range(ROBOTS)]
            sends, receives = {"group": role, "command": role}, {"state": below, "reference": above}
        else:
            below = list(LEADERS)
            sends, receives = {"reference": role}, {"group": below}
        with Session(
            listen=[endpoints[role]] if below else [], connect=[endpoints[one] for one in above], lockstep=True
        ) as session:
            keys = {
                channel: [f"{run}/{one.name}/{channel}" for one in sources] for channel, sources in receives.items()
            }
            inbox = session.subscribe([key for group in keys.values() for key in group])
            publishers = {channel: session.publisher(f"{run}/{role.name}/{channel}") for channel in sends}
            session.declare_token(f"{run}/@alive/{role.name}")
            missing = session.await_tokens([f"{run}/@alive/{one.name}" for one in above + below], 30.0)
            if missing:
                raise TimeoutError(f"{role.name} misses {sorted(missing)}")
            yield _Keys(inbox, keys, publishers)

    run_roles(connect, ticks, folder)


class _Keys:
    def __init__(self, inbox: Inbox, keys: dict[str, list[str]], publishers: dict[str, Publisher]) -> None:
        self._inbox, self._keys, self._publishers = inbox, keys, publishers

    def send(self, channel: str, payload: bytes) -> None:
        self._publishers[channel].put(payload)

    def receive(self, channel: str) -> list[bytes]:
        return self._inbox.take(keys=self._keys[channel], timeout_s=10.0)
