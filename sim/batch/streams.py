"""Messages between roles: what a role says, what becomes of it on the way, and what its receiver uses
(echelon.runtime.link and mailbox, as arrays)."""

from typing import Any

from echelon.sim.batch.ages import find_percentiles, note_age
from echelon.sim.batch.compiled import apart, compiled
from echelon.sim.batch.fates import fates, rounded
from echelon.sim.batch.memory import copy
from echelon.sim.batch.records import (
    AGE_MAX,
    AGE_SUM,
    DELIVERED,
    DUPLICATES,
    FAR,
    GONE,
    HEARD,
    HELD,
    IN_USE,
    IS_NULL,
    LAST,
    LATEST,
    LINK_WHOLES,
    LOST,
    NEXT,
    STAMP,
    TAKEN,
    USED,
)


@compiled
def room(stream: Any, whole: Any) -> int:
    """Returns where in `real` the values of the stream's next message belong."""
    return int(stream.at + (whole[stream.marks_at] & stream.mask) * stream.length)


@compiled
def say(stream: Any, whole: Any, time_ns: int, is_null: int) -> None:
    """Sends the message whose values are at `room`, with the stamp `time_ns`."""
    number = whole[stream.marks_at]
    mark = stream.marks_at + 1 + 2 * (number & stream.mask)
    whole[mark] = time_ns
    whole[mark + 1] = is_null
    whole[stream.marks_at] = number + 1


@compiled
def hear(link: Any, real: Any, whole: Any, time_ns: int) -> int:
    """Returns where in `real` the values of the message in use on a link at `time_ns` are, or -1 if none is in use; counts the
    use.  Must be called with ascending instants, after `take_up`."""
    marks = link.marks_at
    used = whole[marks + USED]
    if link.prompt:
        number, last = whole[link.stream_marks_at] - 1, whole[marks + TAKEN] - 1
        slot = 0
        if link.mask:
            slot = number & link.mask
        mark = link.stream_marks_at + 1 + 2 * slot
        sent_ns, is_null = whole[mark], whole[mark + 1]
        whole[marks + TAKEN] = number + 1
        if link.brought:
            whole[marks + STAMP] = sent_ns
        place = link.stream_at + slot * link.length
    else:
        whole[marks + HEARD] = time_ns
        if whole[marks + NEXT] <= time_ns:
            _receive(link, real, whole, time_ns)
        number, place, last = whole[marks + IN_USE], link.at, whole[marks + LAST]
        sent_ns, is_null = whole[marks + STAMP], whole[marks + IS_NULL]
        whole[marks + LAST] = number
    if number < 0 or is_null:
        return -1
    age = time_ns - sent_ns
    if link.timeout_ns < FAR and read_age_ns(link, time_ns, sent_ns) > link.timeout_ns:
        return int(link.zeros_at)
    whole[marks + USED] = used + 1
    if age != 0:
        if number == last:
            whole[marks + HELD] += 1
        whole[marks + AGE_SUM] += age
        if age > whole[marks + AGE_MAX]:
            whole[marks + AGE_MAX] = age
        note_age(link, whole, age)
    return int(place)


@compiled
def read_age_ns(link: Any, time_ns: int, sent_ns: int) -> int:
    """Returns the age that the receiver reads at `time_ns` off a message sent at `sent_ns`, by the clocks of both."""
    shown_ns = link.receiver_offset_ns - link.source_offset_ns + rounded(link.receiver_drift * time_ns)
    return int(time_ns - sent_ns + shown_ns - rounded(link.source_drift * sent_ns))


@compiled
def take_up(link: Any, index: Any, whole: Any) -> None:
    """Draws what becomes of the messages that were sent since the last call, and counts all that arrive before the end of the
    run (`finish`).  A message that arrives later is on its way for ever, so a heavy tail costs nothing."""
    if link.prompt:
        return
    marks = link.marks_at
    number, arrivals = whole[marks + TAKEN], marks + LINK_WHOLES
    while number < whole[link.stream_marks_at]:
        slot = number & link.mask
        sent_ns = whole[link.stream_marks_at + 1 + 2 * slot]
        first, second = fates(link, number, sent_ns, index, whole)
        arrives_ns = copy_arrives_ns = FAR
        if first == GONE:
            whole[marks + LOST] += 1
        else:
            arrives_ns = _arrival_ns(link, sent_ns + first, whole[marks + LATEST])
            if second != GONE:
                copy_arrives_ns = _arrival_ns(link, sent_ns + second, whole[marks + LATEST])
            if link.fifo:
                whole[marks + LATEST] = arrives_ns
            whole[marks + NEXT] = min(whole[marks + NEXT], arrives_ns)
            whole[marks + DELIVERED] += arrives_ns < FAR
        whole[arrivals + slot] = arrives_ns
        if link.duplicates > 0.0:
            whole[arrivals + link.mask + 1 + slot] = copy_arrives_ns
            whole[marks + DUPLICATES] += copy_arrives_ns < FAR
        number += 1
    whole[marks + TAKEN] = number


@compiled
def _arrival_ns(link: Any, arrives_ns: int, latest_ns: int) -> int:
    """Returns when a message arrives that takes its delay until `arrives_ns`; `latest_ns`: the latest arrival before."""
    if link.fifo:
        arrives_ns = max(arrives_ns, latest_ns)
    return FAR if arrives_ns > link.end_ns else arrives_ns


@compiled
def _receive(link: Any, real: Any, whole: Any, time_ns: int) -> None:
    """Takes the newest message that has arrived into use, and notes when the next newer one arrives."""
    marks, arrivals, taken = link.marks_at, link.marks_at + LINK_WHOLES, whole[link.marks_at + TAKEN]
    newest, next_ns = whole[marks + IN_USE], FAR
    for number in range(max(newest + 1, taken - link.mask - 1), taken):
        arrives_ns = whole[arrivals + (number & link.mask)]
        if arrives_ns <= time_ns:
            newest, next_ns = number, FAR
        else:
            next_ns = min(next_ns, arrives_ns)
    whole[marks + NEXT] = next_ns
    slot = newest & link.mask
    mark, source = link.stream_marks_at + 1 + 2 * slot, link.stream_at + slot * link.length
    whole[marks + IN_USE] = newest
    whole[marks + STAMP] = whole[mark]
    whole[marks + IS_NULL] = whole[mark + 1]
    if whole[mark + 1] == 0:
        copy(real, source + link.first_1, link.at + link.first_1, link.size_1)
        copy(real, source + link.first_2, link.at + link.first_2, link.size_2)
        copy(real, source + link.first_3, link.at + link.first_3, link.size_3)


@compiled
def heard_ns(link: Any, whole: Any, at_ns: int, last_ns: int) -> int:
    """Returns the first instant from `at_ns` on at which a link has something newer than is in use, at the latest `last_ns`; it
    is `at_ns` if nothing newer was sent (echelon.runtime.mailbox)."""
    marks = link.marks_at
    if link.prompt or whole[marks + TAKEN] - 1 <= whole[marks + IN_USE]:
        return at_ns
    return max(at_ns, min(last_ns, int(whole[marks + NEXT])))


@compiled
def change_ns(link: Any, whole: Any, time_ns: int) -> int:
    """Returns the first instant after `time_ns` at which something newer arrives, or at which the message in use becomes too
    old."""
    marks = link.marks_at
    change = whole[marks + NEXT]
    if link.timeout_ns < FAR and whole[marks + IN_USE] >= 0 and whole[marks + IS_NULL] == 0:
        expires_ns = _expires_ns(link, whole[marks + STAMP])
        if expires_ns > time_ns:
            change = min(change, expires_ns)
    return int(change)


@compiled
def _expires_ns(link: Any, sent_ns: int) -> int:
    """Returns the first instant at which a receiver finds a message too old that was sent at `sent_ns`."""
    expires_ns = sent_ns + link.timeout_ns + 1
    lacking_ns = link.timeout_ns + 1 - read_age_ns(link, expires_ns, sent_ns)
    while lacking_ns > 0:
        expires_ns += lacking_ns
        lacking_ns = link.timeout_ns + 1 - read_age_ns(link, expires_ns, sent_ns)
    over_ns = read_age_ns(link, expires_ns - 1, sent_ns) - link.timeout_ns
    while over_ns > 0:
        expires_ns -= over_ns
        over_ns = read_age_ns(link, expires_ns - 1, sent_ns) - link.timeout_ns
    return int(expires_ns)


@apart
def finish(link: Any, whole: Any) -> None:
    """Takes back what was counted and had not arrived when the receiver looked last; finds the percentiles of the ages."""
    if not link.prompt:
        marks, arrivals = link.marks_at, link.marks_at + LINK_WHOLES
        heard_ns, taken = whole[marks + HEARD], whole[marks + TAKEN]
        for number in range(max(0, taken - link.mask - 1), taken):
            arrival = arrivals + (number & link.mask)
            whole[marks + DELIVERED] -= heard_ns < whole[arrival] < FAR
            if link.duplicates > 0.0:
                whole[marks + DUPLICATES] -= heard_ns < whole[arrival + link.mask + 1] < FAR
    find_percentiles(link, whole)
