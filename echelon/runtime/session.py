"""A process's connection to the others: bytes in, bytes out, and who is alive.

The only module that imports Zenoh.  It knows nothing of what the bytes mean.  There are two ways to be connected:

- *lockstep* (virtual time): reliable, in order, and blocking; a receiver that falls behind slows its senders down.
- *wall clock*: a put never waits for anyone; what a slow or stopped receiver cannot take is dropped.

Where the time of a small message goes is in waking threads.  So all of Zenoh shares one thread here, and what is received
is handled in that thread: a role that works in the handler, and puts from it, needs no other thread to wake at all.
"""

import ctypes
import json
import os
import random
import socket
import sys
import threading
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from types import TracebackType
from typing import Final, Self

# Read once, when the first session opens.  A second worker thread would be one more hand-over for every message.
os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx:(handover:app),tx:(handover:app),acc:(handover:app),net:(handover:app),app:(worker_threads:1))",
)

import zenoh

Receive = Callable[[bytes], None]
"""Takes one payload, in Zenoh's thread.  While it runs nothing else is received, so it must wait for nothing that only
comes later; and it must handle its own errors, for nobody else learns of them."""

LEASE_MS: Final = 120_000
"""A process that stands still for longer is given up by its peers.  One that ends is noticed at once, by its sockets."""
_SUN_PATH: Final = 107  # bytes in the path of a Unix socket
_thread: Final = threading.local()


class Inbox:
    """Payloads received and not yet taken, in order of arrival.  One thread takes.

    With `hold` (lockstep), nothing more is received while there are `high_water` of them: senders wait in their put, and
    nothing is lost.  Otherwise the newest `high_water` are kept, and `dropped` counts the others.
    """

    def __init__(self, high_water: int, hold: bool) -> None:
        self._payloads: deque[bytes] = deque()
        self._high_water, self._hold = high_water, hold
        self._some = threading.Event()
        self._room = threading.Event()
        self.dropped = 0

    def take(self, timeout_s: float | None = None) -> list[bytes]:
        """Returns and forgets all that was received; waits for something if there is nothing, `timeout_s` at most."""
        payloads = self._payloads
        if not payloads and timeout_s != 0:
            self._some.clear()  # before looking again: one that comes now sets it anew
            if not payloads:
                self._some.wait(timeout_s)
        taken = [payloads.popleft() for _ in range(len(payloads))]
        self._room.set()
        return taken

    def _receive(self, payload: bytes) -> None:
        payloads = self._payloads
        payloads.append(payload)
        if not self._hold and len(payloads) > self._high_water:
            payloads.popleft()
            self.dropped += 1
        self._some.set()
        while self._hold and len(payloads) >= self._high_water:
            self._room.clear()
            if self._hold and len(payloads) >= self._high_water:
                self._room.wait()

    def _let_go(self) -> None:
        """Holds nobody any more: Zenoh's thread, which may stand in `_receive`, is needed for closing."""
        self._hold = False
        self._room.set()


class Publisher:
    """Sends payloads under one key."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self.put: Receive = publisher.put
        """Sends a payload to every subscriber of the key; in lockstep it waits for those that are behind."""


class Tokens:
    """The liveliness tokens under one key expression, kept up to date."""

    def __init__(self, on_lost: Callable[[str], None] | None) -> None:
        self._alive: set[str] = set()
        self._changed = threading.Condition()
        self._on_lost = on_lost

    def alive(self) -> frozenset[str]:
        """Returns the keys of the tokens that exist now."""
        with self._changed:
            return frozenset(self._alive)

    def wait(self, keys: Iterable[str], timeout_s: float) -> set[str]:
        """Waits until each of `keys` (which may hold wildcards) has a token; returns those that have none in time."""
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
            else:
                self._alive.add(key)
            self._changed.notify_all()
        if lost and self._on_lost is not None:
            self._on_lost(key)


class Session:
    """An open connection to those it listens for and connects to, who may start before or after it.

    Endpoints read `tcp/host:port` or `unixsock-stream//path`.  Data and tokens reach the processes at the other end of its
    own links and no further.  Raises ValueError for an endpoint that is none, or cannot be listened on.
    """

    def __init__(
        self, *, listen: Sequence[str], connect: Sequence[str], lockstep: bool, own_receiver: bool = False
    ) -> None:
        """`own_receiver` is for a process that puts besides holding an inbox in lockstep: it gives receiving a thread of its
        own, so that sending goes on while receiving stands still.  It counts in a process's first session only."""
        if lockstep:
            _prefer_throughput()
        if own_receiver:
            runtime = os.environ["ZENOH_RUNTIME"]
            os.environ["ZENOH_RUNTIME"] = runtime.replace("rx:(handover:app)", "rx:(worker_threads:1)")
        self._lockstep = lockstep
        self._session = _open(listen, connect, lockstep)
        self._inboxes: list[Inbox] = []
        self._kept: list[object] = []  # what is declared lives as long as the session

    def subscribe(self, keys: str | Iterable[str], receive: Receive) -> None:
        """Calls `receive` with what is put under any of `keys`, in Zenoh's thread.  Exact keys are cheaper than wildcards."""

        def handle(sample: zenoh.Sample) -> None:
            if not hasattr(_thread, "state"):
                # Keeps Python's state of this thread: made and unmade for every message, it costs more than the message.
                _thread.state = ctypes.pythonapi.PyGILState_Ensure()
            receive(sample.payload.to_bytes())

        for key in [keys] if isinstance(keys, str) else keys:
            handler = zenoh.handlers.Callback(handle, indirect=False)
            self._kept.append(self._session.declare_subscriber(key, handler))

    def inbox(self, keys: str | Iterable[str], high_water: int = 1024) -> Inbox:
        """Returns an inbox for what is put under any of `keys`.  In lockstep, all that this process receives stands still
        while it is full: its owner must keep taking, and wait for nothing else."""
        # Zenoh's thread needs the interpreter for every payload; its owner, busy, would let go of it only every 5 ms.
        sys.setswitchinterval(1e-4)
        inbox = Inbox(high_water, self._lockstep)
        self._inboxes.append(inbox)
        self.subscribe(keys, inbox._receive)
        return inbox

    def publisher(self, key: str) -> Publisher:
        """Declares that this process will put payloads under `key`."""
        control = zenoh.CongestionControl.BLOCK if self._lockstep else zenoh.CongestionControl.DROP
        publisher = self._session.declare_publisher(key, congestion_control=control)
        self._kept.append(publisher)
        return Publisher(publisher)

    def declare_token(self, key: str) -> None:
        """Shows that this process is alive until its session ends.  Whoever sees it reaches all declared before it."""
        self._kept.append(self._session.liveliness().declare_token(key))

    def watch_tokens(self, key: str, on_lost: Callable[[str], None] | None = None) -> Tokens:
        """Follows the tokens under `key`.  `on_lost` is called, in a thread of its own, with the key of each that ends."""
        tokens = Tokens(on_lost)
        self._kept.append(self._session.liveliness().declare_subscriber(key, tokens._receive, history=True))
        return tokens

    def close(self) -> None:
        """Ends the connection after delivering what was put.  Not to be called from a handler."""
        for inbox in self._inboxes:
            inbox._let_go()
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def loopback_endpoints(count: int) -> list[str]:
    """Returns endpoints for the processes of one run on this machine, free at the moment of asking.

    TCP, for a Unix socket wakes the sender's thread whenever the receiver has read.  Every run draws an address of its
    own in 127.0.0.0/8, so that runs do not meet.
    """
    host = f"127.{random.randint(1, 254)}.{random.randint(0, 255)}.{random.randint(1, 254)}"
    probes = [socket.create_server((host, 0)) for _ in range(count)]
    endpoints = [f"tcp/{host}:{probe.getsockname()[1]}" for probe in probes]
    for probe in probes:
        probe.close()
    return endpoints


def _prefer_throughput() -> None:
    """Lets a woken process wait its turn instead of interrupting the one that woke it.  Needs no privilege."""
    if os.sched_getscheduler(0) == os.SCHED_OTHER:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _open(listen: Sequence[str], connect: Sequence[str], lockstep: bool) -> zenoh.Session:
    for endpoint in [*listen, *connect]:
        _check(endpoint)
    settings: dict[str, object] = {
        "mode": "peer",
        "listen/endpoints": list(listen),
        "connect/endpoints": list(connect),
        "connect/timeout_ms": -1,  # in the background, for ever
        "connect/exit_on_failure": False,
        "connect/retry": {"period_init_ms": 5, "period_max_ms": 20, "period_increase_factor": 2},
        "scouting/multicast/enabled": False,
        "scouting/gossip/enabled": False,
        "transport/shared_memory/enabled": False,
        # Not the low-latency transport: its put moves to another thread when it is called in Zenoh's own.
        "transport/unicast/lowlatency": False,
        "transport/unicast/qos/enabled": not lockstep,
        # Each received message holds one 64 KiB buffer until it is taken.  With a single one (the default) nearly every
        # message allocates and clears a new one.
        "transport/link/rx/buffer_size": 4 * 65536,
    }
    if lockstep:
        # Whoever is stopped is waited for, with all that was put for it; the run's supervisor decides when to give up.
        settings["transport/link/tx/lease"] = LEASE_MS
        settings["transport/link/tx/queue/congestion_control/block/wait_before_close"] = LEASE_MS * 1000
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ValueError(f"cannot listen on {', '.join(listen) or 'nothing'}: {error}") from error


def _check(endpoint: str) -> None:
    """Raises ValueError for what Zenoh would try again and again in the background, or report without the endpoint."""
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
