"""How late this machine is: a process that sleeps for 5 ms, again and again."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Final

_SLEEPER: Final = """
import time
while True:
    begun_s = time.monotonic()
    time.sleep(0.005)
    late_s = time.monotonic() - begun_s - 0.005
    if late_s > 0.002:
        print(time.time(), late_s, flush=True)
"""


class Lateness:
    """By how much the machine lets a process wait that has nothing to do but to wake."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def of(self, begin_s: float, end_s: float) -> list[float]:
        """Returns by how much the process was late between two instants of `time.time` [s], once for each time."""
        *lines, _ = self._path.read_text().split("\n")
        found = [(float(at_s), float(late_s)) for at_s, late_s in map(str.split, lines)]
        return [late_s for at_s, late_s in found if begin_s <= at_s and at_s - late_s <= end_s]


@contextmanager
def lateness(path: Path) -> Iterator[Lateness]:
    """A context in which the process sleeps; it writes to a file."""
    with path.open("w") as file, subprocess.Popen([sys.executable, "-S", "-c", _SLEEPER], stdout=file) as sleeper:
        try:
            yield Lateness(path)
        finally:
            sleeper.kill()
