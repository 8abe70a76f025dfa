"""SDO: reading and writing a node's objects.  Requests and answers have 8 bytes.

There are expedited transfers (up to 4 bytes of data in one frame) and segmented ones.  Block transfers are refused with an
abort, as the standard demands for unsupported services.

    byte 0      command: bits 7..5 the kind of message; the other bits depend on it
    byte 1..3   u16 index, u8 subindex      (initiate and abort)
    byte 4..7   data, size or abort code    (initiate and abort)
    byte 1..7   data                        (segment)
"""

import struct
from collections.abc import Callable
from enum import IntEnum

LENGTH = 8
MAX_DOWNLOAD = 1024
"""The longest object that can be written [bytes]."""

_HEAD = struct.Struct("<BHB4s")
_U32 = struct.Struct("<I")
_DOWNLOAD_SEGMENT, _DOWNLOAD, _UPLOAD, _UPLOAD_SEGMENT, _ABORT = range(5)  # from the client, bits 7..5
_UPLOAD_SEGMENT_ANSWER, _DOWNLOAD_SEGMENT_ANSWER, _UPLOAD_ANSWER, _DOWNLOAD_ANSWER = range(4)  # from the server
_TOGGLE = 0x10
_SIZED, _EXPEDITED = 1, 2
_LAST = 1

Key = tuple[int, int]
"""An object: index and subindex."""


class Abort(IntEnum):
    """Abort codes: why a transfer was given up."""

    TOGGLE = 0x0503_0000
    TIMEOUT = 0x0504_0000
    COMMAND = 0x0504_0001
    WRITE_ONLY = 0x0601_0001
    READ_ONLY = 0x0601_0002
    NO_OBJECT = 0x0602_0000
    NOT_MAPPABLE = 0x0604_0041
    MAPPING_TOO_LONG = 0x0604_0042
    LENGTH = 0x0607_0010
    NO_SUBINDEX = 0x0609_0011
    VALUE = 0x0609_0030
    GENERAL = 0x0800_0000
    DEVICE_STATE = 0x0800_0022
    NO_DATA = 0x0800_0024


class SdoError(Exception):
    """The node refuses a transfer, with this abort code."""

    def __init__(self, code: Abort) -> None:
        super().__init__(code)
        self.code = code


def abort(key: Key, code: int) -> bytes:
    """Returns the message that aborts a transfer."""
    return _HEAD.pack(_ABORT << 5, *key, _U32.pack(code))


def abort_code(message: bytes) -> int | None:
    """Returns the abort code in a message; None if it is no abort."""
    return _U32.unpack_from(message, 4)[0] if message[0] >> 5 == _ABORT else None


def _key(message: bytes) -> Key:
    return message[1] | message[2] << 8, message[3]


def name(key: Key) -> str:
    """Returns the usual notation of an object: 6071:00."""
    return f"{key[0]:04X}:{key[1]:02X}"


def _expedited(command: int, key: Key, data: bytes) -> bytes:
    return _HEAD.pack(command << 5 | (4 - len(data)) << 2 | _EXPEDITED | _SIZED, *key, data)


def _sized(command: int, key: Key, size: int) -> bytes:
    return _HEAD.pack(command << 5 | _SIZED, *key, _U32.pack(size))


def _expedited_data(message: bytes) -> bytes:
    unused = message[0] >> 2 & 3 if message[0] & _SIZED else 0
    return message[4 : 8 - unused]


def _segment(command: int, toggle: int, data: bytes, last: bool) -> bytes:
    head = command << 5 | toggle | (7 - len(data)) << 1 | (_LAST if last else 0)
    return bytes((head,)) + data.ljust(7, b"\0")


def _segment_data(message: bytes) -> bytes:
    return message[1 : 8 - (message[0] >> 1 & 7)]


class SdoServer:
    """The node's side: one transfer at a time.  A new transfer replaces an unfinished one.

    `read` returns an object's bytes, `write` sets them; both may raise SdoError."""

    def __init__(self, read: Callable[[Key], bytes], write: Callable[[Key, bytes], None]) -> None:
        self._read = read
        self._write = write
        self.reset()

    def reset(self) -> None:
        """Forgets an unfinished transfer."""
        self._key = (0, 0)
        self._going = -1
        """The kind of segment that the transfer waits for; -1: there is no transfer."""
        self._toggle = 0
        self._size: int | None = None
        self._data = bytearray()

    def answer(self, message: bytes) -> bytes | None:
        """Returns the answer to a request; None for an abort, which has no answer.  Never raises."""
        command = message[0] >> 5 if len(message) == LENGTH else -1
        try:
            if command in (_DOWNLOAD, _UPLOAD):
                self.reset()
                self._key = _key(message)
                return self._download(message) if command == _DOWNLOAD else self._upload()
            if command == _ABORT:
                self.reset()
                return None
            if command not in (_DOWNLOAD_SEGMENT, _UPLOAD_SEGMENT) or command != self._going:
                raise SdoError(Abort.COMMAND)
            if message[0] & _TOGGLE != self._toggle:
                raise SdoError(Abort.TOGGLE)
            return self._download_segment(message) if command == _DOWNLOAD_SEGMENT else self._upload_segment()
        except SdoError as error:
            key = self._key
            self.reset()
            return abort(key, error.code)

    def _download(self, message: bytes) -> bytes:
        if message[0] & _EXPEDITED:
            self._write(self._key, _expedited_data(message))
        else:
            self._size = _U32.unpack_from(message, 4)[0] if message[0] & _SIZED else None
            if self._size is not None and self._size > MAX_DOWNLOAD:
                raise SdoError(Abort.LENGTH)
            self._going = _DOWNLOAD_SEGMENT
        return _HEAD.pack(_DOWNLOAD_ANSWER << 5, *self._key, b"")

    def _download_segment(self, message: bytes) -> bytes:
        self._data += _segment_data(message)
        if len(self._data) > MAX_DOWNLOAD:
            raise SdoError(Abort.LENGTH)
        toggle = self._toggle
        self._toggle ^= _TOGGLE
        if message[0] & _LAST:
            if self._size not in (None, len(self._data)):
                raise SdoError(Abort.LENGTH)
            self._write(self._key, bytes(self._data))
            self.reset()
        return bytes((_DOWNLOAD_SEGMENT_ANSWER << 5 | toggle,)) + bytes(7)

    def _upload(self) -> bytes:
        data = self._read(self._key)
        if 1 <= len(data) <= 4:
            return _expedited(_UPLOAD_ANSWER, self._key, data)
        self._data, self._going = bytearray(data), _UPLOAD_SEGMENT
        return _sized(_UPLOAD_ANSWER, self._key, len(data))

    def _upload_segment(self) -> bytes:
        part, rest = bytes(self._data[:7]), self._data[7:]
        message = _segment(_UPLOAD_SEGMENT_ANSWER, self._toggle, part, not rest)
        self._data = rest
        self._toggle ^= _TOGGLE
        if not rest:
            self.reset()
        return message


class SdoClient:
    """The host's side: one transfer at a time.  `download` or `upload` starts it; it is over when `busy` is false."""

    def __init__(self) -> None:
        self.busy = False
        self.abort: int | None = None
        """Abort code of the last transfer; None if it succeeded."""
        self.data = b""
        """Data of the last upload."""
        self._key = (0, 0)
        self._upload = False
        self._rest = b""
        self._begun = False
        self._toggle = 0
        self._size: int | None = None
        self._sent_last = False

    def download(self, key: Key, data: bytes) -> bytes:
        """Returns the first request to write an object.  Raises ValueError for empty data."""
        if not data:
            raise ValueError(f"no data to write to {name(key)}: at least 1 byte is needed")
        self._start(key, upload=False)
        if len(data) <= 4:
            return _expedited(_DOWNLOAD, key, data)
        self._rest = data
        return _sized(_DOWNLOAD, key, len(data))

    def upload(self, key: Key) -> bytes:
        """Returns the first request to read an object."""
        self._start(key, upload=True)
        return _HEAD.pack(_UPLOAD << 5, *key, b"")

    def _start(self, key: Key, upload: bool) -> None:
        self.busy, self.abort, self.data = True, None, b""
        self._key, self._upload = key, upload
        self._rest, self._begun, self._toggle, self._size, self._sent_last = b"", False, 0, None, False

    def receive(self, message: bytes) -> bytes | None:
        """Takes an answer; returns the next request, or None if the transfer is over.

        Raises ValueError for an answer that does not belong to the transfer, which then continues to wait."""
        if not self.busy or len(message) != LENGTH:
            raise ValueError(f"no SDO answer that is waited for: {message.hex() or 'no data'}")
        code = abort_code(message)
        if code is not None:
            self._belongs(_key(message) == self._key, message)
            self._end(code)
            return None
        command = message[0] >> 5
        if not self._begun:
            self._belongs(_key(message) == self._key, message)
            self._belongs(command == (_UPLOAD_ANSWER if self._upload else _DOWNLOAD_ANSWER), message)
            return self._first(message)
        self._belongs(command == (_UPLOAD_SEGMENT_ANSWER if self._upload else _DOWNLOAD_SEGMENT_ANSWER), message)
        if message[0] & _TOGGLE != self._toggle:
            return self._give_up(Abort.TOGGLE)
        self._toggle ^= _TOGGLE
        if not self._upload:
            if not self._sent_last:
                return self._next_segment()
            self._end()
            return None
        self.data += _segment_data(message)
        if len(self.data) > (MAX_DOWNLOAD if self._size is None else self._size):
            return self._give_up(Abort.LENGTH)
        if message[0] & _LAST:
            if self._size not in (None, len(self.data)):
                return self._give_up(Abort.LENGTH)
            self._end()
            return None
        return self._ask_segment()

    def _first(self, message: bytes) -> bytes | None:
        self._begun = True
        if not self._upload:
            if self._rest:
                return self._next_segment()
            self._end()
            return None
        if message[0] & _EXPEDITED:
            self.data = _expedited_data(message)
            self._end()
            return None
        self._size = min(_U32.unpack_from(message, 4)[0], MAX_DOWNLOAD) if message[0] & _SIZED else None
        return self._ask_segment()

    def _ask_segment(self) -> bytes:
        return bytes((_UPLOAD_SEGMENT << 5 | self._toggle,)) + bytes(7)

    def _next_segment(self) -> bytes:
        part, self._rest = self._rest[:7], self._rest[7:]
        self._sent_last = not self._rest
        return _segment(_DOWNLOAD_SEGMENT, self._toggle, part, self._sent_last)

    def _belongs(self, so: bool, message: bytes) -> None:
        if not so:
            raise ValueError(f"no answer to the SDO request for {name(self._key)}: {message.hex()}")

    def _give_up(self, code: Abort) -> bytes:
        self._end(code)
        return abort(self._key, code)

    def _end(self, code: int | None = None) -> None:
        self.busy, self.abort = False, code


def written(message: bytes) -> tuple[Key, int]:
    """Returns the object that an expedited request writes, and its bytes as an unsigned number.

    For all other requests the object is 0000:00."""
    if message[0] >> 5 != _DOWNLOAD or not message[0] & _EXPEDITED:
        return (0, 0), 0
    return _key(message), int.from_bytes(_expedited_data(message), "little")
