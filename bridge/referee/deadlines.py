"""When cyclic frames are due on a bus, and which come late, early, or not at all.  Pure.

A frame waits while others have the bus, and a full bus breaks no contract.  So a frame is only late by the time that the
bus was free while it was due: from then to the beginning of the stretch of frames, one right after the other, that it is
part of.  The next one is due a period after this one was.

A frame that is missing shifts all later ones by a period.  On a busy bus only a part of that can be told from waiting, so
five frames in a row that are late by 2 ms and an eighth of the period are a gap, too; nothing can be told of a bus that is
never free for so long.  Pauses shorter than a frame and an error frame count as busy, for destroyed frames are not seen;
where the plan has disturbances, pauses shorter than five of them, and frames in a row are not looked at.

What may come early.  A sender that was held up may send what it owes at once, frames that follow each other within half a
period, until one is due again; with the first that does not follow so it has caught up, and what has not come is lost.  A
remote frame asks for one more as well, and a command for no torque may come at any time.  A drive that boots, and says so,
begins anew.
"""

from collections.abc import Mapping
from math import ceil
from typing import Final

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.wheel_check import WheelCheck
from echelon.bridge.reports import TimingReport
from echelon.bridge.timing.bus_load import worst_case_bits
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Plan

SHIFT_NS: Final = 2_000_000
SHIFTED: Final = 5
"""So many frames in a row that are later than this, and than an eighth of their period, are a gap, too"""
DISTURBED: Final = 5
"""So many frames in a row may be destroyed in a plan that wants disturbances"""
_ERROR_BITS: Final = 23
"""Of the longest error frame and the pause after it"""


class Deadline:
    """One identifier: whose it is, its period (0: it comes as it likes), when it is due."""

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
        """A frame without data asks for one, as a remote frame does"""
        self.frames = 0
        self.first_ns = 0
        self.due_ns: int | None = None
        self.silent = False  # which was told
        self._owed = 0  # frames that were asked for
        self._catching_up = False  # it may send what it owes
        self._begin_ns = 0  # of the last frame
        self._shifted = self._shift_ns = 0  # how many frames in a row were late, by how much at least
        self._last_ns: int | None = None  # in the run
        self._gaps = self._sum = self._squares = 0  # of distances, less the first one's
        self._first_gap_ns = self._shortest_ns = self._longest_ns = 0

    @property
    def robot(self) -> WheelCheck | None:
        """Whose it is, if only one's."""
        return self.robots[0] if len(self.robots) == 1 else None

    def take(self, time_ns: int, begin_ns: int, busy_ns: int, frame: Frame) -> tuple[str, str] | None:
        """Takes a frame that began at `begin_ns`, in a stretch of frames that did at `busy_ns`; says if it is untimely."""
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
        elif self._catching_up and begin_ns - last_ns > self.half_ns:  # what it owes and did not send is lost
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
        """Keeps `due_ns` with a sender whose clock is a little slower; says if the last frames were all late."""
        assert self.due_ns is not None
        if after_ns <= self.shift_ns:
            self._shifted = 0
            self.due_ns += max(0, late_ns) // 8
        elif late_ns > self.shift_ns:  # and not within a stretch, where nobody can tell
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
        """When the next one is due, or will be when the sender has caught up; None before the first."""
        return None if self.due_ns is None else max(self.due_ns, self._begin_ns + self.period_ns)

    def forget(self) -> None:
        """Its sender begins anew."""
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
        """Returns the frames in all, and the periods between those of the run."""
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
    """One bus: how long its frames take at most, when the present stretch of frames began, what to look for."""

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
        """What begins anew with a frame, by its identifier and data"""

    def add(self, can_id: int, period_ns: int, tolerance_ns: int | None = None) -> Deadline:
        """Returns the deadline of an identifier, a new one if there is none; period 0: it comes as it likes."""
        deadline = self.deadlines.get(can_id)
        if deadline is None:
            deadline = self.deadlines[can_id] = Deadline(can_id, period_ns, tolerance_ns)
            if self.disturbed:
                deadline.shift_ns = NEVER_NS
        return deadline

    def add_boot_ups(self, boot_ups: Mapping[tuple[int, bytes], frozenset[int]]) -> None:
        """Takes note of frames with which identifiers begin anew."""
        for frame, can_ids in boot_ups.items():
            self.boot_ups[frame] = [self.deadlines[can_id] for can_id in sorted(can_ids) if can_id in self.deadlines]

    @property
    def first_ns(self) -> int | None:
        """When the first known frame came."""
        return min((deadline.first_ns for deadline in self.deadlines.values() if deadline.frames), default=None)

    def cyclic(self) -> list[Deadline]:
        """Identifiers that must come regularly."""
        return [deadline for deadline in self.deadlines.values() if deadline.period_ns]
