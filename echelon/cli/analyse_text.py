"""The text that `echelon analyse` prints for people."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

from echelon.cli.analyse_links_text import links_lines, loss_text, scales_lines
from echelon.cli.formatting import counted, enumeration, ms, percent, rate, table

if TYPE_CHECKING:
    from echelon.sim.results.analysis import AnalysisResult, BlackoutResult, ModesResult
    from echelon.sim.results.links_analysis import PolicyResult


def lines_of(found: "AnalysisResult", warnings: Sequence[str]) -> list[str]:
    """Returns the results as lines; `warnings` are those about torque loops."""
    channels = enumeration(list(found.delays))
    accelerations, torques = (ms(periods) for periods in (found.acceleration_periods, found.torque_periods))
    late = [f"{channel} {ms(delays)}" for channel, delays in found.delays.items() if max(delays) > 0]
    lost = [f"{channel} {percent(shares)}" for channel, shares in found.losses.items()]
    policies = [f"{channel} {enumeration(names)}" for channel, names in found.policies.items()]
    lines = [
        f"{found.scenario}: channels {channels}; accelerations every {accelerations}, torques every {torques}",
        f"  delays of the scenario's links: {', '.join(late) if late else 'none'}; "
        + (f"lost messages: {', '.join(lost)}" if lost else "no link loses messages")
        + (f"; policies: {', '.join(policies)}" if policies else ""),
        f"  assumed: {', '.join(found.assumptions)}",
        *_verdict(found),
        *(f"  but {each}" for each in warnings),
    ]
    if found.centroid_age > 0 and found.settles:
        lines.append(
            f"  positions are {1e3 * found.centroid_age:.4g} ms old at the coordinator: the centroid of a moving formation is "
            "off its trajectory by the distance that it moves in this time"
        )
    if found.calm:
        lines.append(f"  what follows is exact {found.calm}, unless it says otherwise")
    lines += ["", *_blocks(found), *_cost(found)]
    lines += [line for one in found.blackouts for line in _blackout(one)]
    left = [f"  not computed: {each}" for each in found.not_computed]
    if found.torque_loop_diverges or not found.settles:
        return [*lines, *left]
    tables = ["", *links_lines(found)] if found.table else []
    return [*lines, *tables, *_effects(found), *scales_lines(found), *_torque(found), *left]


def _verdict(found: "AnalysisResult") -> list[str]:
    """Returns the lines about whether errors vanish with the links as they are."""
    one = found.verdict
    mean = " in the mean square" if found.random else ""
    outcome = f"settles{mean}; errors shrink" if found.settles else f"does not settle{mean}; errors grow"
    long = "" if found.time_constant is None else f" e-fold in {found.time_constant:.3g} s"
    if one.method == "exact":
        lines = [f"  {outcome}{long} (spectral radius {found.spectral_radius:.6f} over {ms([found.hyperperiod])})"]
    else:
        ends = [rate(end) for end in (one.rate_low, one.rate_high)]
        sure = f"{one.runs} runs: at a rate of {ends[0]} to {ends[1]} with 95 %" if found.random else "a run"
        lines = [
            f"  {outcome}{long} (estimated by {sure})",
            f"  not exact: {one.why}",
        ]
    if one.typical_rate is not None:
        does = "shrinks" if one.typical_rate > 0 else "grows"
        lines.append(
            f"  a typical run {does} e-fold in {1 / abs(one.typical_rate):.3g} s (estimated; a single run that holds says "
            "nothing about the mean square)"
        )
    return lines


def _cost(found: "AnalysisResult") -> list[str]:
    """Returns the line about the expected cost."""
    cost = found.cost
    if cost.total is None:
        return [f"  expected cost: not computed: {cost.why}"]
    if cost.method == "exact":
        return [f"  expected cost ∫|e|² dt until all errors have vanished: {cost.total:.5g} m² s (exact)"]
    if not found.random:
        return [f"  cost ∫|e|² dt: {cost.total:.4g} m² s (of a run); not exact: {cost.why}"]
    return [
        f"  expected cost ∫|e|² dt: {cost.total:.4g} ± {cost.error:.2g} m² s (estimated: mean and standard error of "
        f"{cost.runs} runs); not exact: {cost.why}"
    ]


def _blackout(one: "BlackoutResult") -> list[str]:
    """Returns the lines about a blackout."""
    head = (
        f"  blackout of {one.links} links ({enumeration(one.channels)}) from {one.at:g} s on for {one.duration:g} s: "
    )
    if not one.blocks:
        return [f"{head}not computed: {one.why}"]
    rows = [
        (
            each.block,
            f"{each.peak:.4g} m",
            f"{each.peak_time:.4g} s",
            "not within the run" if each.recovery is None else f"{each.recovery:.4g} s",
        )
        for each in one.blocks
    ]
    how = "exact" if one.method == "exact" else f"estimated by runs; not exact: {one.why}"
    return [f"{head}{how}", *table(("block", "largest |e|", "at", "recovers after the end in"), rows)]


def _effects(found: "AnalysisResult") -> list[str]:
    """Returns the table of what policies buy."""
    if not found.effects:
        return []
    why = dict.fromkeys(each for one in found.effects for each in (one.why, one.loss.why) if each)
    rows = [
        (one.channel, one.policy + (" (own)" if one.own else ""), _by_policy(one), loss_text(one.loss))
        for one in found.effects
        if not one.why
    ]
    head = "  what policies buy: the largest delay and loss of a channel, time-driven, in whole periods"
    shown = [head, *table(("channel", "policy", "delay", "loss"), rows)] if rows else [f"{head}: not computed"]
    return ["", *shown, *(f"  policies: {each}" for each in why)]


def _by_policy(one: "PolicyResult") -> str:
    if one.delay is None:
        return "none"
    return f"{1e3 * one.delay:.6g} ms{' and more' if one.delay_ends == 'limit' else ''}"


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
        return counted(one.names), one.layer, f"{one.sigma:.4g} s", rate, turning, when, cost, margin

    head = ("block", "layer", "σ", "decays at", "turns at", "settles", "of the cost", "delay alone")
    return [
        "  blocks: the slowest mode as sampled, when |e| settles to 2 % from the start, the share of ∫|e|² dt, and the delay "
        "that the block alone bears in continuous time",
        *table(head, [row(one) for one in found.blocks]),
    ]


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
