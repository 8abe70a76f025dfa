"""An inbox hands out what was put in, in order; whoever takes waits for an item, not for a sign of one."""

from __future__ import annotations

import threading
import time

from echelon.runtime.inbox import Inbox

TIMEOUT_S = 600.0


class _Late(threading.Event):
    """Tells when somebody waits for it, and how often it was waited for."""

    def __init__(self) -> None:
        super().__init__()
        self.waits = threading.Semaphore(0)

    def wait(self, timeout: float | None = None) -> bool:
        self.waits.release()
        return super().wait(timeout)


def test_a_sign_whose_item_was_taken_before_is_no_item() -> None:
    inbox, taken = Inbox[bytes](8, hold=True), list[bytes]()
    inbox._some = late = _Late()
    taker = threading.Thread(target=lambda: taken.extend(inbox.take(TIMEOUT_S)), daemon=True)
    taker.start()
    assert late.waits.acquire(timeout=TIMEOUT_S)
    late.set()  # as `put` does it that was interrupted after its item came in, until others had taken it
    assert late.waits.acquire(timeout=TIMEOUT_S)
    inbox.put(b"an item")
    taker.join(TIMEOUT_S)
    assert taken == [b"an item"]


def test_without_items_it_returns_after_the_time_and_not_before() -> None:
    inbox = Inbox[bytes](8, hold=True)
    assert inbox.take(0.0) == []
    begun_s = time.monotonic()
    inbox._some.set()
    assert inbox.take(0.2) == []
    assert time.monotonic() - begun_s >= 0.2


def test_items_are_taken_in_order_and_once() -> None:
    inbox = Inbox[int](1000, hold=True)
    for number in range(5):
        inbox.put(number)
    assert inbox.take() == [0, 1, 2, 3, 4]
    assert inbox.take(0.0) == []
