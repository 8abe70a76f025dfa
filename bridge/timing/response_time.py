"""Worst-case response times of the frames on a CAN bus, and remedies for frames that do not fit.  Pure, integer nanoseconds.

After R. I. Davis, A. Burns, R. J. Bril, J. J. Lukkien, "Controller Area Network (CAN) schedulability analysis: Refuted,
revisited and revised", 2007.  A frame that has started is not interrupted.  C_k is the longest time on the bus of stream k,
T_k its period and J_k its jitter; hp and lp are the streams of higher and of lower priority than stream m:

    blocking      B   = max over lp of C_k
    busy period   L   = B + sum over hp and m of ⌈(L + J_k)/T_k⌉ C_k,  with ⌈(L + J_m)/T_m⌉ instances of m
    waiting       w_q = B + q C_m + sum over hp of ⌈(w_q + J_k + τ_bit)/T_k⌉ C_k    of instance q = 0, 1, …
    response      R   = max over q of J_m + w_q - q T_m + C_m

L and w_q are the least solutions.  A response ends with the last bit of the frame, without the three bits of interframe space,
as in `bridge.timing.arbitration`.  Assumptions: every node sends its frame of highest priority first; there are no bus errors.
"""

from bisect import bisect_left
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from itertools import accumulate, chain

from echelon.bridge.timing.bus_load import worst_case_bits

BITRATES = (125_000, 250_000, 500_000, 800_000, 1_000_000)
"""Usual bit rates of classic CAN controllers [bit/s]"""
_INTERFRAME = 3
_LONGEST_STRETCH = 1000


@dataclass(frozen=True, slots=True)
class Stream:
    """The frames of one identifier.

    They are due at least `period_ns` apart and are queued up to `jitter_ns` after that.  `bits` is the length of the longest
    frame, interframe space included.  Raises ValueError for a value that is too small."""

    can_id: int
    period_ns: int
    bits: int = worst_case_bits(8)
    jitter_ns: int = 0

    def __post_init__(self) -> None:
        least = {"can_id": 0, "period_ns": 1, "bits": _INTERFRAME + 1, "jitter_ns": 0}
        for name, value in least.items():
            if getattr(self, name) < value:
                raise ValueError(f"{name} must be at least {value}, not {getattr(self, name)!r}")


def load(streams: Sequence[Stream], bitrate: int) -> Fraction:
    """Returns the largest share of a bus of `bitrate` [bit/s] that the streams take: 1 is a full bus."""
    return sum((Fraction(_span(stream.bits, bitrate), stream.period_ns) for stream in streams), Fraction(0))


def response_times(streams: Sequence[Stream], bitrate: int) -> dict[int, int | None]:
    """Returns the worst-case response time of each identifier [ns]: from the instant at which it is due to its last bit.

    None means: it exceeds the period, or there is no bound since streams of higher priority fill the bus.
    Raises ValueError if two streams have the same identifier."""
    order = sorted(streams, key=lambda stream: stream.can_id)
    spans = [_span(stream.bits, bitrate) for stream in order]
    blocking = [*accumulate(reversed(spans), max, initial=0)][-2::-1]
    higher: Counter[tuple[int, int]] = Counter()  # time on the bus, summed over streams of equal period and jitter
    found: dict[int, int | None] = {}
    used = Fraction(0)
    for stream, span, blocked in zip(order, spans, blocking, strict=True):
        if stream.can_id in found:
            raise ValueError(f"each identifier must have one stream, {stream.can_id:#x} has more")
        used += Fraction(span, stream.period_ns)
        found[stream.can_id] = _response(stream, blocked, higher, bitrate) if used < 1 else None
        higher[stream.period_ns, stream.jitter_ns] += span
    return found


def fits(streams: Sequence[Stream], bitrate: int) -> bool:
    """Returns whether every frame is delivered within its period in the worst case."""
    return load(streams, bitrate) < 1 and None not in response_times(streams, bitrate).values()


def _span(bits: int, bitrate: int) -> int:
    return -(-bits * 1_000_000_000 // bitrate)


def _response(own: Stream, blocking: int, higher: Mapping[tuple[int, int], int], bitrate: int) -> int | None:
    """Returns the worst-case response time of a stream, None if it exceeds the period; the bus must not be full."""
    period, jitter = own.period_ns, own.jitter_ns
    length, bit = _span(own.bits, bitrate), _span(1, bitrate)

    def interference(time_ns: int) -> int:
        return sum(-(-(time_ns + jitter) // period) * span for (period, jitter), span in higher.items())

    busy = _least(blocking, lambda time: -(-(time + jitter) // period) * length + interference(time), length)
    worst = waiting = 0
    for q in range(-(-(busy + jitter) // period)):
        waiting = _least(blocking + q * length, lambda time: interference(time + bit), waiting)
        response = jitter + waiting - q * period + _span(own.bits - _INTERFRAME, bitrate)
        if response > period:
            return None
        worst = max(worst, response)
    return worst


def _least(base: int, growing: Callable[[int], int], start: int) -> int:
    """Returns the least x with x = `base` + `growing`(x), which must be known to be at least `start`."""
    value = max(base, start)
    while (following := base + growing(value)) != value:
        value = following
    return value


@dataclass(frozen=True, slots=True)
class Remedies:
    """Remedies for a set of frames that does not fit.  Each is enough by itself; None: this remedy does not help."""

    buses: tuple[tuple[str, ...], ...] | None
    """The robots of each bus, over as few buses as possible, in the given order"""
    stretch: int | None
    """The smallest whole factor by which each robot's shortest period must be multiplied"""
    bitrate: int | None
    """The lowest sufficient of the usual bit rates [bit/s]"""


def remedies(robots: Mapping[str, Sequence[Stream]], bitrate: int, shared: Sequence[Stream] = ()) -> Remedies:
    """Returns what would make the robots' streams fit; `shared` are streams that every bus has."""

    def fit(names: Sequence[str], rate: int = bitrate, stretch: int = 1) -> bool:
        groups = [shared, *(robots[name] for name in names)]
        return fits(list(chain.from_iterable(_stretched(group, stretch) for group in groups)), rate)

    names = list(robots)
    # a set that fits still fits with longer periods, so bisection finds the smallest factor
    stretch = 1 + bisect_left(range(1, _LONGEST_STRETCH + 1), True, key=lambda times: fit(names, stretch=times))
    return Remedies(
        _split(names, fit),
        stretch if stretch <= _LONGEST_STRETCH else None,
        next((rate for rate in BITRATES if rate >= bitrate and fit(names, rate)), None),
    )


def advice(robots: Mapping[str, Sequence[Stream]], bitrate: int, shared: Sequence[Stream] = ()) -> list[str]:
    """Returns one line for each remedy that makes the robots' streams fit a bus of `bitrate`; no lines if they fit already.

    If no remedy helps, one line says so."""
    if fits([*shared, *chain.from_iterable(robots.values())], bitrate):
        return []
    ways = remedies(robots, bitrate, shared)
    lines = []
    if ways.buses:
        groups = "; ".join(f"{names[0]} … {names[-1]}" if len(names) > 1 else names[0] for names in ways.buses)
        lines.append(f"fits over {len(ways.buses)} buses of {_rate(bitrate)}: {groups}")
    if ways.stretch:
        periods = sorted({min(stream.period_ns for stream in group) for group in robots.values() if group})
        longer = ", ".join(f"{period * ways.stretch / 1e6:g} ms instead of {period / 1e6:g} ms" for period in periods)
        lines.append(f"fits with longer periods: {longer}")
    if ways.bitrate:
        lines.append(f"fits at {_rate(ways.bitrate)}")
    return lines or [f"fits neither over several buses, nor with longer periods, nor at {_rate(BITRATES[-1])}"]


def _split(names: Sequence[str], fit: Callable[[Sequence[str]], bool]) -> tuple[tuple[str, ...], ...] | None:
    """Fills one bus after the other, then spreads the robots evenly if they still fit."""
    buses: list[list[str]] = [[]]
    for name in names:
        if fit([*buses[-1], name]):
            buses[-1].append(name)
        elif buses[-1] and fit([name]):
            buses.append([name])
        else:
            return None
    ends = [len(names) * n // len(buses) for n in range(len(buses) + 1)]
    even = [names[begin:end] for begin, end in zip(ends, ends[1:], strict=False)]
    return tuple(tuple(group) for group in (even if all(map(fit, even)) else buses))


def _stretched(group: Sequence[Stream], times: int) -> list[Stream]:
    shortest = min((stream.period_ns for stream in group), default=0)
    return [replace(stream, period_ns=shortest * times) if stream.period_ns == shortest else stream for stream in group]


def _rate(bitrate: int) -> str:
    return f"{bitrate / 1e6:g} Mbit/s" if bitrate >= 1_000_000 else f"{bitrate / 1e3:g} kbit/s"
