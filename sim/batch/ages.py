"""Ages of the messages that a receiver uses: their percentiles (echelon.runtime.ages, as arrays).

The first `LISTED` ages above 0 are a list in a link's part of `whole`.  When it is full it is sorted, and each age has a number
of uses.  With more than `EXACT` different ages all are counted in bins: by their eight leading bits, which are the first bits
of the age as a float.  Random delays mostly come to this as soon as the list is full; then nothing is sorted.
"""

from math import ceil
from typing import Any, Final

import numpy as np

from echelon.runtime.ages import EXACT
from echelon.sim.batch.compiled import apart, compiled
from echelon.sim.batch.records import AGE_MAX, AGE_P50, AGED, AGES, LISTED, SLOTS, USED

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
def note_age(link: Any, run: Any, whole: Any, age_ns: int) -> None:
    """Counts an age above 0."""
    marks = link.marks_at
    count = whole[marks + AGED]
    whole[marks + AGED] = count + 1
    if count < LISTED:
        whole[link.ages_at + count] = age_ns
    elif whole[marks + AGES] < 0:
        whole[link.bins_at + bin_of(age_ns)] += 1
    else:
        _note_further(link, run, whole, age_ns)


@compiled
def _decide(link: Any, run: Any, count: int, whole: Any) -> None:
    """Puts the ages of a list into bins if there are too many different ones."""
    ages, marks = link.ages_at, link.marks_at
    if _differ(run.slots_at, ages, count, whole):
        for place in range(count):
            whole[link.bins_at + bin_of(whole[ages + place])] += 1
        whole[marks + AGES] = -1


@apart
def _note_further(link: Any, run: Any, whole: Any, age_ns: int) -> None:
    """Counts an age that came after a full list."""
    ages, uses, marks = link.ages_at, link.uses_at, link.marks_at
    if whole[marks + AGES] == 0:
        _decide(link, run, LISTED, whole)
        if whole[marks + AGES] == 0:
            _sort(ages, LISTED, whole)
            whole[marks + AGES] = _merge(ages, uses, whole)
    if whole[marks + AGES] < 0:
        whole[link.bins_at + bin_of(age_ns)] += 1
        return
    count = whole[marks + AGES]
    low, high = 0, count
    while low < high:
        middle = (low + high) // 2
        if whole[ages + middle] < age_ns:
            low = middle + 1
        else:
            high = middle
    if low < count and whole[ages + low] == age_ns:
        whole[uses + low] += 1
    elif count < EXACT:
        for place in range(count, low, -1):
            whole[ages + place] = whole[ages + place - 1]
            whole[uses + place] = whole[uses + place - 1]
        whole[ages + low] = age_ns
        whole[uses + low] = 1
        whole[marks + AGES] = count + 1
    else:
        for place in range(count):
            whole[link.bins_at + bin_of(whole[ages + place])] += whole[uses + place]
        whole[link.bins_at + bin_of(age_ns)] += 1
        whole[marks + AGES] = -1


@compiled
def _differ(slots: int, ages: int, count: int, whole: Any) -> bool:
    """Returns whether more than `EXACT` of the ages of a list are different, by a hash table."""
    different = 0
    for place in range(SLOTS):
        whole[slots + place] = 0
    for number in range(count):
        age_ns = whole[ages + number]
        place = (age_ns + (age_ns >> 7) + (age_ns >> 17)) & (SLOTS - 1)
        while whole[slots + place] != age_ns:
            if whole[slots + place] == 0:
                different += 1
                if different > EXACT:
                    return True
                whole[slots + place] = age_ns
            else:
                place = (place + 1) & (SLOTS - 1)
    return False


@compiled
def _merge(ages: int, uses: int, whole: Any) -> int:
    """Writes each age of a full, sorted list once, and the number of its uses; returns their number."""
    count = 0
    for place in range(LISTED):
        if count > 0 and whole[ages + count - 1] == whole[ages + place]:
            whole[uses + count - 1] += 1
        else:
            whole[ages + count] = whole[ages + place]
            whole[uses + count] = 1
            count += 1
    return count


@apart
def find_percentiles(link: Any, run: Any, whole: Any) -> None:
    """Finds the ages that 50, 95 and 99 % of the uses do not exceed."""
    marks = link.marks_at
    count, total = whole[marks + AGED], whole[marks + USED]
    if count == 0:
        return
    if EXACT < count <= LISTED:
        _decide(link, run, count, whole)
    zeros, above, at = total - count, 0, whole[marks + AGES] - 1
    rough = at == -2
    if rough:
        at = bin_of(whole[marks + AGE_MAX])
    elif count <= LISTED:
        _sort(link.ages_at, count, whole)
    for number in range(2, -1, -1):
        enough = (0.5 if number == 0 else (0.95 if number == 1 else 0.99)) * total
        age_ns = 0
        if zeros < enough:
            if count <= LISTED and not rough:
                age_ns = whole[link.ages_at + max(0, int(ceil(enough)) - zeros - 1)]  # noqa: RUF046
            else:
                counts = link.bins_at if rough else link.uses_at
                while total - above - whole[counts + at] >= enough:
                    above += whole[counts + at]
                    at -= 1
                age_ns = middle_of(at) if rough else whole[link.ages_at + at]
        whole[marks + AGE_P50 + number] = min(age_ns, whole[marks + AGE_MAX])


@compiled
def _sort(first: int, count: int, whole: Any) -> None:
    """Sorts ages."""
    for gap in _GAPS:
        for place in range(first + gap, first + count):
            age_ns, free = whole[place], place
            while free >= first + gap and whole[free - gap] > age_ns:
                whole[free] = whole[free - gap]
                free -= gap
            whole[free] = age_ns
