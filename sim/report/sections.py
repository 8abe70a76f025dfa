"""The contents of the report's sections, as HTML: each function makes what one section says of one run, or of all runs."""

from collections.abc import Sequence
from typing import Final

from echelon.sim.report.axes import (
    CALM_DISTANCE,
    CALM_TORQUE,
    SMALL_MULTIPLES,
    TorqueScale,
    distance_time,
    torque_time,
)
from echelon.sim.report.can_report import can_section
from echelon.sim.report.page import figure, fold, paragraph, preformatted, rest, table, tiles
from echelon.sim.report.run_for_report import FIGURES, RunForReport, ShownRun
from echelon.sim.report.time_axis import TimeAxis
from echelon.sim.report.torque_steps import steps_text
from echelon.sim.results.measure_records import DistanceResult
from echelon.sim.results.summary import number
from echelon.sim.results.verdict import count

PAPER: Final = "paper"
"""The name of the scenario whose figures the paper has"""
MAX_ROWS: Final = 60
"""Rows of a table on the page; the summary has all rows"""


def tiles_of(one: ShownRun) -> str:
    """Returns the few numbers that people look for first."""
    summary = one.run.summary
    peak = max((row.peak for row in summary.torque if row.peak is not None), default=None)
    values = [(f"{claim.block} settled", number(claim.measured, "s", "not")) for claim in summary.claims]
    values.append(("smallest distance", number(summary.distance.smallest, "m")))
    values.append(("largest torque", _engineering(peak, "N m")))
    values.append(("of real time", number(summary.run.real_time_factor, "×")))
    return tiles(values)


def claims(runs: Sequence[RunForReport]) -> str:
    """Returns the table of claims: those of the first run, with the outcome in every run that makes the same claim."""
    rows: list[list[object]] = []
    for at, claim in enumerate(runs[0].summary.claims):
        row: list[object] = [f"{claim.block} within {100 * claim.band:g} %", number(claim.settled_by, "s")]
        for run in runs:
            others = run.summary.claims
            same = at < len(others) and others[at].block == claim.block
            row += [number(others[at].measured, "s"), others[at].outcome] if same else [None, None]
        rows.append(row)
    if not rows:
        return paragraph("The scenario makes no claims.")
    columns = [name for run in runs for name in ((f"measured, {run.name}" if len(runs) > 1 else "measured"), "")]
    return table(["claim", "claimed by", *columns], rows)


def separation(one: ShownRun) -> str:
    """Returns the table that compares neighbouring time scales; empty if there is only one."""
    head = ["slower over faster", "σ ratio", "decay rates", "r²", "settling, 5 %", "2 %"]
    rows: list[list[object]] = [
        [
            *(f"{row.slower} over {row.faster}", row.sigma_ratio, row.rate_ratio, row.rate_fit),
            *(row.settling_5_ratio, row.settling_2_ratio),
        ]
        for row in one.run.summary.separation
    ]
    return table(head, rows) if rows else ""


def paths(one: ShownRun) -> str:
    """Returns the map of paths (the paper's Figs. 2 and 3)."""
    plan, distance = one.run.trace.plan, one.run.summary.distance
    in_paper, how = ("Fig. 3", "with") if plan.avoidance.enabled else ("Fig. 2", "without")
    what = f"Paths of the {len(plan.robots)} robots {how} avoidance"
    where = f" (the paper's {in_paper})" if _is_paper(one) else ""
    return figure(
        FIGURES["trajectories"](one),
        f"{what}; smallest distance {number(distance.smallest, 'm')}.",
        f"{what}{where}. Open triangles: start; filled: end, pointing in heading direction; tinted: each group's final shape. "
        "Dashed grey: desired centroid; black: its real path.",
    )


def _is_paper(one: ShownRun) -> bool:
    """Returns whether a run is of the scenario whose figures the paper has."""
    return one.run.summary.scenario == PAPER


def transformed(one: ShownRun) -> str:
    """Returns the figure of shape variables and centroid over time (the paper's Fig. 4)."""
    where = "The paper's Fig. 4. " if _is_paper(one) else ""
    return figure(
        FIGURES["blocks"](one),
        "Every shape variable and the centroid over time, on a linear and a logarithmic axis, with the desired values.",
        f"{where}Time linear (left) and logarithmic (right). Solid: x; dashed: y; grey bands: desired. Colours and marks: "
        "groups; purple: inter-group; black: centroid.",
    )


def error_norms(one: ShownRun) -> str:
    """Returns the figure of error norms, with settling times and claims."""
    settled = ", ".join(f"{row.name} {number(row.settling_5, 's', 'not')}" for row in one.run.summary.blocks)
    time = TimeAxis.of(one.run.trace.plan, one.blocks.times_ns)
    return figure(
        FIGURES["errors"](one),
        f"Error norm of every block over time. Settled to 5 %: {settled}.",
        "Error norm of every block. Filled mark: settled to 5 % of the error that the block starts with; open mark: to 2 %. "
        f"Dashed, with words above: claims. {time.words}",
    )


def block_table(one: ShownRun) -> str:
    """Returns the table of all blocks."""
    head = [
        "block",
        "σ [s]",
        "5 %",
        "2 %",
        "decay [1/s]",
        "start",
        "peak",
        "residual",
        "ISE",
        "IAE",
        "ITAE",
        "at the end",
    ]
    keys = (
        "name",
        "sigma",
        "settling_5",
        "settling_2",
        "decay_rate",
        "start_error",
        "peak_error",
        "residual",
        "ise",
        "iae",
    )
    rows = one.run.summary.blocks
    return table(head, [[*(getattr(row, key) for key in keys), row.itae, row.remark] for row in rows])


def distances(one: ShownRun) -> str:
    """Returns the figure of the smallest distance, and the table of violations."""
    distance = one.run.summary.distance
    violations = distance.violations
    time = distance_time(one.near, one.run.trace.plan)
    drawn = figure(
        FIGURES["distance"](one),
        f"Smallest distance between robots over time; the smallest is {number(distance.smallest, 'm')}.",
        "Smallest distance of all pairs; between recorded instants robots are taken to move straight. Circle: the closest "
        f"encounter. Tinted: closer than the avoidance radius rₐ. Rₛ: sensing radius. {time.words_then(CALM_DISTANCE)}"
        + ("" if distance.avoidance_enabled else f" Avoidance is not enabled: {_without_avoidance(distance)}."),
    )
    if not violations:
        return drawn + paragraph("No pair came within the avoidance radius.")
    shown = sorted(violations, key=lambda row: row.smallest)[:MAX_ROWS]
    rows = [[" – ".join(row.pair), f"{row.first:.6f}", f"{row.last:.6f}", row.smallest] for row in shown]
    head = ["violation", "from [s]", "to [s]", "smallest [m]"]
    return drawn + table(head, rows, what="violations") + rest(len(violations), MAX_ROWS)


def _without_avoidance(distance: DistanceResult) -> str:
    """Returns in words how robots that did not avoid each other kept their distance."""
    pairs = len({violation.pair for violation in distance.violations})
    if not pairs:
        return "robots keep this distance by chance"
    return f"{count(pairs, 'pair')} came closer than {distance.avoidance_radius:g} m"


def torques(one: ShownRun) -> str:
    """Returns the figure and the table of wheel torques."""
    robots = len(one.run.trace.plan.robots)
    which = f"; the {SMALL_MULTIPLES} robots with the largest" if robots > SMALL_MULTIPLES else ""
    rows = []
    for row in one.run.summary.torque[:MAX_ROWS]:
        values = [_engineering(row.rms), _engineering(row.peak), number(row.peak_time)]
        saturated = "–" if row.saturation_share is None else f"{100 * row.saturation_share:.3g}"
        rows.append([row.robot, *values, saturated, row.saturated_after_first_second])
    trace = one.run.trace
    drawn = figure(
        FIGURES["torques"](one),
        "Wheel torques of every robot over time.",
        f"Wheel torques, mean of each period{which}. In the group's colour: right wheel; grey: left. Dashed, where it is in "
        f"the picture: the torque limit. {torque_time(trace).words_then(CALM_TORQUE)} {TorqueScale.of([trace]).words}".rstrip(),
    )
    steps = steps_text(trace)
    head = ["robot", "RMS [N\u00a0m]", "peak [N\u00a0m]", "at [s]", "saturated [%]", "after 1\u00a0s"]
    return drawn + (paragraph(steps) if steps else "") + table(head, rows, what="robots") + rest(robots, MAX_ROWS)


def can(one: ShownRun) -> str:
    """Returns what is said of the CAN buses."""
    return can_section(one.run.summary.can, one.run.frames)


def link_table(one: ShownRun) -> str:
    """Returns the table of links."""
    links = one.run.summary.links
    counted = ["sent", "lost", "in flight", "twice", "held"]
    head = ["link", "channel", *counted, "mean age [s]", "p50", "p95", "p99", "largest"]
    rows = [
        [
            f"{row.source} → {row.receiver}",
            row.channel.replace("_", " "),
            *(row.sent, row.lost, row.in_flight, row.duplicates, row.held),
            *map(number, (row.age_mean, row.age_p50, row.age_p95, row.age_p99, row.age_max)),
        ]
        for row in links[:MAX_ROWS]
    ]
    if not rows:
        return paragraph("No links were counted.")
    return table(head, rows, numeric_from=2, what="links") + rest(len(links), MAX_ROWS)


def scenario(one: ShownRun) -> str:
    """Returns the effective scenario, folded."""
    lines = one.run.scenario.count("\n")
    return fold(f"scenario.toml, {lines} lines", preformatted(one.run.scenario))


def _engineering(value: float | None, unit: str = "") -> str:
    if value is not None and abs(value) >= 1e4:
        return f"{value / 1e3:.3g} k{unit}" if abs(value) < 1e6 else f"{value / 1e6:.3g} M{unit}"
    return number(value, unit)
