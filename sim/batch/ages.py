"""Ages of the messages that a receiver uses: their percentiles (echelon.runtime.ages, as arrays).

Up to `EXACT` different ages are in a hash table, of pairs (age, number of uses), in a link's part of `whole`; an age of 0 is an
empty pair.  Then all are counted by their eight leading bits, which are the first bits of the age as a float.
"""

from typing import Any, Final

import numpy as np

from echelon.runtime.ages import EXACT
from echelon.sim.batch.compiled import compiled
from echelon.sim.batch.records import AGE_MAX, AGE_P50, AGED, AGES, USED

_DROPPED: Final = 45
"""Bits of a float after the first eight of its fraction, the leading one included"""
_ONE: Final = 1023 << 7
"""What is left of 1.0 then"""
_GAPS: Final = (701, 301, 132, 57, 23, 10, 4, 1)
"""Of Shell's sort (M. Ciura, "Best increments for the average case of Shellsort", 2001)"""


@compiled
def bin_of(age_ns: int) -> int:
    """Returns the number of the bin of an age: those with the same leading bits."""
    return int((np.float64(age_ns).view(np.int64) >> _DROPPED) - _ONE)


@compiled
def middle_of(number: int) -> int:
    """Returns the middle of a bin."""
    dropped, leading = (number >> 7) - 7, 128 + (number & 127)
    return leading >> -dropped if dropped <= 0 else (leading << dropped) + (1 << dropped >> 1)


@compiled
def note_age(link: Any, whole: Any, age_ns: int) -> None:
    """Counts an age above 0."""
    marks = link.marks_at
    whole[marks + AGED] += 1
    if whole[marks + AGES] < 0:
        whole[link.bins_at + bin_of(age_ns)] += 1
        return
    place = (age_ns + (age_ns >> 7) + (age_ns >> 17)) & link.ages_mask
    while whole[link.ages_at + 2 * place] != age_ns:
        if whole[link.ages_at + 2 * place] == 0:
            whole[link.ages_at + 2 * place] = age_ns
            whole[marks + AGES] += 1
            break
        place = (place + 1) & link.ages_mask
    whole[link.ages_at + 2 * place + 1] += 1
    if whole[marks + AGES] > EXACT:
        whole[marks + AGES] = -1
        for place in range(link.ages_mask + 1):
            age_ns = whole[link.ages_at + 2 * place]
            if age_ns > 0:
                whole[link.bins_at + bin_of(age_ns)] += whole[link.ages_at + 2 * place + 1]


@compiled
def find_percentiles(link: Any, whole: Any) -> None:
    """Finds the ages that 50, 95 and 99 % of the uses do not exceed."""
    marks, pairs = link.marks_at, link.ages_at
    if whole[marks + AGED] == 0:
        return
    rough = whole[marks + AGES] < 0
    if not rough:
        _sort(pairs, _compact(pairs, link.ages_mask + 1, whole), whole)
    total, below, age_ns, at = whole[marks + USED], whole[marks + USED] - whole[marks + AGED], 0, 0
    for number in range(3):
        share = 0.5 if number == 0 else (0.95 if number == 1 else 0.99)
        while below < share * total:
            if rough:
                age_ns = middle_of(at)
                below += whole[link.bins_at + at]
            else:
                age_ns = whole[pairs + 2 * at]
                below += whole[pairs + 2 * at + 1]
            at += 1
        whole[marks + AGE_P50 + number] = min(age_ns, whole[marks + AGE_MAX])


@compiled
def _compact(pairs: int, slots: int, whole: Any) -> int:
    """Moves pairs to the front; returns their number."""
    count = 0
    for place in range(slots):
        if whole[pairs + 2 * place] > 0:
            whole[pairs + 2 * count], whole[pairs + 2 * count + 1] = (
                whole[pairs + 2 * place],
                whole[pairs + 2 * place + 1],
            )
            count += 1
    return count


@compiled
def _sort(pairs: int, count: int, whole: Any) -> None:
    """Sorts pairs by age."""
    for gap in _GAPS:
        for place in range(gap, count):
            age, uses = whole[pairs + 2 * place], whole[pairs + 2 * place + 1]
            free = place
            while free >= gap and whole[pairs + 2 * (free - gap)] > age:
                whole[pairs + 2 * free] = whole[pairs + 2 * (free - gap)]
                whole[pairs + 2 * free + 1] = whole[pairs + 2 * (free - gap) + 1]
                free -= gap
            whole[pairs + 2 * free], whole[pairs + 2 * free + 1] = age, uses
