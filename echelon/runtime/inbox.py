"""What a session has received, until it is taken."""

import threading
import time
from collections import deque
from typing import Generic, TypeVar

_T = TypeVar("_T")


class Inbox(Generic[_T]):
    """What was received and not yet taken, in order of arrival: payloads, or what was made of them.

    Only one thread may call `take`.

    With `hold` (lockstep), nothing more is received while the inbox holds `high_water` items: senders block in their put,
    and nothing is lost.  Without it the newest `high_water` items are kept, and `dropped` counts the others.
    """

    def __init__(self, high_water: int, hold: bool) -> None:
        self._items: deque[_T] = deque()
        self._high_water, self._hold = high_water, hold
        self._some = threading.Event()
        self._room = threading.Event()
        self.dropped = 0

    def take(self, timeout_s: float | None = None) -> list[_T]:
        """Removes and returns all items.  If there are none, it first waits for one, at most `timeout_s`; None: for ever."""
        items = self._items
        deadline_s = None if timeout_s is None else time.monotonic() + timeout_s
        # `put` may set the event after its item was taken, so the event alone does not mean that there is an item.
        while not items and timeout_s != 0:
            self._some.clear()  # cleared before the second look: an item that comes after it sets the event again
            if items or not self._some.wait(None if deadline_s is None else max(0.0, deadline_s - time.monotonic())):
                break
        taken = [items.popleft() for _ in range(len(items))]
        self._room.set()
        return taken

    def put(self, item: _T) -> None:
        """Adds an item, in Zenoh's thread."""
        items = self._items
        items.append(item)
        if not self._hold and len(items) > self._high_water:
            items.popleft()
            self.dropped += 1
        self._some.set()
        while self._hold and len(items) >= self._high_water:
            self._room.clear()
            if self._hold and len(items) >= self._high_water:
                self._room.wait()

    def let_go(self) -> None:
        """Ends the holding of senders.  Zenoh's thread may be blocked in `put`, and closing a session needs it."""
        self._hold = False
        self._room.set()
