"""A process's connection to other processes: payloads of bytes in and out, and the presence of processes.

This is the only module that imports Zenoh.  It does not know what the bytes mean.  There are two kinds of sessions:

- *lockstep* (virtual time): reliable, in order, and blocking; a receiver that falls behind slows its senders down.
- *wall clock*: a put never blocks; payloads that a slow or stopped receiver cannot take are dropped.

Most of the time that a small message takes is spent in waking threads.  So all of Zenoh shares one thread here, and handlers
run in that thread.  A role that works in the handler, and puts from it, wakes no other thread.
"""

import ctypes
import json
import os
import random
import socket
import sys
import threading
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import nullcontext
from types import TracebackType
from typing import Any, Final, Self, TypeVar

# Zenoh reads this once, when the first session opens.  With a second worker thread each message would wake one more thread.
os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx:(handover:app),tx:(handover:app),acc:(handover:app),net:(handover:app),app:(worker_threads:1))",
)

import zenoh

from echelon.runtime.credentials import Credentials
from echelon.runtime.inbox import Inbox

Receive = Callable[[bytes], None]
"""Handler of one payload, called in Zenoh's thread.  While it runs nothing else is received, so it must not wait for a later
payload.  It must handle its own errors, because Zenoh drops them."""

LEASE_MS: Final = 120_000
"""Peers close the connection to a process that stands still for longer than this [ms].  If a process ends, its peers notice
that at once, because its sockets close."""
LARGEST_MESSAGE: Final = 1 << 24
"""Larger payloads are not received; those of a run are a few kilobytes [bytes]"""
MOST_TOKENS: Final = 1 << 16
"""Tokens beyond this number are not noted"""
_SUN_PATH: Final = 107  # bytes in the path of a Unix socket
_thread: Final = threading.local()
_T = TypeVar("_T")


class Publisher:
    """Sends payloads under one key."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self.put: Receive = publisher.put
        """Sends a payload to every subscriber of the key; in lockstep it blocks while a subscriber is behind."""


class Tokens:
    """The presence tokens (Zenoh's liveliness tokens) that match one key expression, kept up to date."""

    def __init__(self, on_lost: Callable[[str], None] | None) -> None:
        self._alive: set[str] = set()
        self._changed = threading.Condition()
        self._on_lost = on_lost

    def alive(self) -> frozenset[str]:
        """Returns the keys of the tokens that exist at this moment."""
        with self._changed:
            return frozenset(self._alive)

    def wait(self, keys: Iterable[str], timeout_s: float) -> set[str]:
        """Waits until each of `keys`, which may hold wildcards, has a token.  Returns those without one after `timeout_s`."""
        missing = {key: zenoh.KeyExpr(key) for key in keys}

        def all_here() -> bool:
            for key, expression in list(missing.items()):
                if key in self._alive or any(expression.intersects(token) for token in self._alive):
                    del missing[key]
            return not missing

        with self._changed:
            self._changed.wait_for(all_here, timeout_s)
            return set(missing)

    def _receive(self, sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        lost = sample.kind == zenoh.SampleKind.DELETE
        with self._changed:
            if lost:
                self._alive.discard(key)
            elif len(self._alive) < MOST_TOKENS:
                self._alive.add(key)
            self._changed.notify_all()
        if lost and self._on_lost is not None:
            self._on_lost(key)


class Session:
    """An open connection to other processes, which may start before or after this one.

    It listens on the endpoints `listen` and connects to the endpoints `connect`; an endpoint is `tcp/host:port` or
    `unixsock-stream//path`.  Data and tokens reach only the processes that are connected directly.  Raises ValueError for an
    endpoint that is malformed, or on which it cannot listen.
    """

    def __init__(
        self,
        *,
        listen: Sequence[str],
        connect: Sequence[str],
        lockstep: bool,
        own_receiver: bool = False,
        credentials: Credentials | None = None,
    ) -> None:
        """With `credentials` nobody else is let in or heard.

        `own_receiver` gives receiving a thread of its own, so that sending goes on while a full inbox blocks receiving.  A
        process needs it if it both sends and has an inbox in lockstep.  Only a process's first session can set it."""
        if lockstep:
            _prefer_throughput()
        if own_receiver:
            runtime = os.environ["ZENOH_RUNTIME"]
            os.environ["ZENOH_RUNTIME"] = runtime.replace("rx:(handover:app)", "rx:(worker_threads:1)")
        self._lockstep = lockstep
        self._session = _open(listen, connect, lockstep, credentials)
        self._inboxes: list[Inbox[Any]] = []
        self._kept: list[object] = []  # references that keep all declarations alive as long as the session

    def subscribe(self, keys: str | Iterable[str], receive: Receive) -> None:
        """Calls `receive`, in Zenoh's thread, with each payload put under any of `keys`.  Exact keys are cheaper than
        wildcards."""

        def handle(sample: zenoh.Sample) -> None:
            if not hasattr(_thread, "state"):
                # Keeps Python's state of this thread.  Otherwise it is made and destroyed for every message, which takes
                # longer than the message.
                _thread.state = ctypes.pythonapi.PyGILState_Ensure()
            receive(sample.payload.to_bytes())

        for key in [keys] if isinstance(keys, str) else keys:
            handler = zenoh.handlers.Callback(handle, indirect=False)
            self._kept.append(self._session.declare_subscriber(key, handler))

    def checked_inbox(self, doors: Mapping[str, Callable[[bytes], _T | None]], high_water: int = 1024) -> Inbox[_T]:
        """Returns an inbox for what was put under any of the keys of `doors`.

        The function of a key is called in Zenoh's thread with each payload and returns what is to be kept of it, or None.

        In lockstep, a full inbox blocks everything that this process receives.  So its owner must keep calling `take`, and
        must not wait for anything else."""
        # Zenoh's thread needs Python's global lock for each payload; by default a busy thread gives it up only every 5 ms.
        sys.setswitchinterval(1e-4)
        inbox = Inbox[_T](high_water, self._lockstep)
        self._inboxes.append(inbox)

        def receiver(check: Callable[[bytes], _T | None]) -> Receive:
            def receive(payload: bytes) -> None:
                if (kept := check(payload)) is not None:
                    inbox.put(kept)

            return receive

        for key, check in doors.items():
            self.subscribe(key, receiver(check))
        return inbox

    def publisher(self, key: str) -> Publisher:
        """Declares that this process puts payloads under `key`; returns the publisher."""
        control = zenoh.CongestionControl.BLOCK if self._lockstep else zenoh.CongestionControl.DROP
        publisher = self._session.declare_publisher(key, congestion_control=control)
        self._kept.append(publisher)
        return Publisher(publisher)

    def declare_token(self, key: str) -> None:
        """Declares a presence token, which exists until the session ends.  A process that sees the token also sees all that was
        declared before it."""
        self._kept.append(self._session.liveliness().declare_token(key))

    def watch_tokens(self, key: str, on_lost: Callable[[str], None] | None = None) -> Tokens:
        """Returns the tokens that match `key`.  `on_lost` is called, in a thread of its own, with the key of each token that
        ends."""
        tokens = Tokens(on_lost)
        self._kept.append(self._session.liveliness().declare_subscriber(key, tokens._receive, history=True))
        return tokens

    def close(self) -> None:
        """Delivers all that was put, then ends the connection.  A handler must not call it.

        On a wall clock it gives up on a receiver that stands still."""
        for inbox in self._inboxes:
            inbox.let_go()
        try:
            self._session.close()  # type: ignore[no-untyped-call]
        except zenoh.ZError:  # it took too long
            if self._lockstep:
                raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def loopback_endpoints(count: int) -> list[str]:
    """Returns endpoints for the processes of one run on this machine.  Their ports are free at the moment of the call.

    The endpoints use TCP, because a Unix socket wakes the sender's thread each time the receiver has read.  Every run draws a
    random address in 127.0.0.0/8, so that two runs do not use the same one.
    """
    host = f"127.{random.randint(1, 254)}.{random.randint(0, 255)}.{random.randint(1, 254)}"
    probes = [socket.create_server((host, 0)) for _ in range(count)]
    endpoints = [f"tcp/{host}:{probe.getsockname()[1]}" for probe in probes]
    for probe in probes:
        probe.close()
    return endpoints


def _prefer_throughput() -> None:
    """Sets the batch scheduling policy for this process: when it is woken, it does not interrupt the process that woke it.
    This needs no privilege."""
    if os.sched_getscheduler(0) == os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _open(
    listen: Sequence[str], connect: Sequence[str], lockstep: bool, credentials: Credentials | None
) -> zenoh.Session:
    """Returns an open Zenoh session.  Raises ValueError for a wrong endpoint."""
    for endpoint in [*listen, *connect]:
        _check(endpoint)
    settings: dict[str, object] = {
        "mode": "peer",
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/timeout_ms": -1,  # go on connecting in the background, for ever
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 5, "period_max_ms": 20, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        # The low-latency transport is slower here: a put in Zenoh's thread moves to another thread.
        "transport/unicast/lowlatency": False,
        "transport/unicast/qos/enabled": not lockstep,
        # Each received message holds one 64 KiB buffer until it is taken.  With a single buffer (the default) nearly every
        # message allocates and clears a new one.
        "transport/link/rx/buffer_size": 4 * 65536,
        "transport/link/rx/max_message_size": LARGEST_MESSAGE,
    }
    if lockstep:
        # A peer that stands still is waited for, and what was put for it is kept; the run's supervisor decides when to give up.
        settings["transport/link/tx/lease"] = LEASE_MS
        settings["transport/link/tx/queue/congestion_control/block/wait_before_close"] = LEASE_MS * 1000
    secret = nullcontext(dict[str, object]()) if credentials is None else credentials.settings()
    with secret as secrets:
        config = zenoh.Config()
        for name, value in (settings | secrets).items():
            config.insert_json5(name, json.dumps(value))
        try:
            return zenoh.open(config)
        except zenoh.ZError as error:
            raise ValueError(f"cannot listen on {', '.join(listen) or 'nothing'}: {error}") from error


def _check(endpoint: str) -> None:
    """Raises ValueError for a malformed endpoint.  Zenoh would retry some of them for ever in the background, and report others
    without naming the endpoint."""
    protocol, _, address = endpoint.partition("/")
    if protocol == "unixsock-stream":
        length = len(os.fsencode(address))
        if not 0 < length <= _SUN_PATH:
            raise ValueError(f"endpoint {endpoint!r}: a socket path has 1 to {_SUN_PATH} bytes, not {length}")
    elif protocol in ("tcp", "tls", "quic", "udp", "ws"):
        host, _, port = address.partition("#")[0].partition("?")[0].rpartition(":")
        if not host or not port.isascii() or not port.isdecimal() or int(port) > 65535:
            raise ValueError(f"endpoint {endpoint!r}: expected {protocol}/host:port with a port up to 65535")
    else:
        raise ValueError(f"endpoint {endpoint!r}: expected tcp/host:port or unixsock-stream//path")
