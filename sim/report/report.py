"""The report about one run or several: one HTML file, without scripts, that needs no network and can be printed."""

from collections.abc import Callable, Sequence
from pathlib import Path

from echelon.files import write_text
from echelon.planning.loading import ScenarioError, read_table
from echelon.sim.report import sections
from echelon.sim.report.against import measured
from echelon.sim.report.comparison import WIDTH, Compared, comparison
from echelon.sim.report.differences import differences
from echelon.sim.report.drawing import Picture
from echelon.sim.report.page import figure, header, page, paragraph, section, side_by_side, subheading, table, verdict
from echelon.sim.report.run_for_report import FIGURES, RunForReport, ShownRun
from echelon.sim.results.block_series import block_series
from echelon.sim.results.distances import distances
from echelon.sim.results.summary import number


def write_report(runs: Sequence[RunForReport], path: Path) -> None:
    """Writes the report of one run, or the comparison of several.  Raises ValueError without a run, and OSError."""
    shown = _shown(runs, WIDTH if len(runs) == 1 else WIDTH / 2 - 0.15)
    title = " · ".join(dict.fromkeys(run.summary.scenario for run in runs))
    write_text(path, page(f"{title}: {', '.join(run.name for run in runs)}", _parts(title, shown)), durable=True)


def save_figures(runs: Sequence[RunForReport], folder: Path, formats: Sequence[str]) -> list[Path]:
    """Writes each figure of a report into a file of its own; returns the files.  The folder is made if it does not exist.

    A file is called `<figure>.<format>`; with several runs `<run>-<figure>.<format>` and `compared-<figure>.<format>`.
    Raises ValueError without a run or for a format that is not in drawing.FORMATS, and OSError."""
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


def _shown(runs: Sequence[RunForReport], width: float) -> list[ShownRun]:
    if not runs:
        raise ValueError("a report needs at least one run")
    return [ShownRun(run, block_series(run.trace), distances(run.trace), width, len(runs) > 1) for run in runs]


def _compared(shown: Sequence[ShownRun]) -> list[Compared]:
    return [Compared(one.run.name, one.run.trace, one.blocks, one.near) for one in shown]


def _parts(title: str, shown: Sequence[ShownRun]) -> list[str]:
    """Returns the parts of the page, from its head to the scenario."""
    runs = [one.run for one in shown]
    settled = (
        "Settled: from this time to the end of the run, and for the dwell time of the block at least, its error stays within "
        "the band, a share of the error that the block starts with."
    )
    integrals = "Settling in seconds, errors in metres; the integrals are of the error's norm over the run."

    def each(cell: Callable[[ShownRun], str]) -> list[str]:
        return [_named(one) + cell(one) for one in shown]

    descriptions = list(dict.fromkeys(_description(run.scenario) for run in runs))
    return [
        header(title, descriptions[0] if len(descriptions) == 1 else "", _facts(runs)),
        *(verdict(run.name, run.summary) for run in runs),
        *(_comparison(shown) if len(shown) > 1 else ()),
        side_by_side(each(sections.tiles_of)),
        section("Claimed and measured", settled, [sections.claims(runs) + side_by_side(each(sections.separation))]),
        section("Trajectories", "", each(sections.paths)),
        section("Shape variables and centroid over time", "", each(sections.transformed)),
        section("Errors", "", each(sections.error_norms)),
        section("Blocks", integrals, each(sections.block_table)),
        section("Distances between robots", "", each(sections.distances)),
        section("Wheel torques", "", each(sections.torques)),
        section("CAN bus", "", each(sections.can)),
        section("Links", "Ages [s] are those of messages when they are used.", each(sections.link_table)),
        section("Effective scenario", "Every default written out.", each(sections.scenario)),
    ]


def _comparison(shown: Sequence[ShownRun]) -> list[str]:
    """Returns the sections of a comparison: what differs between the runs, and the figures with the curves of all runs."""
    names = [one.run.name for one in shown]
    summaries = [one.run.summary for one in shown]
    rows = differences([one.run.scenario for one in shown], summaries)
    words = "Keys of the effective scenarios, as --set takes them, and how the runs were made."
    differing = table(["key", *names], rows, numeric_from=len(names) + 1, what="keys")
    found = table(["", *names], measured(summaries), what="measures")
    figures = "".join(
        figure(picture, f"{caption} Compared: {', '.join(names)}.", caption)
        for picture, caption in comparison(_compared(shown)).values()
    )
    return [
        section(
            "What differs",
            words,
            [differing if rows else paragraph("Nothing: the same scenario, run in the same way.")],
        ),
        section("What was measured", "The same runs, side by side; details are below.", [found]),
        section("Compared", "The same curves of all runs in one figure; each run by itself is below.", [figures]),
    ]


def _description(scenario: str) -> str:
    """Returns the description in a scenario (TOML); empty if there is none."""
    try:
        return str(read_table(scenario, "").get("description", ""))
    except ScenarioError:
        return ""


def _facts(runs: Sequence[RunForReport]) -> list[str]:
    """Returns the facts in the page's head: numbers of robots and nodes, durations, digests."""

    def all_of(values: Sequence[str]) -> str:
        return values[0] if len(set(values)) == 1 else ", ".join(values)

    plans = [run.trace.plan for run in runs]
    return [
        f"{all_of([str(len(plan.robots)) for plan in plans])} robots",
        f"{all_of([str(len(plan.nodes)) for plan in plans])} nodes",
        all_of([number(plan.duration_ns / 1e9, "s") for plan in plans]),
        *(f"trace {run.summary.trace_digest[:12]}" for run in runs),
    ]


def _named(one: ShownRun) -> str:
    """Returns the run's name as a heading if the report is about several runs; otherwise nothing."""
    return subheading(one.run.name) if one.several else ""
