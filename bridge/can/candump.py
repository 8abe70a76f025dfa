"""The lines in which candump writes frames: those of `candump -l`, and those that it shows on a screen.

candump -l        (1700000000.010000) can0 101#E80324FA010700F3
candump -t a      (1700000000.010000)  can0  101   [8]  E8 03 24 FA 01 07 00 F3
candump -t A -x   (2023-11-14 22:13:20.010000)  can0  RX - -  101   [8]  E8 03 24 FA 01 07 00 F3

Hexadecimal digits may be of either case, and seconds may have any number of decimals.
"""

import re
from binascii import unhexlify
from calendar import timegm
from typing import Final, NamedTuple

from echelon.bridge.protocols.frame import Frame

NOT_READ: Final = "lines that could not be read"
WITHOUT_TIME: Final = "lines without a time stamp (candump -l or -t a writes them)"
BACKWARDS: Final = "lines as shown on a screen whose times go back (those of candump -t d are differences)"
EXTENDED: Final = "frames with 29-bit identifiers"
FLEXIBLE: Final = "CAN FD frames"
ERRORS: Final = "error frames"

_LOGGED: Final = re.compile(
    rb"\s*\((\d{1,12})\.(\d{1,12})\) (\S+) ([0-9A-Fa-f]{3})#(?:([0-9A-Fa-f]{0,16})|R[0-8]?)(?:_[0-9A-Fa-f])?(?: [A-Z])*\s*"
)
_LOGGED_OTHER: Final = re.compile(r"\(\d+\.\d+\) \S+ ([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(#?)(?:R[0-8]?|[0-9A-Fa-f]*)\b.*")
_SHOWN: Final = re.compile(
    r"(?:\((?:(?:(\d{4})-(\d\d)-(\d\d) (\d\d):(\d\d):)?(\d{1,12})\.(\d{1,12}))\)\s+)?(\S+)\s+(?:[RT]X [-B] [-E]\s+)?"
    r"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})\s+\[(\d{1,2})\]\s*(remote request|(?:[0-9A-Fa-f]{2} ?)*)(?:\s+(?:'.*'|ERRORFRAME))?"
)
_ERROR_FLAG: Final = 0x20000000
_DIGITS: Final = 9


class Logged(NamedTuple):
    """A frame in a log: time stamp [ns], name of the bus, frame."""

    time_ns: int
    channel: str
    frame: Frame


class LeftOut(NamedTuple):
    """Something in a log that is no classic frame with an 11-bit identifier."""

    reason: str
    torn: bool = False
    """True if it may have been such a frame: then the log lacks a frame that was on the bus"""


def read_line(line: bytes) -> Logged | LeftOut | None:
    """Returns what a line of candump says; None for a blank line."""
    if match := _LOGGED.fullmatch(line):
        seconds, decimals, channel, identifier, data = match.groups()
        if data is not None and len(data) % 2:
            return LeftOut(NOT_READ, True)
        frame = Frame(int(identifier, 16) & 0x7FF, unhexlify(data or b""), data is None)
        time_ns = int(seconds) * 1_000_000_000 + int(decimals[:_DIGITS].ljust(_DIGITS, b"0"))
        return Logged(time_ns, channel.decode("ascii", "replace"), frame)
    text = line.decode("ascii", "replace").strip()
    if not text:
        return None
    if other := _LOGGED_OTHER.fullmatch(text):
        identifier, flexible = other.groups()
        return _other(identifier, bool(flexible)) or LeftOut(NOT_READ, True)
    if shown := _SHOWN.fullmatch(text):
        return _shown(shown)
    return LeftOut(NOT_READ, True)


def _shown(match: re.Match[str]) -> Logged | LeftOut:
    *date, seconds, decimals, channel, identifier, length, content = match.groups()
    if (other := _other(identifier, len(length) == 2)) is not None:
        return other
    remote = content == "remote request"
    data = b"" if remote else bytes.fromhex(content)
    if int(length) > 8 or not (remote or len(data) == int(length)):
        return LeftOut(NOT_READ, True)
    if seconds is None:
        return LeftOut(WITHOUT_TIME, True)
    if date[0] is not None:
        year, month, day, hour, minute = map(int, date)
        if not (1 <= month <= 12 and 1 <= day <= 31 and hour < 24 and minute < 60 and int(seconds) <= 60 and year):
            return LeftOut(NOT_READ, True)
        # only differences count, so the time zone does not matter
        seconds = str(max(0, timegm((year, month, day, hour, minute, int(seconds), 0, 0, 0))))
    time_ns = int(seconds) * 1_000_000_000 + int(decimals[:_DIGITS].ljust(_DIGITS, "0"))
    return Logged(time_ns, channel, Frame(int(identifier, 16) & 0x7FF, data, remote))


def _other(identifier: str, flexible: bool) -> LeftOut | None:
    """Returns what a frame is if it is no classic frame with an 11-bit identifier; else None."""
    if flexible:
        return LeftOut(FLEXIBLE)
    if len(identifier) == 8:
        return LeftOut(ERRORS if int(identifier, 16) & _ERROR_FLAG else EXTENDED)
    return None
