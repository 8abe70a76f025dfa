"""The report: one HTML file about one run or several; no scripts, nothing from the network, printable."""

import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from echelon.files import write_text
from echelon.sim.report.can_report import can_section
from echelon.sim.report.comparison import WIDTH, Compared, comparison
from echelon.sim.report.differences import differences
from echelon.sim.report.drawing import Picture, TimeAxis
from echelon.sim.report.figures import (
    CALM_DISTANCE,
    CALM_TORQUE,
    SMALL_MULTIPLES,
    TorqueScale,
    distance_time,
    errors,
    smallest_distance,
    torque_time,
    trajectories,
    transformed_state,
    wheel_torques,
)
from echelon.sim.report.page import (
    figure,
    fold,
    header,
    page,
    paragraph,
    preformatted,
    rest,
    section,
    side_by_side,
    subheading,
    table,
    tiles,
    verdict,
)
from echelon.sim.report.torque_steps import steps_text
from echelon.sim.results.block_series import Blocks, block_series
from echelon.sim.results.distances import Distances, distances
from echelon.sim.results.records import DistanceResult, Summary
from echelon.sim.results.summary import number
from echelon.sim.results.trace import Trace
from echelon.sim.results.verdict import count

PAPER: Final = "paper"
"""The name of the scenario whose figures the paper has"""
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
    shown = _shown(runs, WIDTH if len(runs) == 1 else WIDTH / 2 - 0.15)
    title = " · ".join(dict.fromkeys(run.summary.scenario for run in runs))
    write_text(path, page(f"{title}: {', '.join(run.name for run in runs)}", _parts(title, shown)))


def save_figures(runs: Sequence[RunForReport], folder: Path, formats: Sequence[str]) -> list[Path]:
    """Writes each figure of a report as a file of its own, `<figure>.<format>`, into a folder, which is made if need be; of
    several runs as `<run>-<figure>.<format>`, and `compared-<figure>.<format>`.  Returns the files.

    Raises ValueError without a run, or for another format than drawing.FORMATS; OSError."""
    shown = _shown(runs, WIDTH)
    pictures: dict[str, Picture] = {}
    if len(shown) > 1:
        pictures |= {f"compared-{name}": picture for name, (picture, _) in comparison(_compared(shown)).items()}
    for one in shown:
        prefix = one.run.name.replace("/", "-") + "-" if one.several else ""
        pictures |= {f"{prefix}{name}": make(one) for name, make in FIGURES.items()}
    folder.mkdir(parents=True, exist_ok=True)
    files = [(folder / f"{name}.{kind}", picture) for name, picture in pictures.items() for kind in formats]
    for path, picture in files:
        picture.save(path)
    return [path for path, _ in files]


def _shown(runs: Sequence[RunForReport], width: float) -> list[_Shown]:
    if not runs:
        raise ValueError("a report needs at least one run")
    return [_Shown(run, block_series(run.trace), distances(run.trace), width, len(runs) > 1) for run in runs]


def _compared(shown: Sequence[_Shown]) -> list[Compared]:
    return [Compared(one.run.name, one.run.trace, one.blocks, one.near) for one in shown]


FIGURES: Final[Mapping[str, Callable[[_Shown], Picture]]] = {
    "trajectories": lambda one: trajectories(one.run.trace, one.width),
    "blocks": lambda one: transformed_state(one.blocks, one.run.trace.plan, one.width),
    "errors": lambda one: errors(one.blocks, one.run.trace.plan, one.width),
    "distance": lambda one: smallest_distance(one.near, one.run.trace.plan, one.width),
    "torques": lambda one: wheel_torques(one.run.trace, one.width),
}


def _parts(title: str, shown: Sequence[_Shown]) -> list[str]:
    runs = [one.run for one in shown]
    settled = (
        "Settled: from then on to the end, and for its dwell time at least, the error stays within the band, a share of the "
        "error that the block starts with."
    )
    integrals = "Settling in seconds, errors in metres; the integrals are of the error's norm over the run."

    def each(cell: Callable[[_Shown], str]) -> list[str]:
        return [_named(one) + cell(one) for one in shown]

    descriptions = list(dict.fromkeys(_description(run.scenario) for run in runs))
    return [
        header(title, descriptions[0] if len(descriptions) == 1 else "", _facts(runs)),
        *(verdict(run.name, run.summary) for run in runs),
        *(_comparison(shown) if len(shown) > 1 else ()),
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
        section("Effective scenario", "Every default written out.", each(_scenario)),
    ]


def _comparison(shown: Sequence[_Shown]) -> list[str]:
    """Returns what differs between runs, and their curves in the same figures."""
    names = [one.run.name for one in shown]
    rows = differences([one.run.scenario for one in shown], [one.run.summary for one in shown])
    words = "Keys of the effective scenarios, as --set takes them, and how the runs were made."
    differing = table(["key", *names], rows, numeric_from=len(names) + 1, what="keys")
    figures = "".join(
        figure(picture, f"{caption} Compared: {', '.join(names)}.", caption)
        for picture, caption in comparison(_compared(shown)).values()
    )
    return [
        section("What differs", words, [differing if rows else paragraph("Nothing: the same scenario, run alike.")]),
        section("Compared", "The same curves of all runs in one figure; each run by itself is below.", [figures]),
    ]


def _description(scenario: str) -> str:
    try:
        return str(tomllib.loads(scenario).get("description", ""))
    except tomllib.TOMLDecodeError:
        return ""


def _facts(runs: Sequence[RunForReport]) -> list[str]:
    def all_of(values: Sequence[str]) -> str:
        return values[0] if len(set(values)) == 1 else ", ".join(values)

    plans = [run.trace.plan for run in runs]
    return [
        f"{all_of([str(len(plan.robots)) for plan in plans])} robots",
        f"{all_of([str(len(plan.nodes)) for plan in plans])} nodes",
        all_of([number(plan.duration_ns / 1e9, "s") for plan in plans]),
        *(f"trace {run.summary.trace_digest[:12]}" for run in runs),
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
    in_paper, how = ("Fig. 3", "with") if plan.avoidance.enabled else ("Fig. 2", "without")
    what = f"Paths of the {len(plan.robots)} robots {how} avoidance"
    where = f" (the paper's {in_paper})" if _is_paper(one) else ""
    return figure(
        FIGURES["trajectories"](one),
        f"{what}; smallest distance {number(distance.smallest, 'm')}.",
        f"{what}{where}. Open triangles: start; filled: end, pointing in heading direction; tinted: each group's final shape. "
        "Dashed grey: desired centroid; black: its real path.",
    )


def _is_paper(one: _Shown) -> bool:
    """Returns whether a run shows what the paper shows."""
    return one.run.summary.scenario == PAPER


def _transformed(one: _Shown) -> str:
    where = "The paper's Fig. 4. " if _is_paper(one) else ""
    return figure(
        FIGURES["blocks"](one),
        "Every shape variable and the centroid over time, on a linear and a logarithmic axis, with what is desired.",
        f"{where}Time linear (left) and logarithmic (right). Solid: x; dashed: y; grey bands: desired. Colours and marks: "
        "groups; purple: inter-group; black: centroid.",
    )


def _errors(one: _Shown) -> str:
    settled = ", ".join(f"{row.name} {number(row.settling_5, 's', 'not')}" for row in one.run.summary.blocks)
    time = TimeAxis.of(one.run.trace.plan, one.blocks.times_ns)
    return figure(
        FIGURES["errors"](one),
        f"Error norm of every block over time. Settled to 5 %: {settled}.",
        "Error norm of every block. Filled mark: settled to 5 % of what it starts with; open mark: to 2 %. Dashed, with words "
        f"above: claims. {time.words}",
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
    """Says how close robots came, of which nothing kept them apart."""
    pairs = len({violation.pair for violation in distance.violations})
    if not pairs:
        return "robots keep out of it by chance"
    return f"{count(pairs, 'pair')} came closer than {distance.avoidance_radius:g} m"


def _torques(one: _Shown) -> str:
    count = len(one.run.trace.plan.robots)
    which = f"; the {SMALL_MULTIPLES} robots with the largest" if count > SMALL_MULTIPLES else ""
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
    return drawn + (paragraph(steps) if steps else "") + table(head, rows, what="robots") + rest(count, MAX_ROWS)


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
    if not rows:
        return paragraph("No links were counted.")
    return table(head, rows, numeric_from=2, what="links") + rest(len(links), MAX_ROWS)


def _scenario(one: _Shown) -> str:
    lines = one.run.scenario.count("\n")
    return fold(f"scenario.toml, {lines} lines", preformatted(one.run.scenario))


def _engineering(value: float | None, unit: str = "") -> str:
    if value is not None and abs(value) >= 1e4:
        return f"{value / 1e3:.3g} k{unit}" if abs(value) < 1e6 else f"{value / 1e6:.3g} M{unit}"
    return number(value, unit)
