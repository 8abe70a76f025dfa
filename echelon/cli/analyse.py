"""The command `echelon analyse`: computes, without a run, whether a formation settles and how much delay it tolerates."""

import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from echelon.cli.options import Command
from echelon.cli.shared import JSON, ScenarioOptions
from echelon.errors import UsageError

if TYPE_CHECKING:
    from echelon.controller.prediction.analysis import Analysis
    from echelon.controller.prediction.largest_delay import LargestDelay


@dataclass(frozen=True, slots=True, kw_only=True)
class AnalyseOptions(ScenarioOptions):
    """Options of `echelon analyse`."""

    json: bool = field(default=False, metadata=JSON)


def analyse(options: AnalyseOptions) -> int:
    """Computes whether the formation settles and how much delay it tolerates.

    Returns exit code 1 if it does not settle, or if the torque loop of a robot diverges."""
    from echelon.cli.scenario_file import read_scenario
    from echelon.controller.prediction.analysis import analyse as analysis_of
    from echelon.controller.prediction.gains import PredictionError
    from echelon.sim.forecast.motion import asked_of, torque_loop_diverges, torque_loop_warnings

    _, plan = read_scenario(options.scenario, options.overrides)
    try:
        found = analysis_of(plan)
    except PredictionError as error:
        raise UsageError(f"{options.scenario}: cannot be analysed; run it instead: {error}") from None
    asked = asked_of(plan)
    diverges, warnings = torque_loop_diverges(plan, asked), torque_loop_warnings(plan, asked)
    if options.json:
        print(json.dumps({"scenario": plan.name, **_facts(found), "torque_loop_diverges": diverges}, indent=2))
    else:
        print("\n".join(_lines(plan.name, found, warnings, closed=plan.can.closed, diverges=diverges)))
    return 0 if found.settles and not diverges else 1


def _facts(found: "Analysis") -> dict[str, Any]:
    """Returns the results as data for JSON; all times are in seconds."""
    return {
        "periods": {"acceleration": found.acceleration_periods, "torque": found.torque_periods},
        "delays": {channel.name.lower(): delays for channel, delays in found.delays.items()},
        "blocks": {block.name: {"sigma": block.sigma, "delay_margin": block.margin} for block in found.blocks},
        "settles": found.settles,
        "hyperperiod": found.hyperperiod,
        "spectral_radius": found.radius,
        "centroid_age": found.centroid_age,
        "later": {
            channel.name.lower(): {"seconds": each.seconds, "ticks": each.ticks, "tick": each.tick_s, "ends": each.ends}
            for channel, each in found.later.items()
        },
    }


def _lines(name: str, found: "Analysis", warnings: Sequence[str], *, closed: bool, diverges: bool) -> list[str]:
    """Returns the results as lines for people.

    `warnings` are about the torque loop, which `diverges` or not; `closed` says that the torque path is closed."""
    channels = _enumeration([channel.name.lower() for channel in found.delays])
    accelerations, torques = (_ms(periods) for periods in (found.acceleration_periods, found.torque_periods))
    lines = [f"{name}: channels {channels}; accelerations every {accelerations}, torques every {torques}"]
    late = [
        f"{channel.name.lower()} {_ms(delays)}"
        for channel, delays in found.delays.items()
        if any(d > 0 for d in delays)
    ]
    lines.append(f"  delays of the scenario's links: {', '.join(late) if late else 'none'}; no link loses messages")
    lines.append(
        "  assumed: robots follow the desired accelerations exactly, no limit acts, avoidance does not act"
        + (", bus and drives take no time" if closed else "")
    )
    for block in found.blocks:
        margin = "unstable without any delay" if block.margin is None else f"{1e3 * block.margin:.4g} ms"
        lines.append(
            f"  {block.name:<12} σ {block.sigma:<6.4g} s   margin of the block alone, in continuous time: {margin}"
        )
    step = f"spectral radius {found.radius:.6f} over {_ms([found.hyperperiod])}"
    outcome = "settles; errors shrink" if found.settles else "does not settle; errors grow"
    lines.append(f"  all together, with these delays: {outcome} e-fold in {found.time_constant:.3g} s ({step})")
    lines += [f"  but {each}" for each in warnings]
    if diverges or not found.settles:
        return lines
    if found.centroid_age > 0:
        lines.append(
            f"  positions are {1e3 * found.centroid_age:.4g} ms old at the coordinator: the centroid of a moving formation is "
            "off its trajectory by the distance that it moves in this time"
        )
    beyond = "beyond these delays, " if late else ""
    lines.append(f"  {beyond}all messages of one channel may be later by up to")
    lines += [f"    {channel.name.lower():<12} {_later(each)}" for channel, each in found.later.items()]
    return lines


def _later(found: "LargestDelay") -> str:
    """Returns in words how much later messages may be, and what happens beyond that.  Only for a formation that settles."""
    assert found.ticks is not None
    assert found.seconds is not None
    if found.beyond_s > 0 and found.ends == "unstable":
        return f"{1e3 * found.seconds:.6g} ms ({found.seconds / found.tick_s:.4g} ticks of {1e3 * found.tick_s:g} ms)"
    why = {
        "unstable": "one tick more does not settle",
        "timeout": "with one tick more they are older than the timeout allows, and not used at all",
        "limit": "longer delays have not been tried",
    }
    return f"{1e3 * found.seconds:.6g} ms ({found.ticks} ticks of {1e3 * found.tick_s:g} ms); {why[found.ends]}"


def _ms(seconds: Sequence[float]) -> str:
    """Returns times [s] as text in milliseconds: one number if all are equal, else the smallest and the largest."""
    least, most = (f"{1e3 * each:g}" for each in (min(seconds), max(seconds)))
    return f"{least} ms" if least == most else f"{least} to {most} ms"


def _enumeration(names: Sequence[str]) -> str:
    """Returns names as a list in words: `a, b and c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


ANALYSE: Final = Command(
    name="analyse",
    options=AnalyseOptions,
    work=analyse,
    about="""\
Computes, without a run, whether the formation settles with the periods of the scenario and the
constant delays of its links, and how much later all messages of one channel may come before it
no longer settles.  It assumes that robots follow the desired accelerations exactly, and reports
a torque loop that is too slow for that.  It refuses links that lose messages or whose delays
vary, and laws that are not linear: run such scenarios instead.""",
    examples={
        "echelon analyse paper": "states may be up to 6.8 ms late",
        "echelon analyse lab --set 'links=[{channel=\"state\",delay=0.3}]'": "with a delay",
        "echelon analyse lab --json": "for scripts",
    },
    codes={0: "it settles", 1: "it does not settle, or a torque loop diverges"},
)
