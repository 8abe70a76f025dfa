"""The file of arrivals: on a wall clock each member notes when it took up each message (docs/architecture.md, 6.3).

All members of a run append to one file.  It is a sequence of records of 24 bytes, little endian:

    number of the link in the plan u32 | number of the message u32 | sent [ns] i64 | arrived [ns] i64

Both instants are run time: the time in the message's header, and the instant from which on its receiver uses it.  A second
record of the same message corrects that instant: the receiver acted late, and the message counted earlier.  A member that ends
in order writes a last record with the link `END`, its index in the place of the message's number, and the end of its run in the
place of both instants.
"""

import os
import struct
import sys
from pathlib import Path
from typing import Final

FILE: Final = "arrivals.bin"
"""Name of the file in a run's folder"""
END: Final = 0xFFFFFFFF
"""Stands in the place of a link in the last record of a member"""
RECORD: Final = struct.Struct("<IIqq")
FLUSH_NS: Final = 100_000_000
"""Time between two writes.  A member that is killed loses its arrivals since the last one [ns]"""

pack_arrival = RECORD.pack
"""Returns a record, from the number of the link, the number of the message, and the instants of sending and arrival"""


class ArrivalFile:
    """The file of arrivals of a run, open for one of its members.

    If a write fails, it says so once on standard error, and nothing more is written: the run goes on."""

    def __init__(self, folder: Path) -> None:
        """Opens the file in the folder of a run, and makes it if it is not there.  Raises OSError."""
        self._file = os.open(
            folder / FILE, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC, 0o644
        )
        self._path = folder / FILE

    def write(self, records: bytes) -> None:
        """Appends whole records."""
        if self._file < 0 or not records:
            return
        try:
            written = os.write(self._file, records)  # at once: members append to the same file
            why = "" if written == len(records) else "written in part only"
        except OSError as error:
            why = error.strerror or "cannot be written"
        if why:
            print(f"{self._path}: {why}; no further arrivals are noted", file=sys.stderr)
            self.close()

    def close(self) -> None:
        """Closes the file."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1
