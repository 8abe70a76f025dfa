"""The text that `echelon analyse` prints for people."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from echelon.sim.results.analysis import AnalysisResult, DelayResult, LinksResult, LossResult, ModesResult

NAMES: Final = 3
"""Largest number of names in a list; of more there is a number"""


def lines_of(found: "AnalysisResult", warnings: Sequence[str]) -> list[str]:
    """Returns the results as lines; `warnings` are those about torque loops."""
    channels = _enumeration(list(found.delays))
    accelerations, torques = (_ms(periods) for periods in (found.acceleration_periods, found.torque_periods))
    late = [f"{channel} {_ms(delays)}" for channel, delays in found.delays.items() if max(delays) > 0]
    step = f"spectral radius {found.spectral_radius:.6f} over {_ms([found.hyperperiod])}"
    outcome = "settles; errors shrink" if found.settles else "does not settle; errors grow"
    long = "" if found.time_constant is None else f" e-fold in {found.time_constant:.3g} s"
    lines = [
        f"{found.scenario}: channels {channels}; accelerations every {accelerations}, torques every {torques}",
        f"  delays of the scenario's links: {', '.join(late) if late else 'none'}; no link loses messages",
        f"  assumed: {', '.join(found.assumptions)}",
        f"  {outcome}{long} ({step})",
        *(f"  but {each}" for each in warnings),
    ]
    if found.centroid_age > 0 and found.settles:
        lines.append(
            f"  positions are {1e3 * found.centroid_age:.4g} ms old at the coordinator: the centroid of a moving formation is "
            "off its trajectory by the distance that it moves in this time"
        )
    lines += ["", *_blocks(found)]
    if found.torque_loop_diverges or not found.settles:
        return lines
    return [*lines, "", *_links(found), *_scales(found), *_torque(found), *(f"  {each}" for each in found.not_computed)]


def _blocks(found: "AnalysisResult") -> list[str]:
    """Returns the table of the blocks."""
    settled = {one.block: one.settled for one in found.settling}

    def row(one: "ModesResult") -> tuple[str, ...]:
        margin = "unstable" if one.delay_margin is None else f"{1e3 * one.delay_margin:.4g} ms"
        times = [settled[name] for name in one.names if name in settled]
        when = (
            "?" if not times else "not" if None in times else f"{max(time for time in times if time is not None):.4g} s"
        )
        rate = "?" if one.decay_rate is None else f"{one.decay_rate:.4g} 1/s"
        turning = "" if not one.frequency else f"{one.frequency:.4g} rad/s"
        cost = "?" if one.cost_share is None else f"{100 * one.cost_share:.3g} %"
        return _counted(one.names), one.layer, f"{one.sigma:.4g} s", rate, turning, when, cost, margin

    head = ("block", "layer", "σ", "decays at", "turns at", "settles", "of the cost", "delay alone")
    return [
        "  blocks: the slowest mode as sampled, when |e| settles to 2 % from the start, the share of ∫|e|² dt, and the delay "
        "that the block alone bears in continuous time",
        *_table(head, [row(one) for one in found.blocks]),
    ]


def _links(found: "AnalysisResult") -> list[str]:
    """Returns the tables of what links bear."""
    late = any(max(delays) > 0 for delays in found.delays.values())
    beyond = "beyond the scenario's delays" if late else "than now"
    lines = [
        f"  how much later messages may be {beyond}, or how many may be lost by chance, on all links of a row together"
    ]
    classes = [one for one in found.table if one.kind == "class"]
    rows = [
        (one.layer or "", one.channel or "", _delay(one.delay), _ticks(one.delay), _loss(one.loss), _limit(one.delay))
        for one in classes
    ]
    lines += _table(("layer", "channel", "delay", "ticks", "loss", "what limits it"), rows)
    known = {(one.delay.seconds, one.links, one.layer, one.channel) for one in classes}
    others = [
        one
        for one in found.table
        if one.kind != "class" and (one.delay.seconds, one.links, one.layer, one.channel) not in known
    ]
    if others:
        further = [(_named(one), _delay(one.delay), _ticks(one.delay), _limit(one.delay)) for one in others]
        lines += ["", *_table(("links", "delay", "ticks", "what limits it"), further)]
    reasons = dict.fromkeys(one.loss.why for one in classes if one.loss is not None and one.loss.why)
    return [*lines, *(f"  loss: {why}" for why in reasons)]


def _scales(found: "AnalysisResult") -> list[str]:
    """Returns the lines about ε and couplings."""
    lines = []
    if found.epsilon:
        head = ("ε", "now", "sampled from", "to", "exact", "of its layers", "bound", "by norms", "paper's formula")
        rows = []
        for at, one in enumerate(found.epsilon, 1):
            low, high = (_number(each, "any") for each in (one.sampled_low, one.sampled_high))
            rest = [_bound(each) for each in (one.exact, one.exact_of_layers, one.bound, one.bound_by_norms)]
            rows.append((f"ε{at}", f"{one.value:g}", low, high, *rest, _number(one.paper_formula, "")))
        lines += [
            "",
            "  ε for which the formation is stable, the others as they are: with these periods and links; in continuous time, "
            "exact; by Lyapunov functions (the paper's formula proves nothing)",
            *_table(head, rows),
        ]
    if found.coupling is not None:
        by, sampled = (_number(value, "any") for value in (found.coupling.exact, found.coupling.sampled))
        lines.append(f"  all couplings may be multiplied by up to {by} (continuous time), {sampled} (as sampled)")
    return lines


def _torque(found: "AnalysisResult") -> list[str]:
    """Returns the line about torque loops."""
    moving = [one for one in found.torque_loops if one.longest_period is not None and one.factor is not None]
    if not moving:
        return []
    worst = min(moving, key=lambda one: (one.longest_period or 0.0) / one.period)
    return [
        f"  torque loops: stable; nearest to its edge is {worst.robot} at {worst.speed:.3g} m/s, which bears a torque period "
        f"of up to {1e3 * (worst.longest_period or 0.0):.3g} ms"
    ]


def _delay(found: "DelayResult") -> str:
    """Returns a largest delay in words."""
    if found.ends == "never":
        return "any"
    if found.seconds is None:
        return "none"
    return f"{1e3 * found.seconds:.6g} ms"


def _ticks(found: "DelayResult") -> str:
    if found.seconds is None:
        return ""
    return f"{found.seconds / found.tick:.4g} of {1e3 * found.tick:g} ms"


def _limit(found: "DelayResult") -> str:
    """Returns in words what limits a delay."""
    tried = "; found by trying" if found.tried else ""
    match found.ends:
        case "timeout":
            return "older than the timeout: not used at all"
        case "limit":
            return "longer delays have not been tried"
        case "never":
            return "nothing"
        case _:
            return _counted(found.limits) + tried


def _loss(found: "LossResult | None") -> str:
    """Returns a largest share of lost messages in words."""
    if found is None or found.why:
        return "?"
    if found.share is None:
        return "none"
    return f"{'over ' if found.ends == 'limit' else ''}{100 * found.share:.3g} %"


def _named(one: "LinksResult") -> str:
    return f"{one.name} ({len(one.like)} alike)" if len(one.like) > 1 else one.name


def _counted(names: Sequence[str]) -> str:
    """Returns names as a list; of many the first and their number."""
    return f"{names[0]} and {len(names) - 1} more" if len(names) > NAMES else _enumeration(names)


def _bound(value: float | None) -> str:
    return "none" if value == 0 else _number(value, "any")


def _number(value: float | None, none: str) -> str:
    return none if value is None else f"{value:.4g}"


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> Iterable[str]:
    """Returns lines with columns of equal width."""
    wide = [max(len(row[at]) for row in (head, *rows)) for at in range(len(head))]
    return [
        "    " + "  ".join(cell.ljust(width) for cell, width in zip(row, wide, strict=True)).rstrip()
        for row in (head, *rows)
    ]


def _ms(seconds: Sequence[float]) -> str:
    """Returns times [s] as text in milliseconds: one number if all are equal, else the smallest and the largest."""
    least, most = (f"{1e3 * each:g}" for each in (min(seconds), max(seconds)))
    return f"{least} ms" if least == most else f"{least} to {most} ms"


def _enumeration(names: Sequence[str]) -> str:
    """Returns names as a list in words: `a, b and c`."""
    if len(names) < 2:
        return "".join(names)
    return f"{', '.join(names[:-1])} and {names[-1]}"
