"""Reading back the messages between roles, value by value, from a recording that is complete or cut off."""

from array import array
from collections.abc import Collection
from pathlib import Path
from typing import Final

import numpy as np
from mcap.records import Attachment, Channel, Message, Metadata, Schema

from echelon.messages import Channel as MessageChannel
from echelon.plan.plan import Plan
from echelon.sim.recording.mcap_reader import CutError, blame, check_type, records
from echelon.sim.recording.mcap_writer import METADATA
from echelon.sim.recording.recorder import NULLS, SCENARIO, routes
from echelon.sim.recording.ros import NULL_MESSAGE, STAMP_SIZE, Splice
from echelon.sim.results.recorded import Recorded, Series

_NUMBERS: Final = 1 << 32
"""An MCAP file holds sequence numbers modulo this"""


class _Gathered:
    """The messages of one source on one channel, as they are read."""

    def __init__(self, source: int, channel: MessageChannel, splice: Splice) -> None:
        self._source, self._channel, self._splice = source, channel, splice
        self._sequences, self._times_ns, self._values = array("q"), array("q"), bytearray()

    def add(self, topic: str, message: Message) -> None:
        """Takes a message.  Raises ValueError if it has another shape, or does not come after the one before."""
        try:
            self._values += self._splice.decode(message.data)
        except ValueError as error:
            raise ValueError(f"a message of {topic} {error}") from None
        sequence = message.sequence
        if self._sequences:
            sequence += self._sequences[-1] // _NUMBERS * _NUMBERS
            sequence += _NUMBERS if sequence < self._sequences[-1] else 0
            if sequence == self._sequences[-1]:
                raise ValueError(f"{topic} has two messages number {sequence}")
        self._sequences.append(sequence)
        self._times_ns.append(message.log_time)

    def series(self) -> Series:
        """Returns the messages as arrays."""
        width = self._splice.size // 8
        return Series(
            self._source,
            self._channel,
            np.array(self._sequences, np.int64),
            np.array(self._times_ns, np.int64),
            np.frombuffer(bytes(self._values), "<f8").reshape(-1, width),
        )

    def __len__(self) -> int:
        return len(self._sequences)


class _Nulls:
    """The null messages of all sources, as they are read."""

    def __init__(self, known: Collection[int]) -> None:
        self._known = known
        self.found: dict[tuple[int, MessageChannel], dict[int, int]] = {}
        """By source and channel, times [ns] by number"""

    def add(self, topic: str, message: Message) -> None:
        """Takes a message.  Raises ValueError if it has another shape, or its source sends nothing on its channel."""
        if len(message.data) != STAMP_SIZE + NULL_MESSAGE.size:
            raise ValueError(
                f"a message of {topic} has {len(message.data)} bytes, not {STAMP_SIZE + NULL_MESSAGE.size}"
            )
        _, source, channel, sequence = NULL_MESSAGE.unpack_from(message.data, STAMP_SIZE)
        if channel >= 16 or 16 * source + channel not in self._known:
            raise ValueError(f"{topic} names source {source} and channel {channel}, which are not of this plan")
        self.found.setdefault((source, MessageChannel(channel)), {})[sequence] = message.log_time


def read_messages(path: Path, plan: Plan) -> Recorded:
    """Returns the messages of a recording, bit for bit; of a file that is cut off, those up to the cut.

    Raises ValueError if the file is damaged, not a recording, or not of this plan."""
    types, known = routes(plan)
    nulls = _Nulls(known.keys())
    by_topic: dict[str, _Gathered | _Nulls] = {NULLS: nulls}
    gathered = {topic: _Gathered(key // 16, MessageChannel(key % 16), splice) for key, (topic, splice) in known.items()}
    by_topic |= gathered
    types[NULLS] = "echelon_msgs/NullMessage"
    wanted: dict[int, tuple[str, _Gathered | _Nulls]] = {}
    schemas: dict[int, Schema] = {}
    metadata: dict[str, str] = {}
    scenario, cut = "", False
    with blame(path):
        try:
            for record in records(path):
                if isinstance(record, Message):
                    if (found := wanted.get(record.channel_id)) is not None:
                        found[1].add(found[0], record)
                elif isinstance(record, Schema):
                    schemas[record.id] = record
                elif isinstance(record, Attachment):
                    scenario = record.data.decode() if record.name == SCENARIO else scenario
                elif isinstance(record, Metadata):
                    metadata |= record.metadata if record.name == METADATA else {}
                elif isinstance(record, Channel) and record.topic in by_topic:
                    check_type(record.topic, schemas.get(record.schema_id), types[record.topic])
                    wanted[record.id] = record.topic, by_topic[record.topic]
        except CutError:
            cut = True
        series = [each.series() for each in gathered.values() if len(each)]
        if not series:
            raise ValueError("holds no messages between roles of this plan")
    return Recorded(plan, {(each.source, each.channel): each for each in series}, nulls.found, metadata, scenario, cut)
