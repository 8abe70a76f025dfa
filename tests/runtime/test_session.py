"""The session: payloads arrive whole and in order, tokens show which processes are alive, and only lockstep blocks."""

from __future__ import annotations

import multiprocessing
import os
import queue
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from echelon.runtime.inbox import Inbox
from echelon.runtime.session import Session, loopback_endpoints

TIMEOUT_S = 600.0
_spawn = multiprocessing.get_context("spawn")
Body = Callable[[str, Connection], None]


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as found:
        yield found


def pair(stack: ExitStack, *, lockstep: bool = True, endpoint: str | None = None) -> tuple[Session, Session]:
    """Returns two sessions that are connected to each other; the first listens."""
    endpoints = [endpoint] if endpoint else loopback_endpoints(1)
    first = stack.enter_context(Session(listen=endpoints, connect=[], lockstep=lockstep))
    second = stack.enter_context(Session(listen=[], connect=endpoints, lockstep=lockstep))
    return first, second


def ready(receiver: Session, sender: Session) -> None:
    """Waits until the sender knows all that the receiver has declared."""
    receiver.declare_token("run/@alive/receiver")
    assert awaited(sender, "run/@alive/receiver") == set()


def inbox_of(session: Session, key: str, high_water: int = 1024) -> Inbox[bytes]:
    """Returns an inbox that keeps all payloads under a key."""
    return session.checked_inbox({key: bytes}, high_water)


def taken(inbox: Inbox, count: int) -> list[bytes]:
    """Returns `count` payloads from an inbox, or fewer if the others do not come in time."""
    deadline_s = time.monotonic() + TIMEOUT_S
    payloads: list[bytes] = []
    while len(payloads) < count and time.monotonic() < deadline_s:
        payloads += inbox.take(deadline_s - time.monotonic())
    return payloads


def awaited(session: Session, *keys: str, timeout_s: float = TIMEOUT_S) -> set[str]:
    """Returns the keys that have no token in time."""
    return session.watch_tokens("run/@alive/**").wait(keys, timeout_s)


def child(stack: ExitStack, body: Body, endpoint: str) -> tuple[multiprocessing.process.BaseProcess, Connection]:
    """Starts another process at the other end of a connection; it ends with the test at the latest."""
    here, there = _spawn.Pipe()
    process = _spawn.Process(target=body, args=(endpoint, there), daemon=True)
    process.start()

    def end() -> None:
        process.kill()
        process.join()

    stack.callback(end)
    return process, here


def hears(connection: Connection) -> object:
    """Returns the next message of a child process."""
    assert connection.poll(TIMEOUT_S), "the other process says nothing"
    return connection.recv()


@pytest.mark.parametrize("lockstep", [True, False])
@pytest.mark.parametrize("transport", ["tcp", "unix"])
def test_payloads_arrive_whole_and_in_order(stack: ExitStack, tmp_path: Path, lockstep: bool, transport: str) -> None:
    endpoint = f"unixsock-stream/{tmp_path}/s" if transport == "unix" else None
    first, second = pair(stack, lockstep=lockstep, endpoint=endpoint)
    inbox = inbox_of(first, "run/g1/r1/state")
    ready(first, second)
    publisher = second.publisher("run/g1/r1/state")
    sent = [bytes([number]) * (number + 1) for number in range(200)]
    for payload in sent:
        publisher.put(payload)
    assert taken(inbox, len(sent)) == sent
    assert inbox.take(0) == []


def test_take_waits_at_most_its_timeout(stack: ExitStack) -> None:
    session = stack.enter_context(Session(listen=[], connect=[], lockstep=True))
    before = time.monotonic()
    assert inbox_of(session, "run/state").take(0.05) == []
    assert time.monotonic() - before >= 0.05


def test_a_handler_may_put(stack: ExitStack) -> None:
    first, second = pair(stack)
    answers = inbox_of(second, "run/answer")
    answer = first.publisher("run/answer").put
    first.subscribe(["run/question", "run/other"], lambda payload: answer(payload + b"!"))
    second.declare_token("run/@alive/second")
    assert awaited(first, "run/@alive/second") == set()
    ready(first, second)
    asked = second.publisher("run/question").put, second.publisher("run/other").put
    for number in range(100):
        asked[number % 2](b"%d" % number)
    assert taken(answers, 100) == [b"%d!" % number for number in range(100)]


def test_a_session_receives_its_own_payloads(stack: ExitStack) -> None:
    session = stack.enter_context(Session(listen=[], connect=[], lockstep=True))
    inbox = inbox_of(session, "run/**")
    session.publisher("run/state").put(b"x")
    assert taken(inbox, 1) == [b"x"]


@pytest.mark.parametrize("lockstep", [True, False])
def test_long_payloads_arrive(stack: ExitStack, lockstep: bool) -> None:
    first, second = pair(stack, lockstep=lockstep)
    inbox = inbox_of(first, "run/state")
    ready(first, second)
    publisher, found = second.publisher("run/state"), list[bytes]()
    for _ in range(1 if lockstep else 600):  # on a wall clock a busy machine may drop a message
        publisher.put(bytes(1_000_000))
        if found := inbox.take(TIMEOUT_S if lockstep else 1.0):
            break
    assert found[0] == bytes(1_000_000)


@pytest.mark.parametrize(
    "endpoint",
    [
        "carrier-pigeon/loft:1",
        "tcp/localhost",
        "tcp/localhost:http",
        "tcp/localhost:99999",
        "unixsock-stream/",
        "unixsock-stream//tmp/" + "x" * 103,
        "unixsock-stream//does/not/exist/s",
        "",
    ],
)
def test_a_bad_endpoint_is_named(endpoint: str) -> None:
    with pytest.raises(ValueError, match=r"endpoint|cannot listen") as caught:
        Session(listen=[endpoint], connect=[], lockstep=True)
    assert endpoint in str(caught.value)


def test_an_endpoint_in_use_is_named(stack: ExitStack) -> None:
    (endpoint,) = loopback_endpoints(1)
    stack.enter_context(Session(listen=[endpoint], connect=[], lockstep=True))
    with pytest.raises(ValueError, match=endpoint.replace(".", r"\.")):
        Session(listen=[endpoint], connect=[], lockstep=True)


def test_missing_tokens_are_named(stack: ExitStack) -> None:
    first, second = pair(stack)
    first.declare_token("run/@alive/1/robot/a/77")
    wanted = ["run/@alive/1/robot/a/*", "run/@alive/1/robot/b/*"]
    assert awaited(second, wanted[0]) == set()
    assert awaited(second, *wanted, timeout_s=0.05) == {"run/@alive/1/robot/b/*"}


def _listen_late(endpoint: str, parent: Connection) -> None:
    with Session(listen=[endpoint], connect=[], lockstep=True) as session:
        inbox = inbox_of(session, "run/state")
        session.declare_token("run/@alive/late")
        parent.send(taken(inbox, 100))


def test_nothing_is_lost_after_the_tokens_in_any_order_of_connecting(stack: ExitStack) -> None:
    (endpoint,) = loopback_endpoints(1)
    session = stack.enter_context(Session(listen=[], connect=[endpoint], lockstep=True))
    _, parent = child(stack, _listen_late, endpoint)
    assert awaited(session, "run/@alive/late") == set()
    publisher = session.publisher("run/state")
    sent = [b"%d" % number for number in range(100)]
    for payload in sent:
        publisher.put(payload)
    assert hears(parent) == sent


def _put_and_close(endpoint: str, parent: Connection) -> None:
    with Session(listen=[], connect=[endpoint], lockstep=True) as session:
        assert awaited(session, "run/@alive/receiver") == set()
        publisher = session.publisher("run/state")
        for number in range(100):
            publisher.put(b"%d" % number)


def test_close_delivers_what_was_put_last(stack: ExitStack) -> None:
    (endpoint,) = loopback_endpoints(1)
    session = stack.enter_context(Session(listen=[endpoint], connect=[], lockstep=True))
    inbox = inbox_of(session, "run/state")
    session.declare_token("run/@alive/receiver")
    process, _ = child(stack, _put_and_close, endpoint)
    assert taken(inbox, 100) == [b"%d" % number for number in range(100)]
    process.join(TIMEOUT_S)
    assert process.exitcode == 0


def _be_there(endpoint: str, parent: Connection) -> None:
    with Session(listen=[], connect=[endpoint], lockstep=True) as session:
        session.declare_token("run/@alive/victim")
        parent.recv()


def test_the_token_of_a_killed_process_is_lost(stack: ExitStack) -> None:
    (endpoint,) = loopback_endpoints(1)
    session = stack.enter_context(Session(listen=[endpoint], connect=[], lockstep=True))
    lost: queue.Queue[str] = queue.Queue()
    tokens = session.watch_tokens("run/@alive/**", lost.put)
    process, _ = child(stack, _be_there, endpoint)
    assert tokens.wait(["run/@alive/victim"], TIMEOUT_S) == set()
    assert tokens.alive() == {"run/@alive/victim"}
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    assert lost.get(timeout=TIMEOUT_S) == "run/@alive/victim"
    assert tokens.alive() == frozenset()


def _flood(endpoint: str, parent: Connection) -> None:
    with Session(listen=[], connect=[endpoint], lockstep=True) as session:
        assert awaited(session, "run/@alive/receiver") == set()
        publisher = session.publisher("run/state")
        for number in range(1000):
            parent.send(number)  # sent before the put
            publisher.put(number.to_bytes(4, "little") + bytes(40_000))
        parent.send(None)
        parent.recv()  # keeps the process alive: its end would close the pipe while the parent still reads


def test_back_pressure_slows_the_sender_and_loses_nothing(stack: ExitStack) -> None:
    (endpoint,) = loopback_endpoints(1)
    session = stack.enter_context(Session(listen=[endpoint], connect=[], lockstep=True))
    inbox = inbox_of(session, "run/state", 8)
    session.declare_token("run/@alive/receiver")
    _, parent = child(stack, _flood, endpoint)
    begun = -1
    while parent.poll(0.3 if begun > 50 else TIMEOUT_S):  # until the sender is blocked
        found = parent.recv()
        assert found is not None, "nothing held the sender back"
        begun = found
    assert begun < 900  # 40 kB each: the sockets of both ends hold some, the inbox 8
    numbers: list[int] = []
    while len(numbers) < 1000:
        while parent.poll():
            parent.recv()  # otherwise the messages of the child would fill the pipe
        payloads = inbox.take(TIMEOUT_S)
        assert 0 < len(payloads) <= 8 + 1
        numbers += [int.from_bytes(payload[:4], "little") for payload in payloads]
    assert numbers == list(range(1000))


class _Room(threading.Event):
    """An event that shows when a thread waits for it."""

    def __init__(self) -> None:
        super().__init__()
        self.waited_for = threading.Event()

    def wait(self, timeout: float | None = None) -> bool:
        self.waited_for.set()
        return super().wait(timeout)


def test_a_session_with_a_full_inbox_can_be_closed(stack: ExitStack) -> None:
    (endpoint,) = loopback_endpoints(1)
    session = Session(listen=[endpoint], connect=[], lockstep=True)
    closing = threading.Thread(target=session.close, daemon=True)
    inbox = inbox_of(session, "run/state", 8)
    room = inbox._room = _Room()
    session.declare_token("run/@alive/receiver")
    _, _flood_says = child(stack, _flood, endpoint)
    assert room.waited_for.wait(TIMEOUT_S), "nothing held the sender back"
    closing.start()
    closing.join(TIMEOUT_S)
    assert not closing.is_alive()


def _relay(endpoint: str, parent: Connection) -> None:
    with Session(listen=[endpoint], connect=[], lockstep=True, own_receiver=True) as session:
        inbox = inbox_of(session, "run/state", 8)
        assert awaited(session, "run/@alive/end") == set()
        publisher = session.publisher("run/relayed")
        session.declare_token("run/@alive/receiver")
        for _ in range(1000):
            for payload in inbox.take(TIMEOUT_S):
                publisher.put(payload)
        parent.recv()


def test_a_relay_that_is_blocked_on_both_sides_goes_on(stack: ExitStack) -> None:
    (endpoint,) = loopback_endpoints(1)
    child(stack, _relay, endpoint)
    session = stack.enter_context(Session(listen=[], connect=[endpoint], lockstep=True))
    inbox = inbox_of(session, "run/relayed", 8)
    session.declare_token("run/@alive/end")
    _, flood = child(stack, _flood, endpoint)
    begun = -1
    while flood.poll(
        0.5 if begun > 100 else TIMEOUT_S
    ):  # until all are blocked: the relay in a put, and its inbox is full
        found = flood.recv()
        assert found is not None, "nothing held the sender back"
        begun = found
    numbers: list[int] = []
    while len(numbers) < 1000:
        while flood.poll():
            flood.recv()
        payloads = inbox.take(TIMEOUT_S)
        assert payloads, "the relay sends nothing more"
        numbers += [int.from_bytes(payload[:4], "little") for payload in payloads]
    assert numbers == list(range(1000))


def test_on_the_wall_clock_the_newest_are_kept(stack: ExitStack) -> None:
    session = stack.enter_context(Session(listen=[], connect=[], lockstep=False))
    inbox: Inbox = inbox_of(session, "run/state", 4)
    publisher = session.publisher("run/state")
    for number in range(100):
        publisher.put(b"%d" % number)
    assert taken(inbox, 4) == [b"96", b"97", b"98", b"99"]
    assert inbox.dropped == 96


def _stop_there(endpoint: str, parent: Connection) -> None:
    with Session(listen=[], connect=[endpoint], lockstep=False) as session:
        inbox_of(session, "run/state")
        session.declare_token("run/@alive/stopped")
        parent.recv()


def test_on_the_wall_clock_a_stopped_peer_blocks_no_put(stack: ExitStack) -> None:
    (endpoint,) = loopback_endpoints(1)
    session = stack.enter_context(Session(listen=[endpoint], connect=[], lockstep=False))
    inbox = inbox_of(session, "run/state")
    process, _ = child(stack, _stop_there, endpoint)
    assert awaited(session, "run/@alive/stopped") == set()
    assert process.pid is not None
    os.kill(process.pid, signal.SIGSTOP)
    publisher = session.publisher("run/state")
    longest = 0.0
    for _ in range(500):  # 20 MB, more than the sockets hold
        before = time.monotonic()
        publisher.put(bytes(40_000))
        longest = max(longest, time.monotonic() - before)
    assert longest < 0.5
    assert taken(inbox, 1)
