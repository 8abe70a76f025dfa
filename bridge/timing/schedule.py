"""The events of a plan by time: which of them are active at an instant."""

from collections.abc import Iterable

from echelon.plan.can_plan import EventPlan


class Schedule:
    """Events by time.  `at` must be called with ascending instants.

    An event that begins and ends between two such instants is active at the second."""

    def __init__(self, events: Iterable[EventPlan]) -> None:
        self._events = tuple(events)
        self._begun: set[int] = set()

    def at(self, time_ns: int) -> tuple[list[EventPlan], list[EventPlan]]:
        """Returns the active events, and those of them that were not returned before."""
        active, begun = [], []
        for number, event in enumerate(self._events):
            new = number not in self._begun and event.at_ns <= time_ns
            if new:
                self._begun.add(number)
                begun.append(event)
            if new or event.at_ns <= time_ns < event.until_ns:
                active.append(event)
        return active, begun

    def next_ns(self, time_ns: int) -> int | None:
        """Returns the next instant after `time_ns` at which an event begins or ends; None: there is none."""
        times = (at for event in self._events for at in (event.at_ns, event.until_ns))
        return min((at for at in times if at > time_ns), default=None)
