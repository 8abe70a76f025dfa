"""How much later all messages of a channel may be before the run near its formation is unstable (docs/architecture.md, 2.7).

All links of the channel get the same delay more, beyond what they have.  Where nodes and robots are time-driven it acts in
ticks: a message is used at instants of its receiver, and said at instants of its source.  Where they are event-driven, whole
ticks more shift what is used by as many messages; between the last stable tick and the next, bisection with the map finds the
boundary: by an iteration with the cut run, or else by bisection with the map.

*If all periods are equal*, the linear run is cut open where the messages of the channel are sent (`LinearRun.loop`).  From the
messages that receivers get, to the messages that are sent, its transfer matrix is

    R(z) = C (z - A)⁻¹ B + D

so with k extra ticks the roots are those of det(I - z^{-k} R(z)) = 0.  `controller.prediction.crossings` gives the k for which
the first root reaches the unit circle, without trying one delay after the other, so that no delay is too large.  This takes k
as continuous, which is valid if the eigenvalues of R(-1) are smaller than 1.  The result is confirmed by the maps for k and for
k - 1 ticks, unless they are larger than `CONFIRMED`.

*Otherwise* one delay after the other is tried, up to `TRIED` ticks.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from math import ceil, gcd, inf, pi
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import block_array, csc_array, csr_array, eye_array
from scipy.sparse.linalg import splu

from echelon.controller.prediction.crossings import Crossing, Eigenvalues, crossings, smallest_delay, unstable_roots
from echelon.controller.prediction.gains import PredictionError, linear_gains
from echelon.controller.prediction.linear_run import LinearRun, Loop, later, ruled_links
from echelon.controller.prediction.spectrum import spectral_radius, strong_parts
from echelon.messages import Channel
from echelon.plan.can_plan import NEVER_NS
from echelon.plan.plan import Array, Plan

TRIED: Final = 50
"""Ticks up to which delays are tried out"""
FINE: Final = 1e-3
"""How closely the boundary is found where stages are event-driven, as a share of the delay, or of a tick"""
STEPS: Final = 6
"""Largest number of steps of the iteration that finds it"""
CONFIRMED: Final = 800
"""Size of the largest map that is computed to confirm a result"""
SLOW: Final = 1e-3
"""Crossings are searched from this multiple of the slowest block's natural frequency upwards"""
SMALL: Final = 150
"""Number of unknowns up to which equations are solved with dense matrices"""
RANK: Final = 1e-12
"""Singular values below this share of the largest one count as zero"""
_TOGETHER: Final = 32
"""Number of frequencies that are computed at once"""


@dataclass(frozen=True, slots=True)
class LargestDelay:
    """How much later the messages of a channel may be."""

    tick_s: float
    """Length of a tick [s]"""
    ticks: int | None
    """Every extra delay of 0 to `ticks` ticks is stable; None: even without extra delay the run is unstable"""
    ends: Literal["unstable", "timeout", "limit"]
    """Why it is not more: one tick more is unstable, or older than a link's timeout allows, or has not been tried out"""
    beyond_s: float = 0.0
    """How much more than `ticks` ticks is stable or young enough [s], where stages are event-driven"""

    @property
    def seconds(self) -> float | None:
        """The largest additional delay [s]; None if not even 0 is stable."""
        return None if self.ticks is None else self.ticks * self.tick_s + self.beyond_s


def largest_extra_delay(plan: Plan, channel: Channel) -> LargestDelay:
    """Returns how much later all messages of a channel may be, in a plan whose links have constant delays and lose no messages.

    Raises PredictionError if nothing exact can be said of the plan as it is, ValueError if it has no such link."""
    found = _in_ticks(plan, channel)
    if found.ticks is None or found.ends == "limit" or not any(one.event_driven for one in plan.formation):
        return found
    tick_ns = round(found.tick_s * 1e9)
    beyond_ns = _beyond(plan, channel, found.ticks, tick_ns) if found.ends == "unstable" else None
    if beyond_ns is None:
        low_ns, high_ns = found.ticks * tick_ns, (found.ticks + 1) * tick_ns
        while high_ns - low_ns > max(1, FINE * high_ns):
            middle_ns = (low_ns + high_ns) // 2
            low_ns, high_ns = (middle_ns, high_ns) if _bears(plan, channel, middle_ns) else (low_ns, middle_ns)
        beyond_ns = low_ns - found.ticks * tick_ns
    return replace(found, beyond_s=beyond_ns * 1e-9)


def _beyond(plan: Plan, channel: Channel, ticks: int, tick_ns: int) -> int | None:
    """Returns how much more than `ticks` ticks is stable [ns] if all periods are equal; None if the criterion fails.

    With f ticks more, 0 <= f < 1, the run bears k*(f) whole ticks, taken as continuous.  The boundary is where that is `ticks`.
    k*(f) + f hardly depends on f, so f + k*(f) - ticks converges to it in a few steps."""
    f = 0.0
    for _ in range(STEPS):
        run = LinearRun(later(plan, channel, round(f * tick_ns)))
        found = None if run.periods() != {tick_ns} else _crossings(run, channel)
        if not found or (edge := smallest_delay(found)) == inf:
            return None
        step = edge - ticks
        f += step
        if not 0 <= f < 1:
            return None
        if abs(step) < FINE:
            return int(f * tick_ns)
    return None


def _bears(plan: Plan, channel: Channel, extra_ns: int) -> bool:
    """Returns whether the run is stable with all messages of a channel later, and none older than its timeout."""
    try:
        return spectral_radius(LinearRun(later(plan, channel, extra_ns)).map()) < 1
    except PredictionError:
        return False


def _in_ticks(plan: Plan, channel: Channel) -> LargestDelay:
    """Returns the largest additional delay in whole ticks; see `largest_extra_delay`."""
    links = ruled_links(plan, channel)
    if not links:
        raise ValueError(f"channel {channel.name.lower()}: there is no link of it")
    run = LinearRun(plan)
    tick_ns = gcd(*(link.period_ns for link in links), *run.periods(channel))
    if spectral_radius(run.map()) >= 1:
        return LargestDelay(tick_ns * 1e-9, None, "unstable")
    is_single_rate = run.periods() == {tick_ns}
    if is_single_rate and (unstable := _first_unstable(run, channel)) is not None:
        too_old = min(link.timeout_ns // tick_ns - -(-link.delay_min_ns // tick_ns) for link in links) + 1
        ends: Literal["unstable", "timeout"] = "unstable" if unstable < too_old else "timeout"
        return LargestDelay(tick_ns * 1e-9, min(unstable, too_old) - 1, ends)
    for ticks in range(1, TRIED + 1):
        try:
            late = LinearRun(later(plan, channel, ticks * tick_ns))
        except PredictionError:
            return LargestDelay(tick_ns * 1e-9, ticks - 1, "timeout")
        if spectral_radius(late.map()) >= 1:
            return LargestDelay(tick_ns * 1e-9, ticks - 1, "unstable")
    return LargestDelay(tick_ns * 1e-9, TRIED, "limit")


def _first_unstable(run: LinearRun, channel: Channel) -> int | None:
    """Returns the smallest number of extra ticks k for which a run is unstable that is stable for k = 0.

    Returns None if the criterion is not valid for the run, finds no such k, or is not confirmed by the maps."""
    plan, found = run.plan, _crossings(run, channel)
    if found is None or (edge := smallest_delay(found)) == inf:
        return None
    k = max(1, ceil(edge))
    while unstable_roots(found, k) <= 0:
        k += 1
    for ticks, is_stable in ((k - 1, True), (k, False)):
        late = LinearRun(later(_patient(plan), channel, ticks * run.hyperperiod_ns))
        if late.size <= CONFIRMED and (spectral_radius(late.map()) < 1) != is_stable:
            return None
    return k


def _crossings(run: LinearRun, channel: Channel) -> list[Crossing] | None:
    """Returns where eigenvalues of R(e^{jω}) cross the unit circle; None if the criterion is not valid for the run."""
    plan = run.plan
    stiffness = [linear_gains(plan, block).K_1 for block in plan.blocks if block.size]
    slowest = min(float(np.sqrt(np.abs(np.linalg.eigvals(K_1)).min())) for K_1 in stiffness)
    low = SLOW * slowest * run.hyperperiod_ns * 1e-9
    found: list[Crossing] = []
    for eigenvalues in _parts(run.loop(channel)):
        if np.abs(eigenvalues(np.array([pi]))).max() >= 1:
            return None
        found += crossings(eigenvalues, low, pi)
    return found


def _patient(plan: Plan) -> Plan:
    """Returns the plan with links without timeouts."""
    return replace(plan, links=tuple(replace(link, timeout_ns=NEVER_NS) for link in plan.links))


def _parts(loop: Loop) -> Iterator[Eigenvalues]:
    """Yields the eigenvalues of R(e^{jω}) as functions of ω, for each part of the run whose variables act on each other.  Equal
    parts are yielded once."""
    size = loop.A.shape[0]
    seen = set()
    for rows in strong_parts(csr_array(block_array([[loop.A, loop.B], [loop.C, loop.D]]))):
        x, u = rows[rows < size], rows[rows >= size] - size
        part = Loop(loop.A[x][:, x], loop.B[x][:, u], loop.C[u][:, x], loop.D[u][:, u])
        known = tuple(matrix.toarray().tobytes() for matrix in (part.A, part.B, part.C, part.D))
        if part.B.nnz + part.D.nnz and known not in seen:
            seen.add(known)
            yield _eigenvalues(part)


def _eigenvalues(part: Loop) -> Eigenvalues:
    """Returns the eigenvalues of R(e^{jω}) as a function of ω.

    The messages that receivers get act through few combinations, (B; D) = F V with a V of few rows.  So R has the eigenvalues
    of the smaller matrix V (C (z - A)⁻¹, 1) F; the others are zero."""
    size = part.A.shape[0]
    left, strengths, V = np.linalg.svd(np.vstack([part.B.toarray(), part.D.toarray()]), full_matrices=False)
    rank = int((strengths > RANK * strengths.max()).sum())
    F, V = left[:, :rank] * strengths[:rank], V[:rank]
    VC, VD = V @ part.C, V @ F[size:]
    into_x = F[:size].astype(complex)
    dense, sparse, unit = part.A.toarray() if size <= SMALL else None, csc_array(part.A), eye_array(size, format="csc")

    def states(z: NDArray[np.complex128]) -> NDArray[np.complex128]:
        """Returns (z - A)⁻¹ F for several z."""
        if dense is not None:
            return np.linalg.solve(z[:, None, None] * np.eye(size) - dense, into_x[None])
        return np.array([splu(csc_array(each * unit - sparse)).solve(into_x) for each in z])

    def eigenvalues(omega: Array) -> NDArray[np.complex128]:
        some = np.array_split(omega, max(1, len(omega) // _TOGETHER))
        return np.concatenate([np.linalg.eigvals(VC @ states(np.exp(1j * each)) + VD) for each in some])

    return eigenvalues
