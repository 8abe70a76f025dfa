"""Unpacking the chunks of a recording, with bounds: some kilobytes may unpack to gigabytes."""

import zlib
from io import BytesIO
from typing import Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.records import Chunk

LARGEST_CHUNK: Final = 1 << 24
"""Largest size of a chunk, unpacked [bytes]; those of the recorder have 256 KiB, those of other programs some megabytes"""
TOTAL: Final = 1 << 26
"""Size of all chunks of a small file, unpacked [bytes]"""
FACTOR: Final = 200
"""How many bytes of chunks, unpacked, a file may have for each of its bytes, apart from `TOTAL`; those of runs have about 3"""


def room_of(size: int) -> int:
    """Returns how many bytes all chunks of a file of some size may have, unpacked."""
    return TOTAL + FACTOR * size


def unpack(chunk: Chunk, room: int) -> bytes:
    """Returns the records of a chunk, as bytes.

    Raises ValueError if they are larger than `LARGEST_CHUNK` or than `room`, or if their checksum is wrong, and other
    exceptions if they cannot be unpacked."""
    limit = min(LARGEST_CHUNK, room)
    if chunk.uncompressed_size > limit:
        raise ValueError("its chunks are too large")
    match chunk.compression:
        case "":
            data = chunk.data
        case "zstd":
            unpacker = zstandard.ZstdDecompressor(max_window_size=LARGEST_CHUNK)
            data = unpacker.stream_reader(BytesIO(chunk.data)).read(chunk.uncompressed_size + 1)
        case "lz4":
            data = lz4.frame.LZ4FrameDecompressor().decompress(chunk.data, chunk.uncompressed_size + 1)
        case _:
            raise ValueError("compression")
    if len(data) != chunk.uncompressed_size:
        raise ValueError("size")
    if chunk.uncompressed_crc and zlib.crc32(data) != chunk.uncompressed_crc:
        raise ValueError("checksum")
    return data
