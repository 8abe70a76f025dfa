"""The fate of messages (echelon.runtime.fates, as arrays).

The numbers of a link are drawn in the order of its messages.  So chains (bursts, correlated delays) need only their last state.
"""

from math import frexp
from typing import Any, Final

import numpy as np

from echelon.plan.delay_tables import BITS, CELLS_LOG2, FACTOR_BITS, FINEST, HALF, Z_BITS, Z_CELL_LOG2, Z_MAX
from echelon.runtime.fates import BURST, CHAIN, COPY, LOSS
from echelon.sim.batch.compiled import compiled
from echelon.sim.batch.philox import philox
from echelon.sim.batch.records import (
    BAD,
    BY_NUMBER,
    BY_TIME,
    DRAWN,
    F_BURST,
    F_COPY,
    F_LOSS,
    F_OWN,
    GONE,
    KEY_0,
    KEY_2,
    TABLE,
    TABLE_Z,
    Z,
)

_UNIT: Final = 2.0**-BITS
_DROPPED: Final = np.uint64(64 - BITS)


@compiled
def fates(link: Any, number: int, sent_ns: int, index: Any, whole: Any) -> tuple[int, int]:
    """Returns the delays of a message and of its second copy [ns], the shorter one first; `GONE` where nothing comes.  Must be
    called with ascending numbers from 0 on."""
    if link.fixed:
        return (GONE if _is_dark(link, sent_ns, index) else int(link.delay_min_ns)), GONE
    marks = link.marks_at
    at = marks + 2 * (number % 2)
    _draw(marks + KEY_0, LOSS, number, marks + F_OWN, whole)
    if link.loss_of_message:
        _draw(marks + KEY_2, LOSS, number, marks + F_LOSS, whole)
    if _is_lost(link, number, at, whole):
        _delay(link, number, whole[at + F_OWN + 1], sent_ns, index, whole)  # a chain of delays goes on
        if link.duplicates > 0.0:
            _draw(marks + KEY_0, COPY, number, marks + F_COPY, whole)
        return GONE, GONE
    first, second = _delay(link, number, whole[at + F_OWN + 1], sent_ns, index, whole), GONE
    if link.duplicates > 0.0:
        _draw(marks + KEY_0, COPY, number, marks + F_COPY, whole)
        if first != GONE and whole[at + F_COPY] * _UNIT < link.duplicates:
            second = _copy_delay(link, number, whole[at + F_COPY + 1], sent_ns, index)
    if first == GONE or _is_dark(link, sent_ns, index):
        return GONE, GONE
    if second != GONE and second < first:
        return second, first
    return first, second


@compiled
def _draw(key: int, stream: int, number: int, place: int, whole: Any) -> None:
    """Draws the words of two messages, if `number` is the first of them; numpy's counts begin with 1."""
    if number % 2 == 0:
        key_0, key_1 = np.uint64(whole[key]), np.uint64(whole[key + 1])
        a, b, c, d = philox(key_0, key_1, np.uint64(number // 2 + 1), np.uint64(stream))
        whole[place] = np.int64(a >> _DROPPED)
        whole[place + 1] = np.int64(b >> _DROPPED)
        whole[place + 2] = np.int64(c >> _DROPPED)
        whole[place + 3] = np.int64(d >> _DROPPED)


@compiled
def _is_lost(link: Any, number: int, at: int, whole: Any) -> bool:
    """Returns whether a message is lost, blackouts and traces aside."""
    if link.loss == 0.0:
        return False
    draw = whole[at + (F_LOSS if link.loss_of_message else F_OWN)] * _UNIT
    if not link.bursts:
        return bool(draw < link.loss)
    marks = link.marks_at
    _draw(marks + (KEY_2 if link.loss_of_message else KEY_0), BURST, number, marks + F_BURST, whole)
    turn = whole[at + F_BURST] * _UNIT
    low, high = min(link.to_bad, 1 - link.to_good), max(link.to_bad, 1 - link.to_good)
    if number == 0:
        whole[marks + BAD] = turn < link.share_bad
    elif turn < low:
        whole[marks + BAD] = 1
    elif turn >= high:
        whole[marks + BAD] = 0
    elif link.to_bad > 1 - link.to_good:
        whole[marks + BAD] = 1 - whole[marks + BAD]
    return bool(draw < (link.loss_bad if whole[marks + BAD] else link.loss_good))


@compiled
def _delay(link: Any, number: int, word: int, sent_ns: int, index: Any, whole: Any) -> int:
    """Returns the delay of a message from its word, or `GONE`; a correlated one moves its chain on."""
    if link.kind == TABLE_Z:
        marks, normal = link.marks_at, looked_up(index, link.normal_at, word)
        if number % CHAIN == 0:
            whole[marks + Z] = normal
        else:
            whole[marks + Z] = (link.rho * whole[marks + Z] >> FACTOR_BITS) + (normal * link.rest >> FACTOR_BITS)
        return looked_up_z(index, link.table_at, whole[marks + Z])
    return _copy_delay(link, number, word, sent_ns, index)


@compiled
def _copy_delay(link: Any, number: int, word: int, sent_ns: int, index: Any) -> int:
    """Returns the delay of a copy from its word, or `GONE`."""
    if link.kind == DRAWN:
        return int(link.delay_min_ns) + rounded(word * _UNIT * link.delay_span_ns)
    if link.kind == TABLE:
        return looked_up(index, link.table_at, word)
    if link.kind == TABLE_Z:
        return looked_up_z(index, link.table_at, looked_up(index, link.normal_at, word))
    if link.kind == BY_NUMBER:
        return int(index[link.table_at + number % link.table_size])
    assert link.kind == BY_TIME
    return int(index[link.table_at + max(0, _last_at(index, link.times_at, link.table_size, 1, sent_ns))])


@compiled
def _is_dark(link: Any, sent_ns: int, index: Any) -> bool:
    """Returns whether a message that is sent at an instant falls into a blackout."""
    at = _last_at(index, link.windows_at, link.windows, 2, sent_ns)
    return at >= 0 and sent_ns < index[link.windows_at + 2 * at + 1]


@compiled
def _last_at(index: Any, first: int, count: int, width: int, time_ns: int) -> int:
    """Returns the number of the last of `count` ascending instants, `width` apart, that is not after `time_ns`, or -1."""
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        if index[first + width * middle] <= time_ns:
            low = middle + 1
        else:
            high = middle
    return low - 1


@compiled
def looked_up(index: Any, table: int, word: int) -> int:
    """Returns the value of a table over u for a word (echelon.plan.delay_tables)."""
    upper = word >> (BITS - 1) != 0
    near = (1 << BITS) - 1 - word if upper else word
    shift = max(frexp(float(near))[1] - (CELLS_LOG2 + 1), FINEST)
    cell = ((shift - FINEST) << CELLS_LOG2) + (near >> shift)
    at = table + (2 * HALF - cell if upper else cell)
    first = index[at]
    step = index[at + (-1 if upper else 1)] - first
    share = float(near & ((1 << shift) - 1)) / float(1 << shift)
    return int(first) + rounded(step * share)


@compiled
def looked_up_z(index: Any, table: int, z: int) -> int:
    """Returns the value of a table over z (echelon.plan.delay_tables)."""
    from_left = min(max(z + (Z_MAX << Z_BITS), 0), (2 * Z_MAX << Z_BITS) - 1)
    at = table + (from_left >> Z_CELL_LOG2)
    share = float(from_left & ((1 << Z_CELL_LOG2) - 1)) / float(1 << Z_CELL_LOG2)
    return int(index[at]) + rounded((index[at + 1] - index[at]) * share)


@compiled
def rounded(value: float) -> int:
    """Returns the nearest integer; the even one of two.  A product stays rounded on its way here: no sum follows it."""
    return round(value)
