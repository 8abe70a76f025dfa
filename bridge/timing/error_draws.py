"""Random draws: which attempts to send are destroyed on a bus with errors.  Pure.

A draw is a function of seed, bus and number of the attempt only.  It comes from Philox 4x64: the key is made of seed and bus,
the counter is the number of the attempt.
"""

import hashlib

import numpy as np
from numpy.random import Philox

INTERFRAME = 3
"""Length of the interframe space [bits]"""
_ECHO_MAX = 6
_BLOCK = 512  # attempts drawn at once; each takes one step of the Philox counter, which gives four words


class ErrorDraws:
    """The draws of one bus."""

    def __init__(self, seed: int, bus_number: int) -> None:
        digest = hashlib.blake2b(f"{seed}|bus {bus_number}".encode(), digest_size=16).digest()
        self._key = int.from_bytes(digest, "little")
        self._block: list[list[float]] = []
        self._number = -1

    def hit(self, attempt: int, rate: float, bits: int) -> tuple[int, int] | None:
        """Returns after how many bits an attempt of `bits` bits is destroyed, and the length of the error flag's echo [bits].

        Returns None if it is not destroyed, which has probability 1 - `rate`.  The last bit of a frame is never destroyed: by
        then receivers have the frame."""
        number, at = divmod(attempt, _BLOCK)
        if number != self._number:
            words = Philox(key=self._key, counter=number * _BLOCK).random_raw(4 * _BLOCK)
            self._block = np.multiply(words >> np.uint64(11), 2.0**-53).reshape(_BLOCK, 4).tolist()
            self._number = number
        destroyed, where, echo, _ = self._block[at]
        if destroyed >= rate:
            return None
        return 1 + int(where * (bits - INTERFRAME - 1)), int(echo * (_ECHO_MAX + 1))
