"""The columns of a sweep's tables: names, units and meanings, in one place.

A name with `.B` stands for a column for each block of the plan, one with `.C` for each channel of its links.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final


@dataclass(frozen=True, slots=True)
class Column:
    """A column, or one for each block or channel."""

    name: str
    unit: str
    about: str
    text: bool = False
    whole: bool = False
    """True: its values are integers; an integer is never missing"""


RUN_HEAD: Final = (
    Column("point", "", "number of the point, from 0 on", whole=True),
    Column("seed", "", "seed of the run; the same seeds at each point", whole=True),
)
RUN_FACTS: Final = (
    Column("scenario", "", "hash of the point's scenario without its seed, with the files that it names", text=True),
    Column("version", "", "version of echelon", text=True),
    Column("engine", "", "engine that made the run", text=True),
)
RUN_MEASURES: Final = (
    Column("verdict", "", "HOLDS, HEALTHY or FAILS, as for a single run (scenario.md, `health`)", text=True),
    Column("holds", "", "1 if the verdict is not FAILS, otherwise 0", whole=True),
    Column("reason", "", "names of the checks that failed, and of the blocks; empty if none did", text=True),
    Column(
        "lost_at", "s", "first instant with a state that is not finite or beyond all bounds; empty if there is none"
    ),
    Column("smallest_distance", "m", "smallest distance of two robots"),
    Column("violations", "", "number of violations of the avoidance radius", whole=True),
    Column("saturation", "", "largest share of the time in which limits of a robot acted"),
    Column("peak_torque", "N m", "largest torque of a wheel; empty if a state is not finite"),
)
BLOCK_MEASURES: Final = (
    Column("start_error.B", "m", "error that the block starts with"),
    Column("settling_5.B", "s", "settling time to 5 % of it; empty if it did not settle"),
    Column("settling_2.B", "s", "settling time to 2 %"),
    Column("residual.B", "m", "error at the end"),
    Column("peak_error.B", "m", "largest error"),
    Column("peak_time.B", "s", "when it was largest"),
    Column("ise.B", "m² s", "∫|e|² dt"),
    Column("iae.B", "m s", "∫|e| dt"),
    Column("itae.B", "m s²", "∫ t |e| dt"),
    Column("amplitude_before.B", "m", "root mean square of the amplitude in the sixth of the run before the last"),
    Column("amplitude_last.B", "m", "the same in the last sixth"),
    Column("growth.B", "", "amplitude_last over amplitude_before"),
    Column("decay_rate.B", "1/s", "fitted decay rate; empty with the batch engine"),
)
LINK_MEASURES: Final = (
    Column("loss.C", "", "lost messages over sent ones, of all links of the channel"),
    Column("age_mean.C", "s", "mean age of messages in use, of the link on which it is largest"),
    Column("age_p50.C", "s", "age that half of the uses do not exceed, likewise; empty where it is not counted"),
    Column("age_p95.C", "s", "age that 95 % of the uses do not exceed, likewise"),
    Column("age_max.C", "s", "largest age, likewise"),
)
POINT_HEAD: Final = (Column("point", "", "number of the point, from 0 on", whole=True),)
POINT_FACTS: Final = (
    Column("scenario", "", "hash of the point's scenario, as in runs", text=True),
    Column("runs", "", "number of runs", whole=True),
    Column("holds", "", "number of runs that hold", whole=True),
    Column("share", "", "share of runs that hold"),
    Column("share_low", "", "lower end of its Wilson interval, 95 %"),
    Column("share_high", "", "upper end"),
    Column("lost", "", "number of runs that ended with a state that is not finite", whole=True),
)
MEANS: Final = (
    Column("ise_mean.B", "m² s", "mean of ise over the runs; empty if a run has none"),
    Column("itae_mean.B", "m s²", "mean of itae"),
    Column(
        "moment_growth.B", "", "growth of E|e|² over a sixth of the run: Σ amplitude_last² over Σ amplitude_before²"
    ),
    Column("moment_growth_low.B", "", "lower end of its interval, 95 %, approximate"),
    Column("moment_growth_high.B", "", "upper end"),
    Column("heaviest.B", "", "share of Σ amplitude_last² that comes from one run; near 1, rare runs decide the mean"),
)
NOT_MEDIAN: Final = ("verdict", "holds", "reason", "lost_at", "violations")
"""Measures of runs of which points have no median"""


def named(columns: Sequence[Column], names: Sequence[str]) -> list[Column]:
    """Returns columns for each of these blocks or channels, one block or channel after the other."""
    return [
        Column(f"{column.name[:-2]}.{name}", column.unit, column.about, column.text, column.whole)
        for name in names
        for column in columns
    ]


def run_columns(keys: Sequence[str], blocks: Sequence[str], channels: Sequence[str]) -> list[Column]:
    """Returns the columns of the table of runs; `keys` are those that vary, without the columns of their values."""
    return [*RUN_HEAD, *_varied(keys), *RUN_FACTS, *measures(blocks, channels)]


def point_columns(keys: Sequence[str], blocks: Sequence[str], channels: Sequence[str]) -> list[Column]:
    """Returns the columns of the table of points."""
    medians = [each for each in measures(blocks, channels) if each.name not in NOT_MEDIAN]
    return [*POINT_HEAD, *_varied(keys), *POINT_FACTS, *medians, *named(MEANS, blocks)]


def measures(blocks: Sequence[str], channels: Sequence[str]) -> list[Column]:
    """Returns the columns of what is measured of a run."""
    return [*RUN_MEASURES, *named(BLOCK_MEASURES, blocks), *named(LINK_MEASURES, channels)]


def _varied(keys: Sequence[str]) -> list[Column]:
    return [Column(key, "", "value of the varied key") for key in keys]


def markdown() -> str:
    """Returns the columns of both tables as Markdown, for docs/sweep.md."""
    varied = Column("…", "", "a column for each varied key, named as the key: a number, or TOML text for anything else")
    parts: Mapping[str, Sequence[Column]] = {
        "runs": [*RUN_HEAD, varied, *RUN_FACTS, *RUN_MEASURES, *BLOCK_MEASURES, *LINK_MEASURES],
        "points": [*POINT_HEAD, varied, *POINT_FACTS, *MEANS],
    }
    lines = []
    for name, columns in parts.items():
        lines += [f"### `{name}`", "", "| column | unit | meaning |", "|---|---|---|"]
        lines += [f"| `{each.name}` | {each.unit} | {each.about} |" for each in columns]
        lines.append("")
    return "\n".join(lines)
