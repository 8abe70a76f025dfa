"""mosaik with each simulator in its own process: four steps per tick, for states, group states, the reference, commands.

Run as a module this file is one simulator; mosaik gives it the address of the world as an argument.
"""

from __future__ import annotations

import os
import sys
import warnings
from pathlib import Path
from typing import Any

from bench.tree import (
    COORDINATOR,
    FIELDS,
    LEADERS,
    ROBOTS,
    ROLES,
    Meter,
    Role,
    command_law,
    die_with_parent,
    robot_law,
    robot_start,
    run_processes,
    sum_law,
)

REQUIRES = ("mosaik", "mosaik_api_v3")
_FOLDER, _TICKS = "BENCH_FOLDER", "BENCH_TICKS"
_STEPS = 4
_ATTRS = (["group", "reference"], ["state", "group", "reference", "command"], ["state", "command"])


def run(ticks: int, folder: Path) -> None:
    """Runs the exchange, with a further process for mosaik's world."""
    import multiprocessing

    run_processes([multiprocessing.get_context("fork").Process(target=_world, args=(ticks, folder), daemon=True)])


def _world(ticks: int, folder: Path) -> None:
    die_with_parent()
    warnings.simplefilter("ignore")  # commands reach robots, which step in every tick anyway, one step later
    import mosaik

    environment = {
        "LOGURU_LEVEL": "ERROR",
        _FOLDER: str(folder),
        _TICKS: str(ticks),
        "PYTHONPATH": os.pathsep.join(sys.path),
    }
    world = mosaik.World(
        {"Role": {"cmd": "%(python)s -m bench.peers.mosaik_processes %(addr)s", "env": os.environ | environment}},
        skip_greetings=True,
        configure_logging=False,
    )
    entities = {}
    for role in ROLES:
        entities[role] = world.start("Role", group=role.group, number=role.number).Role()
    for leader in LEADERS:
        for number in range(ROBOTS):
            robot = Role(leader.group, number)
            world.connect(entities[robot], entities[leader], "state")
            world.connect(
                entities[leader],
                entities[robot],
                "command",
                time_shifted=True,
                initial_data={"command": [0.0] * FIELDS["command"]},
            )
        world.connect(entities[leader], entities[COORDINATOR], "group")
        world.connect(
            entities[COORDINATOR],
            entities[leader],
            "reference",
            time_shifted=True,
            initial_data={"reference": [0.0] * FIELDS["reference"]},
        )
    meter = Meter()
    meter.start()
    world.run(until=_STEPS * ticks + 1, print_progress=False)
    meter.report(folder, "world", None)


def _simulator() -> None:
    die_with_parent()
    import mosaik_api_v3

    folder, ticks = Path(os.environ[_FOLDER]), int(os.environ[_TICKS])

    class Simulator(mosaik_api_v3.Simulator):
        """One role."""

        def __init__(self) -> None:
            super().__init__({"models": {}})  # type: ignore[no-untyped-call]
            self._meter = Meter()
            self._out = {channel: [0.0] * number for channel, number in FIELDS.items()}
            self._value = 0.0

        def init(self, sid: str, time_resolution: float = 1.0, **place: Any) -> Any:
            self._role = Role(**place)
            self._value = robot_start(self._role)
            self.meta["type"] = "time-based"
            self.meta["models"]["Role"] = {"public": True, "params": [], "attrs": _ATTRS[_level(self._role)]}
            return self.meta

        def create(self, num: int, model: str, **model_params: Any) -> Any:
            return [{"eid": "role", "type": model}]

        def setup_done(self) -> None:
            self._meter.start()

        def step(self, time: int, inputs: dict[str, Any], max_advance: int) -> int:
            received = {attr: list(values.values()) for attr, values in inputs.get("role", {}).items()}
            role, send = self._role, self._send
            tick, phase = divmod(time, _STEPS)
            if role.number is not None:
                if tick:
                    (command,) = received["command"]
                    self._value = robot_law(self._value, _value(command))
                send("state", self._value)
                if tick == ticks:
                    self._finish()
                return time + _STEPS
            if role.group is not None:
                if phase == 1:
                    self._value = sum_law([_value(state) for state in received["state"]])
                    send("group", self._value)
                elif phase == 3:
                    (reference,) = received["reference"]
                    send("command", command_law(_value(reference), role.group))
                    if tick == ticks - 1:
                        self._finish()
                return time + 2 if phase else time + 1
            if phase == 2:
                self._value = sum_law([_value(group) for group in received["group"]])
                send("reference", self._value)
                if tick == ticks - 1:
                    self._finish()
                return time + _STEPS
            return time + 2

        def get_data(self, outputs: dict[str, list[str]]) -> dict[str, Any]:
            return {"role": {attr: self._out[attr] for attr in outputs["role"]}}

        def _send(self, channel: str, value: float) -> None:
            self._out[channel] = [value] * FIELDS[channel]

        def _finish(self) -> None:
            self._meter.report(folder, self._role.name, self._value)

    mosaik_api_v3.start_simulation(Simulator(), configure_logging=False)


def _level(role: Role) -> int:
    return 0 if role.group is None else 1 if role.number is None else 2


def _value(fields: list[float]) -> float:
    return (fields[0] + fields[-1]) / 2


if __name__ == "__main__":
    _simulator()
