"""When cyclic frames are due on a bus, and which of them come late, early or not at all.  Pure.

*Late.*  A frame may wait for a busy bus; that is not lateness.  A *busy stretch* is a sequence of frames without a free pause
between them.  A frame is late by the time from its due instant to the beginning of the busy stretch that it is part of.
The next frame is due a period after this one was due, or came if that was earlier.

*Free pauses.*  The referee does not see destroyed frames.  So a pause shorter than a frame and an error frame counts as busy.
If the plan has error frames, a pause shorter than five of them does.

*Shifted.*  If a frame is missing, all later frames come a period late.  On a busy bus this looks like waiting.  So five frames
in a row are also a gap if each of them is late by more than 2 ms and more than an eighth of the period.  This rule is off if
the plan has error frames.  On a bus that is never free it finds nothing.

*Early.*  A frame may be early in these cases:

- its sender was delayed and catches up: it sends the frames that it owes at once, less than half a period apart.  Catching up
  ends when a frame is due again, or with the first frame that comes later than that; frames still owed are lost then;
- a remote frame asked for it;
- it is a command for zero torque (the referee checks this);
- its drive sent its boot-up message: its periods begin anew.
"""

from collections.abc import Mapping
from math import ceil
from typing import Final

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.wheel_check import WheelCheck
from echelon.bridge.referee_reports import TimingReport
from echelon.bridge.timing.bus_load import worst_case_bits
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Plan

SHIFT_NS: Final = 2_000_000
SHIFTED: Final = 5
"""SHIFTED frames in a row are a gap if each is late by more than SHIFT_NS and more than an eighth of the period"""
DISTURBED: Final = 5
"""How many frames in a row may be destroyed in a plan with error frames"""
_ERROR_BITS: Final = 23
"""Length of the longest error frame and the interframe space [bits]"""


class Deadline:
    """The deadline of one identifier: its robots, its period (0: it is not cyclic) and when its next frame is due."""

    __slots__ = (
        "_begin_ns",
        "_catching_up",
        "_first_gap_ns",
        "_gaps",
        "_last_ns",
        "_longest_ns",
        "_owed",
        "_shift_ns",
        "_shifted",
        "_shortest_ns",
        "_squares",
        "_sum",
        "asked_empty",
        "can_id",
        "due_ns",
        "first_ns",
        "frames",
        "half_ns",
        "period_ns",
        "robots",
        "shift_ns",
        "silent",
        "tolerance_ns",
    )

    def __init__(self, can_id: int, period_ns: int, tolerance_ns: int | None = None) -> None:
        self.can_id = can_id
        self.period_ns = period_ns
        self.half_ns = period_ns // 2
        self.tolerance_ns = self.half_ns if tolerance_ns is None else tolerance_ns
        self.shift_ns = max(period_ns // 8, SHIFT_NS, tolerance_ns or 0)
        self.robots: tuple[WheelCheck, ...] = ()
        self.asked_empty = False
        """True: a frame without data asks for a frame, as a remote frame does"""
        self.frames = 0
        self.first_ns = 0
        self.due_ns: int | None = None
        self.silent = False  # silence was reported
        self._owed = 0  # frames that remote frames asked for
        self._catching_up = False  # the sender may send the frames that it owes
        self._begin_ns = 0  # when the last frame began
        self._shifted = self._shift_ns = 0  # number of frames in a row that were late, and their smallest lateness
        self._last_ns: int | None = None  # the last frame from run time 0 on
        # number, sum and sum of squares of the periods, each less the first period, so that the sums stay exact
        self._gaps = self._sum = self._squares = 0
        self._first_gap_ns = self._shortest_ns = self._longest_ns = 0

    @property
    def robot(self) -> WheelCheck | None:
        """The robot of this identifier; None if it is that of several or of none."""
        return self.robots[0] if len(self.robots) == 1 else None

    def take(self, time_ns: int, begin_ns: int, busy_ns: int, frame: Frame) -> tuple[str, str] | None:
        """Takes a frame that began at `begin_ns`, in a busy stretch that began at `busy_ns`.

        Returns kind and text of a finding if the frame is early or late."""
        if not self.frames:
            self.first_ns = time_ns
        self.frames += 1
        if frame.remote or (self.asked_empty and not frame.data):
            self._owed += 1
            return None
        if time_ns >= 0:
            self._measure(time_ns)
        if not self.period_ns:
            return None
        last_ns, self._begin_ns = self._begin_ns, begin_ns
        if self.due_ns is None:
            self.due_ns = begin_ns + self.period_ns
            return None
        if self.due_ns - begin_ns > max(self.half_ns, self.tolerance_ns):
            if self._owed:
                self._owed -= 1
                return None
            return "burst", f"{(self.due_ns - begin_ns) / 1e6:.4g} ms before it was due"
        late_ns, told = busy_ns - self.due_ns, None
        if self._catching_up and begin_ns - self.due_ns <= self.half_ns:
            self._catching_up = False
        elif self._catching_up and begin_ns - last_ns > self.half_ns:  # the frames that it still owes are lost
            self._catching_up = False
            periods = max(0, (busy_ns - self.due_ns + self.half_ns) // self.period_ns)
            self.due_ns = max(self.due_ns + periods * self.period_ns, busy_ns)
        elif self._catching_up or self.silent:
            self._catching_up, self.silent = True, False
        elif late_ns > self.tolerance_ns:
            self._catching_up = True
            told = self._late(late_ns)
        else:
            told = self._follow(begin_ns - self.due_ns, late_ns)
        self.due_ns = min(self.due_ns, begin_ns) + self.period_ns
        return told

    def _follow(self, after_ns: int, late_ns: int) -> tuple[str, str] | None:
        """Moves `due_ns` with a sender whose clock is slightly slow.  Returns a finding if the last frames were all late."""
        assert self.due_ns is not None
        if after_ns <= self.shift_ns:
            self._shifted = 0
            self.due_ns += max(0, late_ns) // 8
        elif late_ns > self.shift_ns:  # a frame within a busy stretch says nothing: it may have waited
            self._shifted += 1
            self._shift_ns = late_ns if self._shifted == 1 else min(late_ns, self._shift_ns)
            if self._shifted == SHIFTED:
                self._shifted = 0
                self.due_ns += self._shift_ns
                return self._late(self._shift_ns, f", like those before it: {SHIFTED} in a row")
        return None

    def _late(self, late_ns: int, more: str = "") -> tuple[str, str]:
        return "gap", f"{late_ns / 1e6:.4g} ms late, its period is {self.period_ns / 1e6:g} ms{more}"

    @property
    def expected_ns(self) -> int | None:
        """When the next frame is due, or will be when the sender has caught up; None before the first frame."""
        return None if self.due_ns is None else max(self.due_ns, self._begin_ns + self.period_ns)

    def forget(self) -> None:
        """Begins anew, since the sender has booted: the next frame may come at any time."""
        self.due_ns, self._last_ns, self._catching_up, self.silent = None, None, False, False

    def _measure(self, time_ns: int) -> None:
        last_ns, self._last_ns = self._last_ns, time_ns
        if last_ns is None:
            return
        gap_ns = time_ns - last_ns
        if not self._gaps:
            self._first_gap_ns = self._shortest_ns = self._longest_ns = gap_ns
        self._gaps += 1
        more_ns = gap_ns - self._first_gap_ns
        self._sum += more_ns
        self._squares += more_ns * more_ns
        if gap_ns < self._shortest_ns:
            self._shortest_ns = gap_ns
        elif gap_ns > self._longest_ns:
            self._longest_ns = gap_ns

    def report(self) -> TimingReport:
        """Returns the number of frames, and statistics of the periods from run time 0 on."""
        count = self._gaps
        if not count:
            return TimingReport(self.frames)
        variance = (count * self._squares - self._sum * self._sum) / (count * count)
        return TimingReport(
            frames=self.frames,
            period_mean=(self._first_gap_ns + self._sum / count) / 1e9,
            period_min=self._shortest_ns / 1e9,
            period_max=self._longest_ns / 1e9,
            jitter=float(variance**0.5) / 1e9,
        )


class BusTraffic:
    """The traffic of one bus: lengths of its frames, the present busy stretch, and the deadlines of its identifiers."""

    def __init__(self, plan: Plan, bus: int) -> None:
        bit_ns = 0.0 if plan.can.closed and plan.can.timing == "ideal" else 1e9 / plan.can.buses[bus].bitrate
        self.durations_ns = [ceil(worst_case_bits(length) * bit_ns) for length in range(9)]
        self.disturbed = any(event.kind == "error_frames" for event in plan.events)
        self.pause_ns = (DISTURBED if self.disturbed else 1) * (self.durations_ns[8] + ceil(_ERROR_BITS * bit_ns))
        self.last_ns = -NEVER_NS
        self.busy_ns = -NEVER_NS
        self.scan_ns = -NEVER_NS
        self.deadlines: dict[int, Deadline] = {}
        """By identifier"""
        self.boot_ups: dict[tuple[int, bytes], list[Deadline]] = {}
        """The deadlines that begin anew with a boot-up message, by its identifier and data"""

    def add(self, can_id: int, period_ns: int, tolerance_ns: int | None = None) -> Deadline:
        """Returns the deadline of an identifier and makes it if it is new; `period_ns` 0 means that it is not cyclic."""
        deadline = self.deadlines.get(can_id)
        if deadline is None:
            deadline = self.deadlines[can_id] = Deadline(can_id, period_ns, tolerance_ns)
            if self.disturbed:
                deadline.shift_ns = NEVER_NS
        return deadline

    def add_boot_ups(self, boot_ups: Mapping[tuple[int, bytes], frozenset[int]]) -> None:
        """Adds boot-up messages, by identifier and data, with the identifiers whose deadlines begin anew with them."""
        for frame, can_ids in boot_ups.items():
            self.boot_ups[frame] = [self.deadlines[can_id] for can_id in sorted(can_ids) if can_id in self.deadlines]

    @property
    def first_ns(self) -> int | None:
        """When the first frame with a known identifier came; None before."""
        return min((deadline.first_ns for deadline in self.deadlines.values() if deadline.frames), default=None)

    def cyclic(self) -> list[Deadline]:
        """Returns the deadlines of cyclic identifiers."""
        return [deadline for deadline in self.deadlines.values() if deadline.period_ns]
