"""The text of `echelon analyse` about links: how much later their messages may come, and how many may be lost."""

from collections.abc import Container
from typing import TYPE_CHECKING

from echelon.cli.formatting import bound, counted, number, table

if TYPE_CHECKING:
    from echelon.sim.results.analysis import AnalysisResult
    from echelon.sim.results.links_analysis import BurstsResult, DelayResult, EstimateResult, LinksResult, LossResult


def links_lines(found: "AnalysisResult") -> list[str]:
    """Returns the tables of what links bear."""
    late = any(max(delays) > 0 for delays in found.delays.values())
    beyond = "beyond the scenario's delays" if late else "than now"
    lines = [
        f"  how much later messages may be {beyond}, or how many may be lost by chance, on all links of a row together"
    ]
    classes = [one for one in found.table if one.kind == "class"]
    by_runs = any(one.delay_by_runs for one in classes)
    rows = [
        (
            one.layer or "",
            one.channel or "",
            _delay(one.delay),
            _ticks(one.delay),
            *((_estimated(one.delay_by_runs, 1e3, "ms"),) if by_runs else ()),
            loss_text(one.loss) if one.loss_by_runs is None else f"~ {_estimated(one.loss_by_runs, 1e2, '%')}",
            _limit(one.delay),
        )
        for one in classes
    ]
    head = ("layer", "channel", "delay", "ticks", *(("by runs",) if by_runs else ()), "loss", "what limits it")
    lines += table(head, rows)
    if by_runs:
        lines.append(f"    delay and ticks: {found.calm}; by runs: with all links as they are, estimated")
    known = {(one.delay.seconds, one.links, one.layer, one.channel) for one in classes}
    others = [
        one
        for one in found.table
        if one.kind != "class" and (one.delay.seconds, one.links, one.layer, one.channel) not in known
    ]
    if others:
        further = [(_named(one), _delay(one.delay), _ticks(one.delay), _limit(one.delay)) for one in others]
        lines += ["", *table(("links", "delay", "ticks", "what limits it"), further)]
    reasons = dict.fromkeys(one.loss.why for one in classes if one.loss is not None and one.loss.why)
    counts = {each.runs for one in classes for each in (one.delay_by_runs, one.loss_by_runs) if each is not None}
    if counts:
        lines.append(
            f"    estimated by {max(counts)} runs for each value: the mean of |e|² shrinks up to it (95 % sure up to, "
            "95 % sure to grow from); where rare runs carry the mean, links bear less than these runs show"
        )
    lines += [f"  loss is not exact: {why}" for why in reasons]
    return [*lines, *(_bursts(one, one.bursts, reasons) for one in classes if one.bursts is not None)]


def _bursts(one: "LinksResult", found: "BurstsResult", reasons: Container[str]) -> str:
    """Returns the line about losses in bursts; `reasons` have been said."""
    why = "as above" if found.loss.why in reasons else found.loss.why
    head = f"  {_named(one)}: of messages that are lost in bursts of {found.length:g}"
    if not found.loss.why:
        return f"{head}, {loss_text(found.loss)} may be lost"
    if found.by_runs is None:
        return f"{head}: not computed: {why}"
    return f"{head}, ~ {_estimated(found.by_runs, 1e2, '%')} may be lost; not exact: {why}"


def scales_lines(found: "AnalysisResult") -> list[str]:
    """Returns the lines about ε and couplings."""
    lines = []
    if found.epsilon:
        head = ("ε", "now", "sampled from", "to", "exact", "of its layers", "bound", "by norms", "paper's formula")
        rows = []
        for at, one in enumerate(found.epsilon, 1):
            low, high = (number(each, "any") for each in (one.sampled_low, one.sampled_high))
            rest = [bound(each) for each in (one.exact, one.exact_of_layers, one.bound, one.bound_by_norms)]
            rows.append((f"ε{at}", f"{one.value:g}", low, high, *rest, number(one.paper_formula, "")))
        lines += [
            "",
            "  ε for which the formation is stable, the others as they are: with these periods and links; in continuous time, "
            "exact; by Lyapunov functions (the paper's formula proves nothing)",
            *table(head, rows),
        ]
    if found.coupling is not None:
        by, sampled = (number(value, "any") for value in (found.coupling.exact, found.coupling.sampled))
        lines.append(f"  all couplings may be multiplied by up to {by} (continuous time), {sampled} (as sampled)")
    return lines


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
            return counted(found.limits) + tried


def loss_text(found: "LossResult | None") -> str:
    """Returns a largest share of lost messages in words."""
    if found is None or found.why:
        return "?"
    if found.share is None:
        return "none"
    return f"{'over ' if found.ends == 'limit' else ''}{100 * found.share:.3g} %"


def _estimated(found: "EstimateResult | None", by: float, unit: str) -> str:
    """Returns a boundary by runs in words."""
    if found is None:
        return "?"
    value = "none" if found.value is None else f"{by * found.value:.3g} {unit}"
    low = "0" if found.low is None else f"{by * found.low:.3g}"
    if found.high is None:
        return f"{value} or more ({low}, ?)"
    return f"{value} ({low}, {by * found.high:.3g})"


def _named(one: "LinksResult") -> str:
    return f"{one.name} ({len(one.like)} alike)" if len(one.like) > 1 else one.name
