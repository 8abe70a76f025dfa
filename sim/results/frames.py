"""The frames of a run's can.log, decoded by the DBC of its plan."""

import json
from collections.abc import Iterable, Mapping
from math import isfinite
from typing import Any, Final

import cantools
import numpy as np

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.protocols.plan_dbc import plan_dbc
from echelon.plan.plan import Plan
from echelon.sim.results.tables import Table

BusFrame = tuple[int, int, Frame]
"""Run time [ns], number of the bus, frame"""
COLUMNS: Final = ("t", "bus", "identifier", "name", "data", "signals")


class FrameDecoder:
    """Says what frames mean, by the messages and signals of a plan's DBC."""

    def __init__(self, plan: Plan) -> None:
        self._messages: list[dict[int, Any]] = []
        for bus in range(len(plan.can.buses)):
            database: Any = cantools.database.load_string(plan_dbc(plan, bus), "dbc")
            self._messages.append({message.frame_id: message for message in database.messages})

    def name(self, bus: int, can_id: int) -> str:
        """Returns what the frames with an identifier are called; empty if they are nobody's here."""
        message = self._messages[bus].get(can_id)
        return "" if message is None else str(message.name)

    def signals(self, bus: int, frame: Frame) -> dict[str, Any]:
        """Returns the values of a frame's signals, names where the DBC has some; empty if it says nothing that is known."""
        message = self._messages[bus].get(frame.can_id)
        if message is None or frame.remote:
            return {}
        try:
            values: Mapping[str, Any] = message.decode(frame.data, allow_truncated=True)
        except Exception:  # whatever cantools makes of bytes that are not what their identifier says
            return {}
        return {name: value if isinstance(value, (int, float)) else str(value) for name, value in values.items()}

    def units(self, bus: int, can_id: int) -> dict[str, str]:
        """Returns the units of the signals of a message."""
        return {signal.name: signal.unit or "" for signal in self._messages[bus][can_id].signals}


def frame_data(frame: Frame) -> str:
    """Returns a frame's bytes as candump writes them: hexadecimal, or R for a remote frame."""
    return "R" if frame.remote else frame.data.hex().upper()


def frames_table(plan: Plan, frames: Iterable[BusFrame]) -> Table:
    """Returns frames in their order, those of bringing up drives at times below zero.

    `identifier` is hexadecimal, `0x101`; `signals` are JSON, null where a value is not finite."""
    decoder, names = FrameDecoder(plan), [bus.name for bus in plan.can.buses]
    rows = [
        (
            time_ns / 1e9,
            names[bus],
            f"0x{frame.can_id:03X}",
            decoder.name(bus, frame.can_id),
            frame_data(frame),
            _json(decoder.signals(bus, frame)),
        )
        for time_ns, bus, frame in frames
    ]
    columns = zip(*rows, strict=True) if rows else [()] * len(COLUMNS)
    return Table(
        "frames",
        ("t", "bus", "identifier"),
        {
            name: np.array(column, dtype=float if name == "t" else object)
            for name, column in zip(COLUMNS, columns, strict=True)
        },
    )


def _json(signals: Mapping[str, Any]) -> str:
    finite = {
        name: None if isinstance(value, float) and not isfinite(value) else value for name, value in signals.items()
    }
    return json.dumps(finite, separators=(",", ":"), ensure_ascii=False)
