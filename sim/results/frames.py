"""The frames in a run's can.log, decoded by the DBC files of its plan."""

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
    """Decodes frames by the messages and signals in the DBC files of a plan, one for each bus."""

    def __init__(self, plan: Plan) -> None:
        self._messages: list[dict[int, Any]] = []
        for bus in range(len(plan.can.buses)):
            database: Any = cantools.database.load_string(plan_dbc(plan, bus), "dbc")
            self._messages.append({message.frame_id: message for message in database.messages})

    def name(self, bus: int, can_id: int) -> str:
        """Returns the name of the message with an identifier; empty if the DBC has none."""
        message = self._messages[bus].get(can_id)
        return "" if message is None else str(message.name)

    def signals(self, bus: int, frame: Frame) -> dict[str, Any]:
        """Returns the values of a frame's signals by name, a value's own name if the DBC has one.

        Returns an empty mapping for an unknown identifier, a remote frame, and data that cannot be decoded."""
        message = self._messages[bus].get(frame.can_id)
        if message is None or frame.remote:
            return {}
        try:
            values: Mapping[str, Any] = message.decode(frame.data, allow_truncated=True)
        except Exception:  # cantools raises errors of several kinds for data that do not fit the message
            return {}
        return {name: value if isinstance(value, (int, float)) else str(value) for name, value in values.items()}

    def units(self, bus: int, can_id: int) -> dict[str, str]:
        """Returns the units of a message's signals by name; empty for a signal without a unit.  Raises KeyError for an unknown
        identifier."""
        return {signal.name: signal.unit or "" for signal in self._messages[bus][can_id].signals}


def frame_data(frame: Frame) -> str:
    """Returns a frame's data as candump writes them: hexadecimal, or R for a remote frame."""
    return "R" if frame.remote else frame.data.hex().upper()


def frames_table(plan: Plan, frames: Iterable[BusFrame]) -> Table:
    """Returns a row for each frame, in the given order.  Frames from the bring-up of drives have negative times `t`.

    `identifier` is hexadecimal, for example `0x101`.  `signals` is JSON text; a value that is not finite becomes null."""
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
