"""The report: one HTML file about one run or several side by side; no scripts, nothing from the network, printable."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from echelon.sim.report.can_report import can_section
from echelon.sim.report.figures import (
    SMALL_MULTIPLES,
    errors,
    smallest_distance,
    trajectories,
    transformed_state,
    wheel_torques,
)
from echelon.sim.report.page import (
    figure,
    header,
    page,
    paragraph,
    preformatted,
    section,
    side_by_side,
    subheading,
    table,
    tiles,
    verdict,
)
from echelon.sim.results.block_series import Blocks, block_series
from echelon.sim.results.distances import Distances, distances
from echelon.sim.results.records import Summary
from echelon.sim.results.summary import number
from echelon.sim.results.trace import Trace

MAX_ROWS: Final = 60
"""Rows of a table on the page; the summary has them all."""


@dataclass(frozen=True, slots=True)
class RunForReport:
    """A run as the report takes it: its name, what was recorded, its summary, the effective
    scenario as TOML, and the first frames on the bus, decoded: one mapping per frame, all with the same keys."""

    name: str
    trace: Trace
    summary: Summary
    scenario: str
    frames: tuple[Mapping[str, object], ...] = ()


@dataclass(frozen=True, slots=True)
class _Shown:
    """A run with what is computed once for its figures; `width` of a figure [inches]."""

    run: RunForReport
    blocks: Blocks
    near: Distances
    width: float
    several: bool

    @property
    def who(self) -> str:
        """How a caption tells this run from others."""
        return f"{self.run.name}: " if self.several else ""


def write_report(runs: Sequence[RunForReport], path: Path) -> None:
    """Writes the report of one run, or a comparison.  Raises ValueError without a run; OSError."""
    if not runs:
        raise ValueError("a report needs at least one run")
    width = 5.6 if len(runs) > 1 else 11.5
    shown = [_Shown(run, block_series(run.trace), distances(run.trace), width, len(runs) > 1) for run in runs]
    title = " · ".join(dict.fromkeys(run.summary.scenario for run in runs))
    path.write_text(page(f"{title}: {', '.join(run.name for run in runs)}", _parts(title, shown)), encoding="utf-8")


def _parts(title: str, shown: Sequence[_Shown]) -> list[str]:
    runs = [one.run for one in shown]
    settled = (
        "Settled: from then on to the end, and for its dwell time at least, the error stays within the band, a share of the "
        "error that the block starts with."
    )
    integrals = "Settling in seconds, errors in metres; the integrals are of the error's norm over the run."

    def each(cell: Callable[[_Shown], str]) -> list[str]:
        return [_named(one) + cell(one) for one in shown]

    return [
        header(title, _description(runs[0].scenario), _facts(runs)),
        *(verdict(run.name, run.summary) for run in runs),
        side_by_side(each(_tiles)),
        section("Claimed and measured", settled, [_claims(runs) + side_by_side(each(_separation))]),
        section("Trajectories", "", each(_trajectories)),
        section("Shape variables and centroid over time", "", each(_transformed)),
        section("Errors", "", each(_errors)),
        section("Blocks", integrals, each(_blocks)),
        section("Distances between robots", "", each(_distances)),
        section("Wheel torques", "", each(_torques)),
        section("CAN bus", "", each(_can)),
        section("Links", "Ages [s] are of the message in use, at each use.", each(_links)),
        section("Effective scenario", "Every default written out.", each(lambda one: preformatted(one.run.scenario))),
    ]


def _description(scenario: str) -> str:
    try:
        return str(tomllib.loads(scenario).get("description", ""))
    except tomllib.TOMLDecodeError:
        return ""


def _facts(runs: Sequence[RunForReport]) -> list[str]:
    plan = runs[0].trace.plan
    digests = [f"trace {run.summary.trace_digest[:12]}" for run in runs]
    return [
        f"{len(plan.robots)} robots",
        f"{len(plan.nodes)} nodes",
        f"{number(plan.duration_ns / 1e9, 's')}",
        *digests,
    ]


def _named(one: _Shown) -> str:
    return subheading(one.run.name) if one.several else ""


def _tiles(one: _Shown) -> str:
    summary = one.run.summary
    peak = max((row.peak for row in summary.torque if row.peak is not None), default=None)
    values = [(f"{claim.block} settled", number(claim.measured, "s", "not")) for claim in summary.claims]
    values.append(("smallest distance", number(summary.distance.smallest, "m")))
    values.append(("largest torque", _engineering(peak, "N m")))
    values.append(("of real time", number(summary.run.real_time_factor, "×")))
    return tiles(values)


def _claims(runs: Sequence[RunForReport]) -> str:
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


def _separation(one: _Shown) -> str:
    head = ["slower over faster", "σ ratio", "decay rates", "r²", "settling, 5 %", "2 %"]
    rows: list[list[object]] = [
        [
            *(f"{row.slower} over {row.faster}", row.sigma_ratio, row.rate_ratio, row.rate_fit),
            *(row.settling_5_ratio, row.settling_2_ratio),
        ]
        for row in one.run.summary.separation
    ]
    return table(head, rows) if rows else ""


def _trajectories(one: _Shown) -> str:
    plan, distance = one.run.trace.plan, one.run.summary.distance
    number_of_figure, how = ("3", "with") if plan.avoidance.enabled else ("2", "without")
    what = f"Paths of the {len(plan.robots)} robots {how} avoidance"
    return figure(
        trajectories(one.run.trace, one.width),
        f"{what}; smallest distance {number(distance.smallest, 'm')}.",
        f"{what} (the paper's Fig. {number_of_figure}). Open triangles: start; filled: end, pointing in heading "
        "direction; tinted: each group's final shape. Dashed: desired centroid; black: its real path.",
    )


def _transformed(one: _Shown) -> str:
    return figure(
        transformed_state(one.blocks, one.run.trace.plan, one.width),
        "Every shape variable and the centroid over time, on a linear and a logarithmic axis, with what is desired.",
        "The paper's Fig. 4, time linear (left) and logarithmic (right). Solid: x; dashed: y; grey bands: desired. "
        "Colours: groups; purple: inter-group; black: centroid.",
    )


def _errors(one: _Shown) -> str:
    settled = ", ".join(f"{row.name} {number(row.settling_5, 's', 'not')}" for row in one.run.summary.blocks)
    return figure(
        errors(one.blocks, one.run.trace.plan, one.width),
        f"Error norm of every block over time, both axes logarithmic. Settled to 5 %: {settled}.",
        "Error norm of every block. Filled dot: settled to 5 % of what it starts with; open dot: to 2 %. Dashed: claims.",
    )


def _blocks(one: _Shown) -> str:
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
        "in the end",
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


def _distances(one: _Shown) -> str:
    distance = one.run.summary.distance
    violations = distance.violations
    drawn = figure(
        smallest_distance(one.near, one.run.trace.plan, one.width),
        f"Smallest distance between robots over time; the smallest is {number(distance.smallest, 'm')}.",
        "Smallest distance of all pairs; between recorded instants robots are taken to move straight. Circle: the "
        "closest encounter. Tinted: closer than the avoidance radius rₐ. Rₛ: sensing radius."
        + ("" if distance.avoidance_enabled else " Avoidance is not enabled: robots keep out of it by chance."),
    )
    if not violations:
        return drawn + paragraph("No pair came within the avoidance radius.")
    shown = sorted(violations, key=lambda row: row.smallest)[:MAX_ROWS]
    rows = [[" – ".join(row.pair), f"{row.first:.6f}", f"{row.last:.6f}", row.smallest] for row in shown]
    return drawn + table(["violation", "from [s]", "to [s]", "smallest [m]"], rows) + _rest(len(violations))


def _torques(one: _Shown) -> str:
    count = len(one.run.trace.plan.robots)
    which = f"; the {SMALL_MULTIPLES} robots with the largest" if count > SMALL_MULTIPLES else ""
    rows = []
    for row in one.run.summary.torque[:MAX_ROWS]:
        values = [_engineering(row.rms), _engineering(row.peak), number(row.peak_time)]
        saturated = "–" if row.saturation_share is None else f"{100 * row.saturation_share:.3g}"
        rows.append([row.robot, *values, saturated, row.saturated_after_first_second])
    drawn = figure(
        wheel_torques(one.run.trace, one.width),
        "Wheel torques of every robot over time.",
        f"Wheel torques, mean of each period{which}. In the group's colour: right wheel; grey: left. Time is "
        "logarithmic, torque too beyond the innermost marks. Dashed, where there is one: the torque limit.",
    )
    head = ["robot", "RMS [N\u00a0m]", "peak [N\u00a0m]", "at [s]", "saturated [%]", "after 1\u00a0s"]
    return drawn + table(head, rows) + _rest(count)


def _can(one: _Shown) -> str:
    return can_section(one.run.summary.can, one.run.frames)


def _links(one: _Shown) -> str:
    links = one.run.summary.links
    head = ["link", "channel", "sent", "lost", "in flight", "held", "mean age", "largest"]
    rows = [
        [
            f"{row.source} → {row.receiver}",
            row.channel.replace("_", " "),
            *(row.sent, row.lost, row.in_flight, row.held),
            *(f"{row.age_mean:.4g}", f"{row.age_max:.4g}"),
        ]
        for row in links[:MAX_ROWS]
    ]
    return table(head, rows, numeric_from=2) + _rest(len(links)) if rows else paragraph("No links were counted.")


def _rest(count: int) -> str:
    return paragraph(f"{count - MAX_ROWS} more are in the summary.") if count > MAX_ROWS else ""


def _engineering(value: float | None, unit: str = "") -> str:
    if value is not None and abs(value) >= 1e4:
        return f"{value / 1e3:.3g} k{unit}" if abs(value) < 1e6 else f"{value / 1e6:.3g} M{unit}"
    return number(value, unit)
