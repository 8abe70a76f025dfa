"""Recordings for tests: a run in this process, recorded message by message, with whatever a test does to a message."""

from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from echelon.messages import Channel, Message
from echelon.plan.plan import Plan
from echelon.planning.loading import effective_toml
from echelon.shipped import scenario_path
from echelon.sim.engines.in_process import Engine
from echelon.sim.parts.loading import load
from echelon.sim.recording.recorder import Recorder

QUICK = ("duration=0.4", "claims=[]")
LOSSY = (
    "links=[{delay={min=0.005,max=0.05},loss=0.2},"
    '{channel="command",delay=0.02,loss=0.4,policy="hold_then_stop",timeout=0.03}]'
)
"""Links that lose and delay, so that nodes lack inputs at times and send null messages"""
VIRTUAL = {"engine": "inprocess", "clock": "virtual"}

Alter = Callable[[Message], Message | None]
"""Returns what is recorded of a message; None: nothing"""


def messages_of(plan: Plan) -> list[Message]:
    """Runs a plan; returns all messages in the order of a recording, those of the bus left out."""
    found: list[Message] = []
    Engine(plan, found.append).run()
    kept = [message for message in found if message.channel is not Channel.FRAMES]
    return sorted(kept, key=lambda message: (message.time_ns, message.source, message.channel))


def record(
    folder: Path,
    scenario: str,
    *overrides: str,
    alter: Alter = lambda message: message,
    metadata: dict[str, str] | None = None,
) -> Path:
    """Runs a scenario with overrides, and records it into a folder; returns the folder."""
    described, plan = load(scenario_path(scenario), [*QUICK, *overrides])
    toml = effective_toml(described)
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "scenario.toml").write_text(toml)
    with closing(Recorder(folder / "run.mcap", plan, toml, VIRTUAL if metadata is None else metadata)) as recorder:
        for message in messages_of(plan):
            if (kept := alter(message)) is not None:
                recorder.record(kept)
    return folder


def planted(source: int, channel: Channel, sequence: int, value: int, change: float) -> Alter:
    """Returns what changes one value of one message."""

    def alter(message: Message) -> Message:
        if (message.source, message.channel, message.sequence) != (source, channel, sequence):
            return message
        values = message.values.copy()
        values[value] += change
        return message._replace(values=values)

    return alter
