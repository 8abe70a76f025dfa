"""Messages between roles: what a role says, what becomes of it on the way, and what its receiver uses
(echelon.runtime.link and mailbox, as arrays)."""

from typing import Any

from echelon.sim.batch.ages import note_age
from echelon.sim.batch.compiled import compiled
from echelon.sim.batch.fates import fates, rounded
from echelon.sim.batch.memory import copy
from echelon.sim.batch.records import (
    AGE_MAX,
    AGE_SUM,
    DELIVERED,
    DUPLICATES,
    FAR,
    GONE,
    HELD,
    IN_USE,
    IS_NULL,
    LAST,
    LATEST,
    LINK_WHOLES,
    LOST,
    NEWEST,
    NEXT,
    OLDEST,
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
def hear(link: Any, run: Any, index: Any, real: Any, whole: Any, time_ns: int) -> int:
    """Returns where in `real` the values of the message in use on a link at `time_ns` are, or -1 if none is in use; counts the
    use.  Must be called with ascending instants."""
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
        take_up(link, index, whole)
        receive(link, whole, time_ns)
        _use(link, real, whole)
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
        note_age(link, run, whole, age)
    return int(place)


@compiled
def read_age_ns(link: Any, time_ns: int, sent_ns: int) -> int:
    """Returns the age that the receiver reads at `time_ns` off a message sent at `sent_ns`, by the clocks of both."""
    shown_ns = link.receiver_offset_ns - link.source_offset_ns + rounded(link.receiver_drift * time_ns)
    return int(time_ns - sent_ns + shown_ns - rounded(link.source_drift * sent_ns))


@compiled
def take_up(link: Any, index: Any, whole: Any) -> None:
    """Draws what becomes of the messages that were sent since the last call.  Those that arrive after the run are not kept, so
    that a heavy tail costs nothing."""
    if link.prompt:
        return
    marks = link.marks_at
    number, arrivals, copies = whole[marks + TAKEN], marks + LINK_WHOLES, marks + LINK_WHOLES + link.mask + 1
    while number < whole[link.stream_marks_at]:
        sent_ns, slot = whole[link.stream_marks_at + 1 + 2 * (number & link.mask)], number & link.mask
        first, second = fates(link, number, sent_ns, index, whole)
        whole[arrivals + slot] = whole[copies + slot] = GONE
        if first == GONE:
            whole[marks + LOST] += 1
        else:
            whole[arrivals + slot] = max(sent_ns + first, whole[marks + LATEST]) if link.fifo else sent_ns + first
            whole[marks + NEXT] = min(whole[marks + NEXT], whole[arrivals + slot])
        if second != GONE:
            whole[copies + slot] = max(sent_ns + second, whole[marks + LATEST]) if link.fifo else sent_ns + second
        if first != GONE:
            whole[marks + LATEST] = whole[arrivals + slot]
        if whole[arrivals + slot] > link.end_ns:
            whole[arrivals + slot] = GONE
        if whole[copies + slot] > link.end_ns:
            whole[copies + slot] = GONE
        number += 1
    whole[marks + TAKEN] = number


@compiled
def receive(link: Any, whole: Any, time_ns: int) -> None:
    """Counts the messages that have arrived by `time_ns`, and notes the newest of them."""
    marks, arrivals = link.marks_at, link.marks_at + LINK_WHOLES
    if link.prompt or whole[marks + NEXT] > time_ns:
        return
    next_ns = FAR
    taken = whole[marks + TAKEN]
    oldest = max(whole[marks + OLDEST], taken - link.mask - 1)  # what is older has arrived or is lost
    for number in range(oldest, taken):
        arrival = arrivals + (number & link.mask)
        if link.duplicates > 0.0:
            copy = arrival + link.mask + 1
            if whole[copy] != GONE and whole[copy] <= time_ns:
                whole[copy] = GONE
                whole[marks + DUPLICATES] += 1
            elif whole[copy] != GONE:
                next_ns = min(next_ns, whole[copy])
        if whole[arrival] == GONE:
            continue
        if whole[arrival] <= time_ns:
            whole[arrival] = GONE
            whole[marks + DELIVERED] += 1
            whole[marks + NEWEST] = max(whole[marks + NEWEST], number)
        else:
            next_ns = min(next_ns, whole[arrival])
    while (
        oldest < taken
        and whole[arrivals + (oldest & link.mask)] == GONE
        and whole[arrivals + link.mask + 1 + (oldest & link.mask)] == GONE
    ):
        oldest += 1
    whole[marks + OLDEST] = oldest
    whole[marks + NEXT] = next_ns


@compiled
def _use(link: Any, real: Any, whole: Any) -> None:
    """Takes the newest message that has arrived into use."""
    marks, newest = link.marks_at, whole[link.marks_at + NEWEST]
    if newest <= whole[marks + IN_USE]:
        return
    mark = link.stream_marks_at + 1 + 2 * (newest & link.mask)
    whole[marks + IN_USE] = newest
    whole[marks + STAMP] = whole[mark]
    whole[marks + IS_NULL] = whole[mark + 1]
    if whole[mark + 1] == 0:
        source = link.stream_at + (newest & link.mask) * link.length
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
    receive(link, whole, at_ns)
    if whole[marks + NEWEST] > whole[marks + IN_USE]:
        return at_ns
    return max(at_ns, min(last_ns, _next_arrival_ns(link, whole)))


@compiled
def change_ns(link: Any, whole: Any, time_ns: int) -> int:
    """Returns the first instant after `time_ns` at which something newer arrives, or at which the message in use becomes too
    old."""
    marks = link.marks_at
    change = _next_arrival_ns(link, whole)
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


@compiled
def _next_arrival_ns(link: Any, whole: Any) -> int:
    """Returns when the next message arrives that is newer than the one in use; `FAR` if there is none."""
    marks, arrivals = link.marks_at, link.marks_at + LINK_WHOLES
    taken, found = whole[marks + TAKEN], FAR
    for number in range(max(whole[marks + IN_USE] + 1, taken - link.mask - 1), taken):
        arrival = whole[arrivals + (number & link.mask)]
        if arrival != GONE:
            found = min(found, arrival)
    return int(found)
