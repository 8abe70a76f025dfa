"""Ages of the messages that a receiver uses: their percentiles (echelon.runtime.ages, as arrays).

Each age above 0 is counted in a hash table, in a link's part of `whole`: its slots are pairs of an age and the number of its
uses.  With more than `EXACT` different ages all are counted in bins: by their eight leading bits, which are the first bits of
the age as a float.
"""

from typing import Any, Final

import numpy as np

from echelon.runtime.ages import EXACT
from echelon.sim.batch.compiled import apart, compiled
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
    marks, table = link.marks_at, link.ages_at
    whole[marks + AGED] += 1
    if whole[marks + AGES] < 0:
        whole[link.bins_at + bin_of(age_ns)] += 1
        return
    slot = (age_ns + (age_ns >> 7) + (age_ns >> 17)) & link.ages_mask
    while whole[table + 2 * slot] != age_ns:
        if whole[table + 2 * slot] == 0:
            if whole[marks + AGES] == EXACT:
                _into_bins(link, whole)
                whole[link.bins_at + bin_of(age_ns)] += 1
                return
            whole[marks + AGES] += 1
            whole[table + 2 * slot] = age_ns
        else:
            slot = (slot + 1) & link.ages_mask
    whole[table + 2 * slot + 1] += 1


@apart
def _into_bins(link: Any, whole: Any) -> None:
    """Counts in bins what is in the table of a link, and from now on."""
    for place in range(link.bins):
        whole[link.bins_at + place] = 0
    for slot in range(link.ages_mask + 1):
        age_ns = whole[link.ages_at + 2 * slot]
        if age_ns > 0:
            whole[link.bins_at + bin_of(age_ns)] += whole[link.ages_at + 2 * slot + 1]
    whole[link.marks_at + AGES] = -1


@apart
def find_percentiles(link: Any, whole: Any) -> None:
    """Finds the ages that 50, 95 and 99 % of the uses do not exceed."""
    marks, table = link.marks_at, link.ages_at
    count, total = whole[marks + AGED], whole[marks + USED]
    if count == 0:
        return
    zeros, above = total - count, 0
    rough = whole[marks + AGES] < 0
    if rough:
        at = bin_of(whole[marks + AGE_MAX])
    else:
        at = _listed(link, whole) - 1
        _sort(table, at + 1, whole)
    for number in range(2, -1, -1):
        enough = (0.5 if number == 0 else (0.95 if number == 1 else 0.99)) * total
        age_ns = 0
        if zeros < enough:
            counts, width = (link.bins_at, 1) if rough else (table + 1, 2)
            while total - above - whole[counts + width * at] >= enough:
                above += whole[counts + width * at]
                at -= 1
            age_ns = middle_of(at) if rough else whole[table + 2 * at]
        whole[marks + AGE_P50 + number] = min(age_ns, whole[marks + AGE_MAX])


@compiled
def _listed(link: Any, whole: Any) -> int:
    """Moves the pairs in use to the front of the table; returns their number."""
    table, count = link.ages_at, 0
    for slot in range(link.ages_mask + 1):
        age_ns, uses = whole[table + 2 * slot], whole[table + 2 * slot + 1]
        if age_ns > 0:
            whole[table + 2 * count], whole[table + 2 * count + 1] = age_ns, uses
            count += 1
    return count


@compiled
def _sort(first: int, count: int, whole: Any) -> None:
    """Sorts pairs of an age and the number of its uses by the age."""
    for gap in _GAPS:
        for place in range(gap, count):
            age_ns, uses, free = whole[first + 2 * place], whole[first + 2 * place + 1], place
            while free >= gap and whole[first + 2 * (free - gap)] > age_ns:
                whole[first + 2 * free] = whole[first + 2 * (free - gap)]
                whole[first + 2 * free + 1] = whole[first + 2 * (free - gap) + 1]
                free -= gap
            whole[first + 2 * free], whole[first + 2 * free + 1] = age_ns, uses
