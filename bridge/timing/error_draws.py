"""Which attempts to send are destroyed on a bus with errors: a function of seed, bus and the number of the attempt.

Draws come from Philox 4x64, keyed by seed and bus; their counter is the number of the attempt, so they do not depend on what
was drawn before.  Pure.
"""

import hashlib

import numpy as np
from numpy.random import Philox

INTERFRAME = 3
"""Bits of recessive level after each frame"""
_ECHO_MAX = 6
_BLOCK = 512  # attempts that are drawn at a time; each takes one count of the Philox counter, which is four words


class ErrorDraws:
    """The draws of one bus."""

    def __init__(self, seed: int, bus_number: int) -> None:
        digest = hashlib.blake2b(f"{seed}|bus {bus_number}".encode(), digest_size=16).digest()
        self._key = int.from_bytes(digest, "little")
        self._block: list[list[float]] = []
        self._number = -1

    def hit(self, attempt: int, rate: float, bits: int) -> tuple[int, int] | None:
        """Returns after how many of its `bits` an attempt is destroyed, and the bits of the echo; None if it gets through.

        The last bit of the frame is safe: receivers have the frame by then."""
        number, at = divmod(attempt, _BLOCK)
        if number != self._number:
            words = Philox(key=self._key, counter=number * _BLOCK).random_raw(4 * _BLOCK)
            self._block = np.multiply(words >> np.uint64(11), 2.0**-53).reshape(_BLOCK, 4).tolist()
            self._number = number
        destroyed, where, echo, _ = self._block[at]
        if destroyed >= rate:
            return None
        return 1 + int(where * (bits - INTERFRAME - 1)), int(echo * (_ECHO_MAX + 1))
