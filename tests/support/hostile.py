"""Payloads that a receiver must refuse, and payloads that it may refuse or take, made from what it would take."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from echelon.messages import Channel
from echelon.runtime.wire import SCHEMA_VERSION

FAR_NS = 1 << 60


@dataclass(frozen=True)
class Heard:
    """What a receiver hears of one source on one channel."""

    source: int
    channel: Channel
    first_ns: int
    period_ns: int
    """0: numbers say nothing about time"""
    size: int
    """Number of values; of frames any multiple of three"""
    fixed: bool = True
    """All messages have this many values"""


def rows_of(heard: Heard, count: int, number: int, time_ns: int, luck: np.random.Generator) -> np.ndarray:
    """Returns payloads as rows of an array: messages with a number and a time that the receiver would take."""
    kind = np.dtype(
        {
            "names": ["version", "channel", "zero", "source", "number", "time", "count", "zeros", "values"],
            "formats": ["<u2", "u1", "u1", "<u4", "<u8", "<i8", "<u4", "<u4", ("<f8", (heard.size,))],
        }
    )
    rows = np.zeros(count, kind)
    rows["version"], rows["channel"], rows["source"] = SCHEMA_VERSION, heard.channel, heard.source
    rows["number"], rows["time"], rows["count"] = number, time_ns, heard.size
    rows["values"] = 0.0 if not heard.fixed else luck.normal(size=(count, heard.size))
    return rows


def refused(
    heard: Heard, count: int, newest: int, time_ns: int, luck: np.random.Generator, without: str = ""
) -> tuple[list[bytes], Counter[str]]:
    """Returns payloads, each wrong in one way only, and how many of each way there are; `without` is left out.

    `newest` is the number of the last message that the receiver has taken, at `time_ns`."""
    due_ns = heard.first_ns + (newest + 1) * heard.period_ns if heard.period_ns else time_ns
    rows = rows_of(heard, count, newest + 1, due_ns, luck)
    lengths = np.full(count, rows.dtype.itemsize)
    ways = [
        "version",
        "channel",
        "zero",
        "source",
        "zeros",
        "time",
        "future",
        "count",
        "size",
        "cut",
        "longer",
        "noise",
    ]
    if newest >= 0:
        ways.append("again")
    if not heard.fixed:
        ways.remove("size")
    ways = [each for each in ways if each != without]
    way = luck.integers(len(ways), size=count)

    def of(name: str) -> np.ndarray:
        return way == (ways.index(name) if name in ways else -1)

    def any_of(*choices: int) -> np.ndarray:
        return luck.choice(np.array(choices, object), size=count)

    for name, wrong in {
        "version": any_of(0, 2, 256, 65535),
        "channel": any_of(0, 8, 255, *(int(channel) for channel in Channel if channel is not heard.channel)),
        "zero": any_of(1, 128, 255),
        "source": any_of(heard.source + 1, heard.source + 7, 2**31, 2**32 - 1),
        "zeros": any_of(1, 2**31, 2**32 - 1),
        "count": any_of(heard.size + 1, 0 if heard.size else 1, 2**29, 2**32 - 1),
    }.items():
        rows[name][of(name)] = wrong[of(name)].astype(rows.dtype[name])
    if heard.period_ns:
        off = any_of(-1, heard.period_ns, -heard.period_ns, FAR_NS, -FAR_NS, 2 * heard.period_ns)
        rows["time"][of("time")] += off[of("time")].astype(np.int64)
        later = (FAR_NS - heard.first_ns) // heard.period_ns + luck.integers(1, 9, size=count)
        rows["number"][of("future")] = later[of("future")]
        rows["time"][of("future")] = heard.first_ns + later[of("future")] * heard.period_ns
    else:
        rows["time"][of("time")] = time_ns - any_of(1, 1000, FAR_NS)[of("time")].astype(np.int64)
        rows["time"][of("future")] = FAR_NS
    rows["number"][of("again")] = luck.integers(0, newest + 1, size=count)[of("again")] if newest >= 0 else 0
    if "size" in ways:
        rows["count"][of("size")] = heard.size - 1
        lengths[of("size")] -= 8
    lengths[of("cut")] -= luck.integers(1, rows.dtype.itemsize + 1, size=count)[of("cut")]
    content = rows.view(np.uint8).reshape(count, -1)
    noise = luck.integers(256, size=(int(of("noise").sum()), content.shape[1]), dtype=np.uint8)
    noise[:, 0] |= 2  # so that the version is wrong
    content[of("noise")] = noise
    whole = content.tobytes()
    width = content.shape[1]
    payloads = [whole[at * width : at * width + length] for at, length in enumerate(lengths.tolist())]
    for at in np.flatnonzero(of("longer")).tolist():
        payloads[at] += bytes(range(1 + at % 9))
    return payloads, Counter(ways[each] for each in way.tolist())


def mutated(payload: bytes, count: int, luck: np.random.Generator) -> list[bytes]:
    """Returns copies of a payload with up to three bits turned; a tenth of them is cut, repeated or empty."""
    copies = np.tile(np.frombuffer(payload, np.uint8), (count, 1))
    for _ in range(3):
        at = luck.integers(len(payload), size=count)
        copies[np.arange(count), at] ^= np.where(luck.random(count) < 0.6, 1 << luck.integers(8, size=count), 0).astype(
            np.uint8
        )
    whole, width = copies.tobytes(), len(payload)
    found = [whole[at * width : (at + 1) * width] for at in range(count)]
    for at in luck.integers(count, size=count // 10).tolist():
        found[at] = (found[at][: at % width], found[at] * 2, b"")[at % 3]
    return found
