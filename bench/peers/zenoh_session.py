"""Zenoh through `echelon.runtime.session`, which all roles of this project use: each role runs in the handler of its
messages."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from pathlib import Path

from bench.tree import COORDINATOR, LEADERS, ROBOTS, ROLES, Play, Ports, Role, run_roles

REQUIRES = ("zenoh",)
TIMEOUT_S = 30.0


class _Handler:
    """Runs a role in the handler of the messages that it waits for, as `echelon.runtime.lockstep` does."""

    def __init__(self, senders: dict[str, int]) -> None:
        self._waiting: dict[str, deque[bytes]] = {channel: deque() for channel in senders}
        self._senders = senders
        self._lock = threading.Lock()
        self._play: Play | None = None
        self._channel = ""
        self._value = 0.0
        self._done = threading.Event()
        self.puts: dict[str, object] = {}

    def send(self, channel: str, payload: bytes) -> None:
        self.puts[channel](payload)  # type: ignore[operator]

    def receive(self, channel: str, payload: bytes) -> None:
        with self._lock:
            self._waiting[channel].append(payload)
            if self._play is not None:
                self._advance(self._play)

    def drive(self, play: Play) -> float:
        with self._lock:
            self._channel = next(play)
            self._play = play
            self._advance(play)
        if not self._done.wait(TIMEOUT_S * 10):
            raise TimeoutError("a message is missing")
        return self._value

    def _advance(self, play: Play) -> None:
        while not self._done.is_set() and len(self._waiting[self._channel]) >= self._senders[self._channel]:
            waiting = self._waiting[self._channel]
            try:
                self._channel = play.send([waiting.popleft() for _ in range(self._senders[self._channel])])
            except StopIteration as end:
                self._value = end.value
                self._done.set()


def run_with_secrets(ticks: int, folder: Path) -> None:
    """Runs the exchange as the processes of a run do: nobody else is let in, and each publishes its own keys only."""
    run(ticks, folder, secrets=True)


def run(ticks: int, folder: Path, secrets: bool = False) -> None:
    """Runs the exchange."""
    from echelon.runtime.credentials import Credentials, new_identity
    from echelon.runtime.session import Session, loopback_endpoints

    own = {
        role: new_identity(role.name, [f"echelon/*/{role.name}/*", f"echelon/*/@alive/{role.name}"]) for role in ROLES
    }
    endpoints = dict(zip((COORDINATOR, *LEADERS), loopback_endpoints(1 + len(LEADERS)), strict=True))

    def connect(role: Role, folder: Path) -> Iterator[Ports]:
        run = f"echelon/{folder.name}"
        above: list[Role] = []
        below: list[Role] = []
        if role.number is not None:
            above = [Role(role.group)]
            sends, receives = ["state"], {"command": above}
        elif role.group is not None:
            above, below = [COORDINATOR], [Role(role.group, number) for number in range(ROBOTS)]
            sends, receives = ["group", "command"], {"state": below, "reference": above}
        else:
            below = list(LEADERS)
            sends, receives = ["reference"], {"group": below}
        ports = _Handler({channel: len(sources) for channel, sources in receives.items()})
        credentials = Credentials(
            own[role],
            (f"{run}/**", f"{run}/@alive/*"),
            guests=tuple(own[one] for one in below),
            hosts=tuple(own[one] for one in above),
        )
        with Session(
            listen=[endpoints[role]] if below else [],
            connect=[endpoints[one] for one in above],
            lockstep=True,
            credentials=credentials if secrets else None,
        ) as session:
            for channel, sources in receives.items():
                keys = [f"{run}/{one.name}/{channel}" for one in sources]
                session.subscribe(keys, lambda payload, channel=channel: ports.receive(channel, payload))  # type: ignore[misc]
            ports.puts = {channel: session.publisher(f"{run}/{role.name}/{channel}").put for channel in sends}
            session.declare_token(f"{run}/@alive/{role.name}")
            tokens = session.watch_tokens(f"{run}/@alive/*")
            missing = tokens.wait([f"{run}/@alive/{one.name}" for one in above + below], TIMEOUT_S)
            if missing:
                raise TimeoutError(f"{role.name} misses {sorted(missing)}")
            yield ports

    assert set(endpoints) < set(ROLES)
    run_roles(connect, ticks, folder)
