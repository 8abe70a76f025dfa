"""Reads back the folder of a run."""

from itertools import islice
from pathlib import Path
from typing import Any, Final

import cantools

from echelon.bridge.canlog import Logged, read_log
from echelon.bridge.plan_dbc import plan_dbc
from echelon.errors import UserError
from echelon.plan import Plan
from echelon.shipped import EFFECTIVE
from echelon.sim.parts import load
from echelon.sim.recording import read_trace
from echelon.sim.report import RunForReport, write_report
from echelon.sim.results.rendering import read_summary
from echelon.sim.results.run import Run

FRAMES: Final = 18
"""So many frames a report shows, from run time 0 on."""


def open_run(folder: Path) -> Run:
    """Opens the folder that a run left.  Raises UserError."""
    try:
        _, plan = load(folder / EFFECTIVE, trial=False)
        summary = read_summary(folder / "summary.json")
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}") from None
    except ValueError as error:
        raise UserError(f"{folder / 'summary.json'}: {error}") from None
    try:
        trace = read_trace(folder / "run.mcap", plan)
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}") from None
    except ValueError as error:  # which begins with the file
        raise UserError(str(error)) from None
    return Run(trace, summary, folder)


def _for_report(folder: Path) -> RunForReport:
    """Opens a run's folder for a report.  Raises UserError and OSError."""
    run = open_run(folder)
    toml = (folder / EFFECTIVE).read_text(encoding="utf-8")
    frames = first_frames(folder / "can.log", run.plan)
    return RunForReport(folder.resolve().name, run.trace, run.summary, toml, frames)


def report_on(folders: list[Path], path: Path) -> None:
    """Writes a report of runs.  Raises UserError and OSError."""
    write_report([_for_report(folder) for folder in folders], path)


def first_frames(path: Path, plan: Plan, count: int = FRAMES) -> tuple[dict[str, object], ...]:
    """Returns the first frames of a run in its can.log, decoded by its DBC; none if there is no log."""
    start_ns = plan.can.bring_up_ns if plan.can.closed else 0
    databases = {
        bus.name: cantools.database.load_string(plan_dbc(plan, number), "dbc")
        for number, bus in enumerate(plan.can.buses)
    }
    try:
        running = (logged for logged in read_log(path) if logged.time_ns >= start_ns)
        return tuple(_row(logged, databases.get(logged.channel), start_ns) for logged in islice(running, count))
    except OSError:
        return ()


def _row(logged: Logged, database: Any, start_ns: int) -> dict[str, object]:
    time_ns, channel, (can_id, data, remote) = logged
    name, text = "", ""
    try:
        message = database.get_message_by_frame_id(can_id)
        name = message.name
        signals = message.decode(data, allow_truncated=True)
        units = {signal.name: signal.unit or "" for signal in message.signals}
        text = ", ".join(f"{signal} {_value(value)} {units[signal]}".rstrip() for signal, value in signals.items())
    except Exception:  # a frame of nobody here, or one that says nothing
        pass
    content = "R" if remote else data.hex().upper()
    return {
        "t [s]": f"{(time_ns - start_ns) / 1e9:.6f}",
        "bus": channel,
        "frame": f"{can_id:03X}#{content}",
        "message": name,
        "says": text,
    }


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
