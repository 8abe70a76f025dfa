"""SDO, compared with client and server of the package `canopen`."""

from typing import Any

import canopen
import pytest
from canopen.objectdictionary import ODVariable
from canopen.sdo.client import SdoClient as ForeignClient
from canopen.sdo.exceptions import SdoAbortedError
from hypothesis import given
from hypothesis import strategies as st

from echelon.bridge.protocols.cia402.sdo import (
    MAX_DOWNLOAD,
    Abort,
    Key,
    SdoClient,
    SdoError,
    SdoServer,
    abort,
    abort_code,
    written,
)

KEY = (0x2345, 6)
contents = st.binary(min_size=1, max_size=60)


class Store:
    """Objects of any length; reading a missing one is refused."""

    def __init__(self, objects: dict[Key, bytes] | None = None) -> None:
        self.objects = objects or {}

    def read(self, key: Key) -> bytes:
        if key not in self.objects:
            raise SdoError(Abort.NO_OBJECT)
        return self.objects[key]

    def write(self, key: Key, data: bytes) -> None:
        if key[1] == 0xFF:
            raise SdoError(Abort.READ_ONLY)
        self.objects[key] = data

    def server(self) -> SdoServer:
        return SdoServer(self.read, self.write)


def talk(client: SdoClient, server: SdoServer, request: bytes | None) -> list[bytes]:
    """Passes frames between client and server until the transfer is over; returns all of them."""
    passed = []
    while request is not None:
        answer = server.answer(request)
        passed += [request, answer or b""]
        request = None if answer is None else client.receive(answer)
    assert not client.busy
    return passed


def test_known_bytes() -> None:
    store = Store({(0x1000, 0): bytes.fromhex("92010200"), (0x1008, 0): b"echelon drive"})
    server, client = store.server(), SdoClient()
    assert [frame.hex() for frame in talk(client, server, client.upload((0x1000, 0)))] == [
        "4000100000000000",
        "4300100092010200",
    ]
    assert [frame.hex() for frame in talk(client, server, client.upload((0x1008, 0)))] == [
        "4008100000000000",
        "410810000d000000",
        "6000000000000000",
        "00" + b"echelon".hex(),
        "7000000000000000",
        "13" + b" drive\0".hex(),
    ]
    assert client.data == b"echelon drive"
    assert [frame.hex() for frame in talk(client, server, client.download((0x6071, 0), b"\xf4\x01"))] == [
        "2b716000f4010000",
        "6071600000000000",
    ]
    assert [frame.hex() for frame in talk(client, server, client.upload((0x7777, 7)))] == [
        "4077770700000000",
        "8077770700000206",
    ]
    assert client.abort == 0x06020000


@given(contents)
def test_there_and_back(data: bytes) -> None:
    store, client = Store(), SdoClient()
    server = store.server()
    talk(client, server, client.download(KEY, data))
    assert client.abort is None
    assert store.objects == {KEY: data}
    talk(client, server, client.upload(KEY))
    assert (client.abort, client.data) == (None, data)


class Wire(canopen.Network):
    """The package's network.  It keeps the frames that it sends, or has our server answer them at once."""

    def __init__(self, server: SdoServer | None = None) -> None:
        super().__init__()
        self.server = server
        self.client: Any = None
        self.sent: list[bytes] = []

    def send_message(self, can_id: int, data: bytes, remote: bool = False) -> None:
        self.sent.append(bytes(data))
        if self.server is not None:
            answer = self.server.answer(bytes(data))
            if answer is not None:
                self.client.on_response(0x585, answer, 0.0)


@given(contents)
def test_the_packages_client_at_our_server(data: bytes) -> None:
    store = Store()
    wire = Wire(store.server())
    wire.client = client = ForeignClient(0x605, 0x585, canopen.ObjectDictionary())
    client.network = wire
    client.download(*KEY, data)
    assert store.objects == {KEY: data}
    assert client.upload(*KEY) == data
    with pytest.raises(SdoAbortedError) as error:
        client.upload(0x1111, 1)
    assert error.value.code == Abort.NO_OBJECT
    with pytest.raises(SdoAbortedError) as error:
        client.download(0x1111, 0xFF, data)
    assert error.value.code == Abort.READ_ONLY
    with pytest.raises(SdoAbortedError) as error, client.open(*KEY, "wb", size=80, block_transfer=True) as file:
        file.write(bytes(80))
    assert error.value.code == Abort.COMMAND


@given(contents)
def test_our_client_at_the_packages_server(data: bytes) -> None:
    entry = ODVariable("any", *KEY)
    entry.data_type, entry.access_type = canopen.objectdictionary.DOMAIN, "rw"
    od = canopen.ObjectDictionary()
    record = canopen.objectdictionary.ODRecord("record", KEY[0])
    record.add_member(entry)
    od.add_object(record)
    node, wire, client = canopen.LocalNode(5, od), Wire(), SdoClient()
    node.sdo.network = wire
    for begin in (lambda: client.download(KEY, data), lambda: client.upload(KEY)):
        follows: bytes | None = begin()
        while follows is not None:
            wire.sent.clear()
            node.sdo.on_request(0x605, follows, 0.0)
            follows = client.receive(wire.sent[0])
        assert (client.busy, client.abort) == (False, None)
    assert client.data == data == node.get_data(*KEY)


@given(st.lists(st.binary(min_size=8, max_size=8), max_size=40), st.binary(min_size=8, max_size=30))
def test_segments_in_any_order_never_raise_and_are_refused_or_right(requests: list[bytes], data: bytes) -> None:
    store = Store({KEY: data})
    server, client = store.server(), SdoClient()
    for request in requests:
        answer = server.answer(request)
        assert answer is None or len(answer) == 8
        assert (answer is None) == (request[0] >> 5 == 4)
    assert server.answer(b"") is not None
    talk(client, server, client.upload(KEY))  # a new transfer works whatever happened before
    assert client.data == store.objects[KEY]


def test_a_segment_out_of_turn_ends_the_transfer() -> None:
    store, client = Store(), SdoClient()
    server = store.server()
    first = client.receive(server.answer(client.download(KEY, bytes(range(20)))) or b"")
    assert first is not None
    assert server.answer(first) == bytes.fromhex("2000000000000000")
    assert server.answer(first) == abort(KEY, Abort.TOGGLE)  # the same again
    assert abort_code(server.answer(bytes((first[0] | 0x10,)) + first[1:]) or b"") == Abort.COMMAND
    assert store.objects == {}


def test_length_that_is_not_what_was_said() -> None:
    store = Store()
    server = store.server()
    server.answer(bytes.fromhex("2145230605000000"))  # announces 5 bytes
    assert abort_code(server.answer(bytes.fromhex("01") + bytes(7)) or b"") == Abort.LENGTH
    server.answer(bytes.fromhex("2145230601000100"))  # 65537
    assert abort_code(server.answer(b"\0" * 8) or b"") == Abort.COMMAND
    server.answer(bytes.fromhex("2045230600000000"))  # announces no length
    answers = [server.answer(bytes((number % 2 << 4,)) + bytes(7)) or b"" for number in range(MAX_DOWNLOAD // 7 + 2)]
    assert [abort_code(answer) for answer in answers[-2:]] == [Abort.LENGTH, Abort.COMMAND]
    assert store.objects == {}


def test_client_refuses_what_is_not_its_answer() -> None:
    client = SdoClient()
    with pytest.raises(ValueError, match="waited for"):
        client.receive(bytes(8))
    client.upload(KEY)
    for other in (bytes(8), bytes.fromhex("6045230600000000"), bytes.fromhex("4345230700000000"), abort((1, 2), 3)):
        with pytest.raises(ValueError, match="no answer"):
            client.receive(other)
    assert client.busy
    assert client.receive(abort(KEY, 0x06010000)) is None
    assert (client.busy, client.abort) == (False, 0x06010000)
    with pytest.raises(ValueError, match="2345:06"):
        client.download(KEY, b"")


def test_client_gives_up_with_an_abort() -> None:
    client = SdoClient()
    client.upload(KEY)
    assert client.receive(bytes.fromhex("4145230609000000")) == bytes.fromhex("6000000000000000")
    assert client.receive(bytes.fromhex("1000000000000000")) == abort(KEY, Abort.TOGGLE)
    assert (client.busy, client.abort) == (False, Abort.TOGGLE)
    client.upload(KEY)
    client.receive(bytes.fromhex("4145230609000000"))
    assert client.receive(bytes.fromhex("0100000000000000")) == abort(KEY, Abort.LENGTH)  # 7 of 9 bytes
    client.upload(KEY)
    client.receive(bytes.fromhex("4145230606000000"))
    assert client.receive(bytes.fromhex("0100000000000000")) == abort(KEY, Abort.LENGTH)  # 7 of 6 bytes


def test_what_a_request_writes() -> None:
    client = SdoClient()
    assert written(client.download((0x6040, 0), b"\x0f\0")) == ((0x6040, 0), 15)
    assert written(client.upload((0x6040, 0))) == ((0, 0), 0)
    assert written(client.download((0x6040, 0), bytes(5))) == ((0, 0), 0)
