"""Commands about what was recorded: `replay` compares it with today's roles, `diff` with another run; `latencies` says how long
messages took."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from echelon.cli.options import Command, argument, option
from echelon.cli.shared import JSON, OVERRIDES

TOLERANCE: Final = option(
    "largest difference of a value that counts as equal, in its unit (default: 0, bit for bit)", "X"
)


@dataclass(frozen=True, slots=True, kw_only=True)
class ReplayOptions:
    """Options of `echelon replay`."""

    run: Path = field(metadata=argument("the folder of a run", "RUN"))
    only: tuple[str, ...] = field(
        default=(),
        metadata=option(
            "a robot, a node, or a group with all below it: g1/r1, coordinator, g1; may be repeated", "PATH"
        ),
    )
    overrides: tuple[str, ...] = field(default=(), metadata=OVERRIDES)
    scenario: str | None = field(
        default=None,
        metadata=option("the scenario of the roles, of the same tree (default: that of the run)", "SCENARIO"),
    )
    tolerance: float = field(default=0.0, metadata=TOLERANCE)
    json: bool = field(default=False, metadata=JSON)


def replay(options: ReplayOptions) -> int:
    """Feeds a run's messages to roles and compares what they say; 1 if it differs from what was recorded."""
    from echelon.sim.recorded_runs import replay_run

    found = replay_run(options.run, options.scenario, options.overrides, options.only, options.tolerance)
    print(json.dumps(found.to_json(), indent=2, allow_nan=False) if options.json else found)
    return 0 if found.equal else 1


@dataclass(frozen=True, slots=True, kw_only=True)
class DiffOptions:
    """Options of `echelon diff`."""

    first: Path = field(metadata=argument("the folder of a run", "RUN"))
    second: Path = field(metadata=argument("the folder of another", "RUN"))
    tolerance: float = field(default=0.0, metadata=TOLERANCE)
    json: bool = field(default=False, metadata=JSON)


def diff(options: DiffOptions) -> int:
    """Says where two runs part; 1 if they do."""
    from echelon.sim.recorded_runs import diff_runs

    found = diff_runs(options.first, options.second, options.tolerance)
    print(json.dumps(found.to_json(), indent=2, allow_nan=False) if options.json else found)
    return 0 if found.equal else 1


@dataclass(frozen=True, slots=True, kw_only=True)
class LatenciesOptions:
    """Options of `echelon latencies`."""

    run: Path = field(metadata=argument("the folder of a run on a wall clock", "RUN"))
    out: Path | None = field(
        default=None,
        metadata=option("folder for the traces and the scenario (default: latencies in the run's folder)", "DIR"),
    )
    replace: bool = field(default=False, metadata=option("overwrite files of the same names"))
    json: bool = field(default=False, metadata=JSON)


def latencies(options: LatenciesOptions) -> int:
    """Says how long the messages of a run took, and writes traces of it."""
    from echelon.sim.measured_links import measured, write_traces
    from echelon.sim.out_folder import TRACES

    found = measured(options.run)
    files = write_traces(options.run, found.arrivals, options.out or options.run / TRACES, replace=options.replace)
    if options.json:
        print(json.dumps({**found.to_json(), "files": list(map(str, files))}, indent=2, allow_nan=False))
    else:
        print(found)
        print(f"written: {len(files) - 1} traces, and a scenario with them: echelon run {files[0]}")
    return 0


COMMANDS: Final[tuple[Command[Any], ...]] = (
    Command(
        name="replay",
        options=ReplayOptions,
        work=replay,
        about="""\
Feeds the messages that a run recorded to today's robots and nodes, and compares what they send
with what was recorded.  With --set or --scenario it judges another law on the same data.
Each role hears what was said then, not what others compute now, so a difference stays with the
role that causes it.  Links with delay and loss deliver the same messages as in the run.
On a wall clock they are delivered when they arrived then.
Parts of yours are the copies in the run's folder; --scenario FILE takes those beside that file.""",
        examples={
            "echelon replay runs/demo": "the code of today says what was recorded",
            "echelon replay runs/demo --only g1": "one group: its leader and its robots",
            "echelon replay runs/demo --set law.epsilon=[0.3,0.6]": "another law on the same data: 1, it says something else",
            "echelon replay runs/demo --tolerance 1e-9 --json": "for scripts",
        },
        codes={0: "all outputs are equal", 1: "outputs differ"},
    ),
    Command(
        name="diff",
        options=DiffOptions,
        work=diff,
        about="""\
Compares the messages between robots and nodes that two runs recorded, and names the first
difference: run time, member, channel, value, and what each run has.  Of one instant it is the
difference in the earliest turn, from which others may follow.  It says which keys of the
scenarios differ.  Runs of different lengths are compared up to the end of the shorter one.
CAN frames are not compared; of a closed torque path the torques are.""",
        examples={
            "echelon diff runs/demo runs/avoiding": "the first instant, message and value at which they part",
            "echelon diff runs/demo runs/avoiding --tolerance 1e-6": "smaller differences count as equal",
        },
        codes={0: "over the time that both recorded they are equal", 1: "they differ"},
    ),
    Command(
        name="latencies",
        options=LatenciesOptions,
        work=latencies,
        about="""\
Says how long the messages of each link took in a run on a wall clock, and how many were lost:
from the instant in the message's header to the one from which on its receiver used it.
Writes a trace of the delays of each link, and a scenario whose links take them, message by
message.  In virtual time that scenario gives the same run again: to the last bit where torque is
mirrored.  Change it, and you see what another law does with the same network.""",
        examples={
            "echelon run lab --clock wall --out runs/real": "a run whose messages take real time",
            "echelon latencies runs/real": "the table; traces and scenario.toml in runs/real/latencies",
            "echelon run runs/real/latencies/scenario.toml": "the same run in virtual time",
            "echelon latencies runs/real --json --out traces": "for scripts; files into a folder of yours",
        },
        codes={0: "written"},
    ),
)
