"""The command `echelon observe`."""

import json
import sys
from dataclasses import dataclass, field
from math import isfinite
from pathlib import Path
from typing import Any, Final

from echelon.cli.options import Command, argument, option
from echelon.cli.shared import JSON


@dataclass(frozen=True, slots=True, kw_only=True)
class ObserveOptions:
    """Options of `echelon observe`."""

    run: Path = field(metadata=argument("the folder of a run that goes on, begun with --observe", "RUN"))
    under: str = field(
        default="", metadata=option("a robot or a group with all below it: g1/r1, g1 (default: all)", "PATH")
    )
    channel: str | None = field(
        default=None, metadata=option("messages of this channel only: state, group_state, reference, command …", "NAME")
    )
    json: bool = field(default=False, metadata=JSON)


def observe(options: ObserveOptions) -> int:
    """Prints the messages of a run until it ends."""
    from echelon.cli.scenario_file import read_scenario
    from echelon.errors import UsageError
    from echelon.messages import STATE_FIELDS, TORQUE_FIELDS, Channel
    from echelon.runtime.admission import Refusals
    from echelon.sim.observing import Ticket
    from echelon.sim.observing import observe as messages_of

    ticket = Ticket.read(options.run)
    _, plan = read_scenario(str(options.run), ())
    names = {one.index: one.name for one in plan.all_roles}
    if options.under and not any(f"{one.path}/".startswith(f"{options.under}/") for one in plan.all_roles):
        raise UsageError(f"--under {options.under}: the run has {', '.join(sorted(names.values()))}")
    allowed = [channel.name.lower() for channel in Channel if channel is not Channel.FRAMES]
    if options.channel is not None and options.channel not in allowed:
        raise UsageError(f"--channel {options.channel}: must be {', '.join(allowed)}")
    fields = {Channel.STATE: STATE_FIELDS, Channel.TORQUE: TORQUE_FIELDS}
    refusals = Refusals()
    for message in messages_of(ticket, plan, options.under, refusals):
        channel = message.channel.name.lower()
        if options.channel not in (None, channel):
            continue
        values = message.values.tolist()
        if options.json:
            known = [value if isfinite(value) else None for value in values]
            named: Any = dict(zip(fields[message.channel], known, strict=True)) if message.channel in fields else known
            line = {"t": message.time_ns / 1e9, "from": names[message.source], "channel": channel, "values": named}
            print(json.dumps(line, allow_nan=False), flush=True)
        else:
            shown = " ".join(f"{value:.4g}" for value in values) or "(null)"
            print(f"{message.time_ns / 1e9:>10.4f} s  {names[message.source]:<12} {channel:<12} {shown}", flush=True)
    if refusals.total:
        print(f"{refusals.total} messages refused: {refusals.by_source()}", file=sys.stderr)
    return 0


COMMANDS: Final = (
    Command(
        name="observe",
        live=True,
        options=ObserveOptions,
        work=observe,
        about="""\
Prints the messages of a run that goes on, as they come, until it ends.  The run must have been
begun with --observe; its folder then holds observe.json, a secret that lets its owner read and
never write.  Who reads too slowly misses messages; the run does not wait.""",
        examples={
            "echelon observe runs/mine": "all messages of the run in runs/mine",
            "echelon observe runs/mine --under g1 --channel state --json": "states of group g1, for a script",
        },
        codes={0: "the run is over", 141: "nobody reads it any more"},
    ),
)
