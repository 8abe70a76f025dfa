"""Reads the folder of a run, and writes its report."""

from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any, Final

from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.log import read_run_log
from echelon.bridge.stations.closed import LOG
from echelon.errors import UserError
from echelon.plan.plan import Plan
from echelon.shipped import EFFECTIVE
from echelon.sim.finished_run import Run
from echelon.sim.parts.loading import load
from echelon.sim.recording.mcap_reader import CutError, read_trace
from echelon.sim.report.report import write_report
from echelon.sim.report.run_for_report import RunForReport
from echelon.sim.results.frames import FrameDecoder, frame_data
from echelon.sim.results.rendering import read_summary

FRAMES: Final = 18
"""Number of CAN frames that a report shows, from run time 0 on"""


def open_run(folder: Path) -> Run:
    """Returns the run in a folder.  Raises UserError if a file of it is missing, damaged or not readable."""
    if not any((folder / name).exists() for name in (EFFECTIVE, "run.mcap", "summary.json")):
        raise UserError(f"{folder}: is not the folder of a run")
    try:
        _, plan = load(folder / EFFECTIVE, trial=False)
        summary = read_summary(folder / "summary.json")
    except FileNotFoundError as error:
        hint = f"`echelon recover {folder}` rebuilds what a killed run left"
        raise UserError(f"{error.filename}: {error.strerror}; {hint}") from None
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}") from None
    except ValueError as error:
        raise UserError(f"{folder / 'summary.json'}: {error}") from None
    try:
        trace = read_trace(folder / "run.mcap", plan)
    except CutError:
        raise UserError(f"{folder / 'run.mcap'}: is cut short; `echelon recover {folder}` mends it") from None
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}") from None
    except ValueError as error:  # its text begins with the name of the file
        raise UserError(str(error)) from None
    return Run(trace, summary, folder)


def runs_for_report(folders: Sequence[Path]) -> list[RunForReport]:
    """Returns the runs in some folders, for a report.  Raises UserError as `open_run` does, and OSError."""
    return [_for_report(folder, name) for folder, name in zip(folders, run_names(folders), strict=True)]


def _for_report(folder: Path, name: str) -> RunForReport:
    run = open_run(folder)
    toml = (folder / EFFECTIVE).read_text(encoding="utf-8")
    return RunForReport(name, run.trace, run.summary, toml, first_frames(folder / LOG, run.plan))


def run_names(folders: Sequence[Path]) -> list[str]:
    """Returns a name for each run: the last parts of its folder's path, as few as are different for different folders.

    Names of a folder that is given several times are numbered."""
    parts = [folder.resolve().parts for folder in folders]
    different = len(set(parts))
    for count in range(1, max(map(len, parts), default=1) + 1):
        names = ["/".join(part[-count:]) for part in parts]
        if len(set(names)) == different:
            break
    return [
        f"{name} ({names[:at].count(name) + 1})" if names.count(name) > 1 else name for at, name in enumerate(names)
    ]


def report_on(folders: Sequence[Path], path: Path) -> None:
    """Writes the report of the runs in some folders.  Raises UserError as `open_run` does, and OSError."""
    write_report(runs_for_report(folders), path)


def first_frames(path: Path, plan: Plan, count: int = FRAMES) -> tuple[dict[str, object], ...]:
    """Returns the first `count` frames of a run from run time 0 on, decoded by its DBC; empty if can.log cannot be read.

    Each frame is a row: texts by the names of the columns."""
    running = (logged for logged in read_run_log(path, plan) if logged[0] >= 0)
    try:
        first = list(islice(running, count))
    except OSError:
        return ()
    decoder, names = FrameDecoder(plan), [bus.name for bus in plan.can.buses]
    return tuple(_row(decoder, names[bus], time_ns, bus, frame) for time_ns, bus, frame in first)


def _row(decoder: FrameDecoder, name: str, time_ns: int, bus: int, frame: Frame) -> dict[str, object]:
    signals = decoder.signals(bus, frame)
    units = decoder.units(bus, frame.can_id) if signals else {}
    says = [f"{signal} {_value(value)} {units[signal]}".rstrip() for signal, value in signals.items()]
    return {
        "t [s]": f"{time_ns / 1e9:.6f}",
        "bus": name,
        "frame": f"{frame.can_id:03X}#{frame_data(frame)}",
        "message": decoder.name(bus, frame.can_id),
        "says": ", ".join(says),
    }


def _value(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
