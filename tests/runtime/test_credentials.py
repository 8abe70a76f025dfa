"""Credentials: a session lets in and hears only those that it knows, each under its own keys."""

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace

import pytest

from echelon.runtime.credentials import Credentials, Identity, new_identity
from echelon.runtime.session import Session, loopback_endpoints
from support.plain_zenoh import plain_session
from support.runs import until

HOST = new_identity("leader/g1", ("run/g1", "run/@alive/g1"))
GUEST = new_identity("robot/g1/r1", ("run/g1/r1/state", "run/@alive/r1"))
REALM = ("run/**", "run/@alive/**")


@pytest.fixture
def endpoint() -> str:
    return loopback_endpoints(1)[0]


@pytest.fixture
def stack() -> Iterator[ExitStack]:
    with ExitStack() as opened:
        yield opened


def opened(stack: ExitStack, endpoint: str, own: Identity, **knows: tuple[Identity, ...]) -> Session:
    """Returns a session that listens if it knows guests, and connects if it knows hosts."""
    ends = {"listen": [endpoint] if "guests" in knows else [], "connect": [endpoint] if "hosts" in knows else []}
    return stack.enter_context(Session(**ends, lockstep=True, credentials=Credentials(own, REALM, **knows)))


def heard(session: Session, key: str = "run/**") -> list[bytes]:
    """Returns a list that grows with what the session hears."""
    payloads: list[bytes] = []
    session.subscribe(key, payloads.append)
    return payloads


def meet(one: Session, other: Session, of_one: str, of_other: str, within_s: float = 30.0) -> bool:
    """Shows tokens on both sides; returns whether they see each other in time."""
    seen = one.watch_tokens("run/@alive/**"), other.watch_tokens("run/@alive/**")
    one.declare_token(of_one)
    other.declare_token(of_other)
    return not seen[0].wait([of_other], within_s) and not seen[1].wait([of_one], within_s)


def test_those_who_know_each_other_hear_what_each_may_say_and_nothing_else(stack: ExitStack, endpoint: str) -> None:
    host = opened(stack, endpoint, HOST, guests=(GUEST,))
    guest = opened(stack, endpoint, GUEST, hosts=(HOST,))
    by_host, by_guest = heard(host), heard(guest)
    assert meet(host, guest, "run/@alive/g1", "run/@alive/r1")
    for session, key, payload in (
        (guest, "run/g1", b"forged by the guest"),
        (guest, "run/g1/r2/state", b"forged by the guest"),
        (guest, "run/g1/r1/state", b"the guest's own"),
        (host, "run/g1/r1/state", b"forged by the host"),
        (host, "run/g1", b"the host's own"),
    ):
        session.publisher(key).put(payload)
    assert until(lambda: b"the guest's own" in by_host and b"the host's own" in by_guest)
    assert b"forged by the guest" not in by_host
    assert b"forged by the host" not in by_guest


@pytest.mark.parametrize("keys", [(), ("run/g1/r1/state",)])
def test_a_guest_says_its_own_keys_alone_whatever_it_does_with_its_secret(
    stack: ExitStack, endpoint: str, keys: tuple[str, ...]
) -> None:
    """Also one that may only read.  Its session is Zenoh's own, so that nothing holds it back but the host."""
    reader = new_identity("observer", keys)
    host = opened(stack, endpoint, HOST, guests=(reader, GUEST))
    guest = opened(stack, endpoint, GUEST, hosts=(HOST,))
    assert meet(host, guest, "run/@alive/g1", "run/@alive/r1")
    by_host, by_reader = heard(host), list[bytes]()
    plain = stack.enter_context(plain_session([endpoint], reader))
    plain.declare_subscriber("run/**", lambda sample: by_reader.append(bytes(sample.payload)))

    def reads() -> bool:
        host.publisher("run/g1").put(b"for all")
        return b"for all" in by_reader

    assert until(reads)
    for key in ("run/g1/r1/state", "run/g1/r2/state", "run/g1"):
        plain.put(key, key)
    plain.put("run/g1/r1/state", "last")
    guest.publisher("run/g1/r1/state").put(b"true")
    assert until(lambda: b"true" in by_host and (not keys or b"last" in by_host))
    assert [one for one in by_host if one not in (b"true", b"for all")] == (
        [b"run/g1/r1/state", b"last"] if keys else []
    )


@pytest.mark.parametrize("who", ["without a secret", "with a wrong password", "unknown", "with a stolen name"])
def test_strangers_neither_hear_nor_are_heard(stack: ExitStack, endpoint: str, who: str) -> None:
    host = opened(stack, endpoint, HOST, guests=(GUEST,))
    if who == "without a secret":
        stranger = stack.enter_context(Session(listen=[], connect=[endpoint], lockstep=True))
    else:
        identity = {
            "with a wrong password": replace(GUEST, password="wrong"),
            "unknown": new_identity("robot/g1/r9", GUEST.keys),
            "with a stolen name": new_identity(GUEST.user, GUEST.keys),
        }[who]
        stranger = opened(stack, endpoint, identity, hosts=(HOST,))
    by_host, by_stranger = heard(host), heard(stranger)
    assert not meet(host, stranger, "run/@alive/g1", "run/@alive/r1", 1.0)
    guest = opened(stack, endpoint, GUEST, hosts=(HOST,))
    assert meet(host, guest, "run/@alive/g1", "run/@alive/r1")  # the stranger keeps nobody out
    stranger.publisher("run/g1/r1/state").put(b"forged")
    host.publisher("run/g1").put(b"secret")
    guest.publisher("run/g1/r1/state").put(b"true")
    assert until(lambda: b"true" in by_host)
    assert b"forged" not in by_host
    assert b"secret" not in by_stranger


def test_who_sits_at_the_port_of_the_host_is_not_believed(stack: ExitStack, endpoint: str) -> None:
    """A program that took the port first lets everybody in, and publishes as if it were the host."""
    impostor = stack.enter_context(Session(listen=[endpoint], connect=[], lockstep=True))
    guest = opened(stack, endpoint, GUEST, hosts=(HOST,))
    by_guest = heard(guest)
    assert not meet(impostor, guest, "run/@alive/g1", "run/@alive/r1", 1.0)
    impostor.publisher("run/g1").put(b"forged")
    with pytest.raises(ValueError, match="cannot listen on"):
        opened(stack, endpoint, HOST, guests=(GUEST,))
    assert b"forged" not in by_guest


def test_secrets_are_not_shown() -> None:
    assert GUEST.password not in repr(Credentials(HOST, REALM, guests=(GUEST,)))
    assert len({new_identity("a", ()).password for _ in range(50)}) == 50
    assert all(new_identity("a", ()).zenoh_id[0] != "0" for _ in range(200))
    for user in ("", "a:b", "a\nb"):
        with pytest.raises(ValueError, match="expected a name without"):
            new_identity(user, ())
