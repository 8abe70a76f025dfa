"""A process's connection to the others: bytes in, bytes out, and who is alive.

The only module that imports Zenoh. It knows nothing of what the bytes mean. There are two ways to be connected:

- *lockstep* (virtual time): reliable, in order and blocking; a receiver that falls behind slows its senders down.
- *wall clock*: a put never waits for anyone; what a slow or stopped receiver cannot take is dropped, oldest first.

What a message costs is the wake-ups on its way. Received samples therefore go into Zenoh's own channels, so that its
thread needs no GIL, and are taken by the thread that works on them; one worker thread serves all of Zenoh's runtimes.
"""

from __future__ import annotations

import json
import math
import os
import random
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterable, Sequence
from types import TracebackType
from typing import Final, Self

# Read once, when Zenoh is loaded. A second worker thread would be one more hand-over for every message.
os.environ.setdefault(
    "ZENOH_RUNTIME",
    "(rx:(handover:app),tx:(handover:app),acc:(handover:app),net:(handover:app),app:(worker_threads:1))",
)

import zenoh  # noqa: E402 - after its environment

MAX_PAYLOAD: Final = 48_000
"""Longest payload in bytes. The lockstep transport drops, without a word, a message that does not fit one batch, and on
the TCP loopback a batch is 48 KiB."""

_SUN_PATH: Final = 107  # bytes in the path of a Unix socket
_UNBOUNDED: Final = 1 << 20  # samples; a lockstep has only a few under way


class Inbox:
    """Payloads received and not yet taken, in one channel for each key expression. One thread takes."""

    def __init__(self, channels: dict[str, zenoh.handlers.Handler[zenoh.Sample]], session: Session) -> None:
        self._channels = channels
        self._session = session
        self._deadline = math.inf
        self._waiting: str | None = None  # the key whose channel `take` is blocked on
        self._woken = False

    def take(
        self, at_least: int = 1, timeout_s: float | None = None, *, keys: Collection[str] | None = None
    ) -> list[bytes]:
        """Return and forget all that was received, waiting until there are `at_least` payloads.

        With `keys`, some of those subscribed to, wait instead until each of them has delivered something; without, an
        inbox of several keys has to poll. Payloads of one key come in the order they were put. After `timeout_s`, or
        when another thread calls `wake`, what there is is returned. `at_least=0` never waits.
        """
        taken: list[bytes] = []
        if keys is None and len(self._channels) == 1:
            missing = list(self._channels) * at_least
        else:
            missing = list(keys or ())
        if missing or (keys is None and at_least):
            if timeout_s is not None:
                self._deadline = time.monotonic() + timeout_s
                self._session._alarm.expect(self._deadline)
            if missing:
                self._wait_for(missing, taken)
            else:
                self._poll(at_least, taken)
            self._deadline, self._waiting, self._woken = math.inf, None, False
        self._drain(taken)
        return taken

    def _drain(self, taken: list[bytes]) -> None:
        for channel in self._channels.values():
            while (sample := channel.try_recv()) is not None:
                if payload := sample.payload.to_bytes():  # an empty one only ends a wait, see `_end_wait`
                    taken.append(payload)

    def _wait_for(self, missing: list[str], taken: list[bytes]) -> None:
        # The last is waited for first: when it delivers, the others mostly have, and there was one wake-up for all.
        while missing:
            self._waiting = key = missing[-1]
            if self._expired():
                return
            if payload := self._channels[key].recv().payload.to_bytes():
                taken.append(payload)
                missing.pop()

    def _poll(self, at_least: int, taken: list[bytes]) -> None:
        self._drain(taken)
        while len(taken) < at_least and not self._expired():
            time.sleep(5e-5)
            self._drain(taken)

    def _expired(self) -> bool:
        return self._woken or (self._deadline != math.inf and time.monotonic() >= self._deadline)

    def wake(self) -> None:
        """Make a `take` that waits, or else the next one that would, return with what there is. For any thread."""
        self._woken = True
        self._end_wait()

    def _end_wait(self) -> None:
        # A channel cannot be waited for with a timeout; an empty payload, which no publisher puts, makes it return.
        if (key := self._waiting) is not None:
            self._session._session.put(key, b"", allowed_destination=zenoh.Locality.SESSION_LOCAL)


class Publisher:
    """Sends payloads under one key."""

    def __init__(self, publisher: zenoh.Publisher) -> None:
        self._put = publisher.put

    def put(self, payload: bytes) -> None:
        """Send `payload` to every subscriber of the key; in lockstep, wait for those that are behind."""
        if not 0 < len(payload) <= MAX_PAYLOAD:
            raise ValueError(f"a payload has 1 to {MAX_PAYLOAD} bytes, not {len(payload)}")
        self._put(payload)


class Tokens:
    """The liveliness tokens under one key expression, kept up to date."""

    def __init__(self, on_lost: Callable[[str], None] | None) -> None:
        self._alive: set[str] = set()
        self._changed = threading.Condition()
        self._on_lost = on_lost

    def alive(self) -> frozenset[str]:
        """Keys of the tokens that exist now."""
        with self._changed:
            return frozenset(self._alive)

    def wait(self, keys: Iterable[str], timeout_s: float) -> set[str]:
        """Wait until each of `keys` (which may hold wildcards) has a token; return those that have none in time."""
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

    Endpoints read `tcp/host:port` or `unixsock-stream//path`. Data and tokens reach the processes at the other end of
    its own links and no further.
    """

    def __init__(self, *, listen: Sequence[str], connect: Sequence[str], lockstep: bool) -> None:
        if lockstep:
            _prefer_throughput()
        self._lockstep = lockstep
        self._session = _open(listen, connect, lockstep)
        self._alarm = _Alarm()
        self._kept: list[object] = []  # what is declared lives as long as the session

    def subscribe(self, keys: str | Iterable[str], *, backpressure: bool = False, high_water: int = 1024) -> Inbox:
        """Receive what is put under any of `keys`. Exact keys are cheaper than wildcards.

        On the wall clock the newest `high_water` payloads of each key are kept. In lockstep all are; with
        `backpressure`, when there are `high_water` of a key, *everything* this process receives stands still, and then
        those who send to it, until something is taken: only for a process that takes and waits for nothing else.
        """
        channels: dict[str, zenoh.handlers.Handler[zenoh.Sample]] = {}
        for key in [keys] if isinstance(keys, str) else keys:
            if self._lockstep:
                subscriber = self._session.declare_subscriber(
                    key, zenoh.handlers.FifoChannel(high_water if backpressure else _UNBOUNDED)
                )
            else:
                subscriber = self._session.declare_subscriber(key, zenoh.handlers.RingChannel(high_water))
            self._kept.append(subscriber)
            channels[key] = subscriber.handler
        inbox = Inbox(channels, self)
        self._alarm.add(inbox)
        return inbox

    def publisher(self, key: str) -> Publisher:
        """Declare that this process will put payloads under `key`."""
        control = zenoh.CongestionControl.BLOCK if self._lockstep else zenoh.CongestionControl.DROP
        publisher = self._session.declare_publisher(key, congestion_control=control)
        self._kept.append(publisher)
        return Publisher(publisher)

    def declare_token(self, key: str) -> None:
        """Show that this process is alive until its session ends. Who sees the token reaches all declared before it."""
        self._kept.append(self._session.liveliness().declare_token(key))

    def watch_tokens(self, key: str, on_lost: Callable[[str], None] | None = None) -> Tokens:
        """Follow the tokens under `key`. `on_lost` is called, in a thread of its own, with the key of one that ends."""
        tokens = Tokens(on_lost)
        self._kept.append(self._session.liveliness().declare_subscriber(key, tokens._receive, history=True))
        return tokens

    def await_tokens(self, keys: Iterable[str], timeout_s: float) -> set[str]:
        """Wait until each of `keys` (which may hold wildcards) has a token; return those that have none in time."""
        keys = list(keys)
        tokens = Tokens(None)
        liveliness = self._session.liveliness()
        watching = [liveliness.declare_subscriber(key, tokens._receive, history=True) for key in keys]
        missing = tokens.wait(keys, timeout_s)
        for subscriber in watching:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
        return missing

    def close(self) -> None:
        """End the connection after delivering what was put. Not to be called from `on_lost`."""
        self._alarm.stop()
        self._session.close()  # type: ignore[no-untyped-call]

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def loopback_endpoints(count: int) -> list[str]:
    """Endpoints for the processes of one run on this machine, free at the moment of asking.

    TCP, because a Unix socket also wakes the sender's thread whenever the receiver has read: slower in lockstep. Every
    run draws an address of its own in 127.0.0.0/8, so that runs do not meet.
    """
    host = f"127.{random.randint(1, 254)}.{random.randint(0, 255)}.{random.randint(1, 254)}"
    probes = [socket.create_server((host, 0)) for _ in range(count)]
    endpoints = [f"tcp/{host}:{probe.getsockname()[1]}" for probe in probes]
    for probe in probes:
        probe.close()
    return endpoints


class _Alarm:
    """Ends the waits of inboxes at their deadlines. Its thread sleeps until the earliest: a wait costs nothing more."""

    def __init__(self) -> None:
        self._inboxes: list[Inbox] = []
        self._next = math.inf
        self._changed = threading.Condition()
        self._thread: threading.Thread | None = None
        self._stopped = False

    def add(self, inbox: Inbox) -> None:
        with self._changed:
            self._inboxes.append(inbox)

    def expect(self, deadline: float) -> None:
        if deadline < self._next:  # rarely: deadlines mostly move on, and the thread sees the new one when it wakes
            with self._changed:
                self._next = deadline
                if self._thread is None:
                    self._thread = threading.Thread(target=self._run, name="inbox-alarm", daemon=True)
                    self._thread.start()
                self._changed.notify()

    def stop(self) -> None:
        with self._changed:
            self._stopped = True
            self._changed.notify()
        if self._thread is not None:
            self._thread.join()

    def _run(self) -> None:
        with self._changed:
            while not self._stopped:
                now = time.monotonic()
                self._next = math.inf  # before the deadlines are read: one set from here on is compared with it
                for inbox in self._inboxes:
                    deadline = inbox._deadline
                    if deadline <= now:
                        inbox._end_wait()
                        deadline = now + 1e-3  # once more, should it have been between two channels
                    self._next = min(self._next, deadline)
                self._changed.wait(None if self._next == math.inf else self._next - now)


def _prefer_throughput() -> None:
    """Let a woken process wait its turn instead of interrupting the one that woke it. Needs no privilege."""
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
        "transport/unicast/lowlatency": lockstep,
        "transport/unicast/qos/enabled": not lockstep,  # excluded by lowlatency
        "transport/shared_memory/enabled": False,
        # Each received message holds one 64 KiB buffer until it is taken. With a single one (the default) nearly every
        # message allocates and clears a new one.
        "transport/link/rx/buffer_size": 4 * 65536,
    }
    if lockstep:
        # A process whose inbox is full sends no keep-alive either; a crash shows at once by the closed socket.
        settings["transport/link/tx/lease"] = 60_000
    config = zenoh.Config()
    for name, value in settings.items():
        config.insert_json5(name, json.dumps(value))
    try:
        return zenoh.open(config)
    except zenoh.ZError as error:
        raise ValueError(f"cannot listen on {', '.join(listen) or 'nothing'}: {error}") from error


def _check(endpoint: str) -> None:
    """Raise ValueError for what Zenoh would try again and again in the background, or report without the endpoint."""
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
