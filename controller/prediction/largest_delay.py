"""How much later the messages of some links may be before the run near its formation is unstable (docs/architecture.md, 2.7).

All of these links get the same delay more, beyond what they have.  Where nodes and robots are time-driven it acts in ticks: a
message is used at instants of its receiver, and said at instants of its source.  Where they are event-driven, delays between
ticks count, and a message that comes just after an instant may be worse than one that comes at the next: a delay of 9.9 ms may
be unstable where 10 ms are stable.  So the first tick is searched for at whose end, just before the next, the run is unstable;
the boundary lies in this tick.  With less than a hyperperiod such a node waits for a message of the same period; with more, in
a chain of late links, it may act at another instant with the message before.  So between ticks less than a hyperperiod is tried
by itself, and the rest is counted from one hyperperiod on.

A *tick* is what divides the periods of all links and stages concerned, and the hyperperiod is m ticks.  A delay of k ticks more
is q hyperperiods and r ticks, k = q m + r with 0 ≤ r < m.  For each r the linear run with r ticks more is cut open where the
messages of these links are sent (`LinearRun.loop`).  From the messages that receivers get, to the messages that are sent, its
transfer matrix over a hyperperiod is

    R(z) = C (z - A)⁻¹ B + D

so with q hyperperiods more the roots are those of det(I - z^{-q} R(z)) = 0.  `controller.prediction.crossings` gives the q for
which the first root reaches the unit circle, without trying one delay after the other.  So no delay is too large, and periods
may be of any length.  The smallest k of all r is the answer.  This takes q as continuous, which is valid if the eigenvalues of
R(-1) are smaller than 1; small maps confirm it.

*Otherwise* delays are tried: one after the other up to `TRIED` ticks, then doubled and halved between.  The answer says so.
"""

from dataclasses import dataclass, replace
from math import gcd, inf, pi
from typing import Final, Literal

import numpy as np

from echelon.controller.prediction.crossings import smallest_delay, unstable_roots
from echelon.controller.prediction.cut_loop import Cut
from echelon.controller.prediction.gains import PredictionError
from echelon.controller.prediction.likeness import reduced
from echelon.controller.prediction.linear_run import Edges, LinearRun, edge_of, edges_of, later
from echelon.controller.prediction.schedule import LONGEST
from echelon.controller.prediction.spectrum import spectral_radius
from echelon.controller.transformation import Transformation
from echelon.messages import Channel
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Plan

TRIED: Final = 50
"""Ticks up to which all delays are tried, where the criterion is not valid"""
FINE: Final = 1e-3
"""How closely the boundary is found where stages are event-driven, as a share of the delay, or of a tick"""
STEPS: Final = 6
"""Largest number of steps of the iteration that finds it"""
CONFIRMED: Final = 800
"""Size of the largest map that is computed to confirm a result"""
WORTH: Final = 100
"""Largest delay for which a result is confirmed by maps [hyperperiods]"""
REMAINDERS: Final = 20
"""Largest number of ticks in a hyperperiod for which each remainder r is computed; with more, the last hyperperiod is
searched"""
NEAR: Final = 2.0
"""Between two ticks, crossings are searched only within this factor of the frequency at which the run first becomes unstable"""
SHARED: Final = 0.2
"""Blocks with less than this share of the largest motion of a block at the boundary do not count as what limits it"""

Ends = Literal["unstable", "timeout", "never", "limit"]


@dataclass(frozen=True, slots=True)
class LargestDelay:
    """How much later the messages of some links may be."""

    tick_s: float
    """Length of a tick [s]"""
    ticks: int | None
    """Every extra delay of 0 to `ticks` ticks is stable; None: even without extra delay the run is unstable, or every delay is
    stable"""
    ends: Ends
    """Why it is not more.  `unstable`: one tick more is unstable; `timeout`: it is older than a link's timeout allows; `never`:
    no delay is unstable; `limit`: longer delays have not been tried out"""
    beyond_s: float = 0.0
    """Where stages are event-driven: every delay up to `ticks` ticks and this is stable and young enough [s]; negative if a
    delay between two of these ticks is not"""
    tried: bool = False
    """True: found by trying delays, which may miss an unstable delay below a stable one"""
    limits: tuple[str, ...] = ()
    """The blocks that move in the motion that is at the edge of stability there"""

    @property
    def seconds(self) -> float | None:
        """The largest additional delay [s], infinite if no delay is unstable; None if not even 0 is stable."""
        if self.ticks is None:
            return inf if self.ends == "never" else None
        return self.ticks * self.tick_s + self.beyond_s


def largest_extra_delay(plan: Plan, late: Channel | Edges) -> LargestDelay:
    """Returns how much later the messages of some links, or of all links of a channel, may be, in a plan whose links have
    constant delays and lose no messages.

    Raises PredictionError if nothing exact can be said of the plan as it is, ValueError if it has no such link."""
    edges = edges_of(plan, late)
    if not edges:
        what = "these links" if isinstance(late, frozenset) else f"channel {late.name.lower()}"
        raise ValueError(f"{what}: there is no link of it")
    search = _Search(*reduced(plan, edges))
    found = search.in_ticks()
    if found.ticks is None or found.ends == "limit" or not any(one.event_driven for one in plan.formation):
        return found
    return replace(found, beyond_s=search.beyond(found) * 1e-9)


class _Search:
    """The search for the largest delay of some links of a plan."""

    def __init__(self, plan: Plan, late: Edges, names: tuple[tuple[str, ...], ...]) -> None:
        self._plan, self._late, self._names = plan, late, names
        self._patient = replace(plan, links=tuple(replace(link, timeout_ns=NEVER_NS) for link in plan.links))
        self._run = run = LinearRun(plan)
        self._links = [link for link in plan.links if edge_of(link) in late]
        self._tick_ns = gcd(*(link.period_ns for link in self._links), *run.periods(late))
        self._remainders = run.hyperperiod_ns // self._tick_ns
        self._cuts: dict[int, Cut] = {}
        self._window: tuple[float, float] | None = None

    def in_ticks(self) -> LargestDelay:
        """Returns the largest additional delay in whole ticks."""
        tick_s = self._tick_ns * 1e-9
        if spectral_radius(self._run.map()) >= 1:
            return LargestDelay(tick_s, None, "unstable")
        unstable, tried = self._first_unstable(), False
        if unstable is None:
            unstable, tried = self._first_tried(), True
        too_old = self._first_too_old(unstable)
        if too_old is not None and (unstable is None or unstable == -1 or too_old < unstable):
            return LargestDelay(tick_s, too_old - 1, "timeout", tried=tried)
        if unstable is None:  # only where delays are tried
            return LargestDelay(tick_s, self._longest(), "limit", tried=True)
        if unstable == -1:
            return LargestDelay(tick_s, None, "never")
        return LargestDelay(tick_s, unstable - 1, "unstable", tried=tried, limits=self._limits(unstable))

    def beyond(self, found: LargestDelay) -> int:
        """Returns how much more or less than whole ticks is stable and young enough [ns]."""
        assert found.ticks is not None
        whole_ns = found.ticks * self._tick_ns
        if found.ends == "timeout":
            low_ns, high_ns = whole_ns, whole_ns + self._tick_ns
            while high_ns - low_ns > max(1, FINE * high_ns):
                middle_ns = (low_ns + high_ns) // 2
                low_ns, high_ns = (low_ns, middle_ns) if self._is_too_old(middle_ns) else (middle_ns, high_ns)
            most_ns = low_ns
        else:
            most_ns = (found.ticks + 1) * self._tick_ns - 1
        first = None if found.tried else self._first_unstable(self._tick_ns - 1)
        if first is None:
            first = found.ticks
        low_ns, high_ns = first * self._tick_ns, (first + 1) * self._tick_ns - 1
        if high_ns > most_ns or self._bears(high_ns):
            return most_ns - whole_ns
        if (at_edge := self._cut(self._tick_ns - 1 + first % self._remainders * self._tick_ns).frequency) is not None:
            self._window, self._cuts = (at_edge / NEAR, min(NEAR * at_edge, pi)), {}
        if (near_ns := self._by_iteration(first)) is not None:
            return near_ns - whole_ns
        while high_ns - low_ns > max(1, FINE * self._tick_ns):
            middle_ns = (low_ns + high_ns) // 2
            low_ns, high_ns = (middle_ns, high_ns) if self._bears(middle_ns) else (low_ns, middle_ns)
        return low_ns - whole_ns

    def _by_iteration(self, ticks: int) -> int | None:
        """Returns the largest stable delay of `ticks` ticks and a part [ns] if all periods are equal; None if the iteration
        fails.

        With f ticks more, 0 <= f < 1, the run bears k*(f) whole ticks, taken as continuous.  The boundary is where that is
        `ticks`.  k*(f) + f hardly depends on f, so f + k*(f) - ticks converges to it in a few steps."""
        if self._remainders > 1:
            return None
        f = 0.5
        for _ in range(STEPS):
            part_ns = round(f * self._tick_ns)
            cut, before = self._cut(part_ns), self._before(part_ns)
            if ticks < before or not cut.is_stable or cut.found is None or (edge := smallest_delay(cut.found)) == inf:
                return None
            step = before + edge - ticks
            f += step
            if not 0 <= f < 1:
                return None
            if abs(step) < FINE:
                at_ns = ticks * self._tick_ns + round(f * self._tick_ns)
                off_ns = round(2 * FINE * self._tick_ns)
                sure = self._bears(max(0, at_ns - off_ns)) and not self._bears(at_ns + off_ns)
                return at_ns if sure else None
        return None

    def _bears(self, extra_ns: int) -> bool:
        """Returns whether the run is stable with all these messages later."""
        whole, part_ns = divmod(extra_ns, self._run.hyperperiod_ns)
        before = self._before(part_ns)
        if whole >= before:
            cut = self._cut(part_ns)
            if cut.found is not None and cut.is_stable:
                return unstable_roots(cut.found, whole - before) <= 0
        return spectral_radius(LinearRun(later(self._patient, self._late, extra_ns)).map()) < 1

    def _before(self, part_ns: int) -> int:
        """Returns how many hyperperiods more a run has before it is cut open: one for delays between ticks.

        With less than a hyperperiod an event-driven node waits for a message of the same period.  With more it does not, and in
        a chain of late links may use the one before, at another instant: the run is another one."""
        return 1 if part_ns % self._tick_ns else 0

    def _cut(self, extra_ns: int) -> Cut:
        """Returns the run with these messages later, and by `_before` hyperperiods more, cut open."""
        if extra_ns not in self._cuts:
            before_ns = self._before(extra_ns) * self._run.hyperperiod_ns
            run = LinearRun(later(self._patient, self._late, extra_ns + before_ns))
            self._cuts[extra_ns] = Cut(run, self._late, self._window)
        return self._cuts[extra_ns]

    def _first_unstable(self, part_ns: int = 0) -> int | None:
        """Returns the smallest number of ticks for which the run is unstable with these and `part_ns` more; -1 if there is
        none.

        Returns None if the criterion is not valid for the run, or is not confirmed by the maps."""
        least = inf
        m = self._remainders
        for r in range(m if m <= REMAINDERS else 1):
            if r >= least:
                break
            extra_ns = r * self._tick_ns + part_ns
            cut, before = self._cut(extra_ns), self._before(extra_ns)
            if before and not self._bears(extra_ns):
                least = r
                break
            if not cut.is_stable:
                least = min(least, before * m + r)
            elif cut.found is None:
                return None
            elif (q := cut.first_unstable()) is not None:
                least = min(least, (q + before) * m + r)
        if least == inf:
            return -1
        k = int(least)
        if m > REMAINDERS:
            low = max(-1, k - m)
            while k - low > 1:
                middle = (low + k) // 2
                low, k = (middle, k) if self._bears(middle * self._tick_ns + part_ns) else (low, middle)
        if not part_ns and k <= WORTH * m:
            for ticks, is_stable in ((k - 1, True), (k, False)):
                late = LinearRun(later(self._patient, self._late, ticks * self._tick_ns))
                if late.size <= CONFIRMED and (spectral_radius(late.map()) < 1) != is_stable:
                    return None
        return k

    def _first_tried(self) -> int | None:
        """Returns the smallest number of extra ticks that was found to be unstable, by trying; None if none was."""

        def bears(ticks: int) -> bool:
            late = LinearRun(later(self._patient, self._late, ticks * self._tick_ns))
            return spectral_radius(late.map()) < 1

        for ticks in range(1, min(TRIED, self._longest()) + 1):
            if not bears(ticks):
                return ticks
        low, high = TRIED, 2 * TRIED
        try:
            while bears(high):
                low, high = high, 2 * high
                if high > self._longest():
                    return None
            while high - low > 1:
                middle = (low + high) // 2
                low, high = (middle, high) if bears(middle) else (low, middle)
        except PredictionError:  # too long to compute with
            self._reached = low
            return None
        return high

    def _longest(self) -> int:
        """Returns the largest number of ticks that are tried."""
        longest_ns = LONGEST * self._run.hyperperiod_ns - max(link.delay_max_ns for link in self._plan.links)
        return min(getattr(self, "_reached", NEVER_NS), longest_ns // self._tick_ns)

    def _first_too_old(self, unstable: int | None) -> int | None:
        """Returns the smallest number of extra ticks, below `unstable`, with which messages are too old; None if there is
        none."""
        if all(link.timeout_ns >= NEVER_NS for link in self._links):
            return None
        low, high = 0, 1
        end = unstable if unstable is not None and unstable > 0 else self._longest()
        while not self._is_too_old(high * self._tick_ns):
            if high >= end:
                return None
            low, high = high, min(2 * high, end)
        while high - low > 1:
            middle = (low + high) // 2
            low, high = (low, middle) if self._is_too_old(middle * self._tick_ns) else (middle, high)
        return high

    def _is_too_old(self, extra_ns: int) -> bool:
        """Returns whether messages are older than their timeouts when they would be used."""
        try:
            LinearRun(later(self._plan, self._late, extra_ns))
        except PredictionError:
            return True
        return False

    def _limits(self, unstable: int) -> tuple[str, ...]:
        """Returns the names of the blocks that move most in the motion at the edge of stability."""
        q, r = divmod(unstable, self._remainders)
        cut = self._cuts.get(r * self._tick_ns)
        if cut is None or cut.found is None or (motions := cut.motions(q)) is None:
            return ()
        z = np.abs(Transformation(self._plan).matrix @ motions)
        moves: dict[tuple[str, ...], float] = {}
        for block, names in zip(self._plan.blocks, self._names, strict=True):
            rows = slice(block.offset // 2, (block.offset + block.size) // 2)
            if block.size:
                moves[names] = max(moves.get(names, 0.0), float(np.linalg.norm(z[:, rows])))
        most = max(moves.values())
        return tuple(name for names in moves if moves[names] > SHARED * most for name in names)
