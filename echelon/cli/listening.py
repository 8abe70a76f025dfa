"""What `echelon can` and `echelon referee` do: listen to the buses of a scenario, or read the can.log of a run's folder."""

import json
import select
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final, NamedTuple

from rich.console import Console
from rich.live import Live
from rich.text import Text

from echelon.bridge.can.bus import Bus, open_bus
from echelon.bridge.can.bus_url import interface_is_up, resolve_url
from echelon.bridge.can.canlog import read_lines
from echelon.bridge.protocols.frame import Frame
from echelon.bridge.referee.referee import Referee, judge_log, of_run, read_run_log
from echelon.bridge.reports import RefereeReport
from echelon.bridge.stations.closed import LOG
from echelon.errors import UsageError
from echelon.plan.plan import Plan
from echelon.sim.run_state import goes_on, read_state
from echelon.sim.view.wheel_table import CanTable, finding_text

TICK_S: Final = 0.1
"""Listening looks up so often though nothing comes"""
SHOW_S: Final = 0.25
"""Between two tables in a terminal"""
LINE_S: Final = 1.0
"""Between two lines, or two objects of JSON"""
_AT_ONCE: Final = 256
_AT_ONCE_BYTES: Final = 1 << 20
_PAUSE_S: Final = 0.02
"""After an error of a bus, so that it can come back"""


class Heard(NamedTuple):
    """A frame, or None where only time passed: run time [ns], number of the bus."""

    time_ns: int
    bus: int
    frame: Frame | None


def show_live(
    plan: Plan, wanted: str | None, seconds: float | None, as_json: bool, console: Console | None = None
) -> None:
    """Shows what comes on the plan's buses, until Ctrl-C or for some seconds.  Raises UserError."""
    buses = _open(_urls(plan, wanted))
    table = CanTable(plan, Referee(plan, late=True), tuple(bus.url for bus in buses))
    try:
        _show(table, _listen(buses, seconds), as_json, console or Console())
    finally:
        for bus in buses:
            bus.close()


def show_end(plan: Plan, folder: Path, as_json: bool) -> None:
    """Shows how a run ended by its can.log.  Raises UserError."""
    tolerance_ns, _, until_ns = _told_by(folder, plan)
    table = CanTable(plan, Referee(plan, tolerance_ns=tolerance_ns), _names(plan))
    for logged in _read(folder, plan):
        if until_ns is None or logged[0] <= until_ns:
            table.take(*logged)
    _finish(table, folder)
    if as_json:
        print(json.dumps(table.data(table.time_ns), allow_nan=False))
    else:
        console = Console()
        console.print(table.render(table.time_ns, console.width))


def show_growing(
    plan: Plan, folder: Path, seconds: float | None, as_json: bool, console: Console | None = None
) -> None:
    """Shows a run that goes on by its can.log, as it is written: to its end, until Ctrl-C, or for some seconds.

    The log has the times of the run, whatever its clock; who listens to the bus itself knows only when frames came."""
    table = CanTable(plan, Referee(plan, tolerance_ns=_told_by(folder, plan)[0]), _names(plan))

    def heard() -> Iterator[Heard]:
        yield from _follow(folder, plan, seconds)
        if not goes_on(folder):
            _finish(table, folder)

    _show(table, heard(), as_json, console or Console())


def show_again(plan: Plan, folder: Path, speed: float, seconds: float | None, as_json: bool) -> None:
    """Shows a run's can.log, `speed` times as fast as it was.  Raises UserError."""
    table = CanTable(plan, Referee(plan), _names(plan))
    _show(table, _replay(folder, plan, speed, seconds), as_json, Console())


def _show(table: CanTable, heard: Iterator[Heard], as_json: bool, console: Console) -> None:
    shown, time_ns = _Shown(table, console, as_json), 0
    try:
        for time_ns, number, frame in heard:
            if frame is not None:
                table.take(time_ns, number, frame)
            shown.show_if_due(time_ns)
    except KeyboardInterrupt:
        pass
    finally:
        shown.close(time_ns)


def judge_run(plan: Plan, folder: Path) -> RefereeReport:
    """Judges a run's can.log as the run itself did: on a wall clock processes may be late.  Of a run that goes on, what there
    is by now.  Raises UserError."""
    tolerance_ns, whole, until_ns = _told_by(folder, plan)
    try:
        return judge_log(folder / LOG, plan, tolerance_ns=tolerance_ns, whole=whole, until_ns=until_ns)
    except OSError as error:
        raise UsageError(f"{folder / LOG}: {error.strerror}") from None


def _told_by(folder: Path, plan: Plan) -> tuple[int | None, bool, int | None]:
    """Returns how late a frame of a run may be [ns] (None: as the referee has it), whether its log must go to its end: not if
    it goes on or broke off, for what our own stop sends, or does not send any more, is no finding; and up to when frames are
    judged [ns], if the run was stopped."""
    state = read_state(folder)
    try:
        summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
        run, until_s = summary["run"], summary["simulated"]
    except (OSError, ValueError, KeyError, TypeError):
        run, until_s = {}, None
    clock = run.get("clock") or (state.clock if state else "")
    whole = not (run.get("failure") or run.get("stopped") or goes_on(folder))
    until_ns = round(until_s * 1e9) if until_s is not None and run.get("stopped") else None
    return plan.can.watchdog_ns // 2 if clock == "wall" else None, whole, until_ns


def _finish(table: CanTable, folder: Path) -> None:
    """Ends the judgement of a run that is over."""
    whole = _told_by(folder, table.plan)[1]
    table.referee.finish(max(table.time_ns, table.plan.duration_ns) if whole else table.time_ns)


def judge_live(
    plan: Plan, wanted: str | None, seconds: float | None, tolerance_s: float | None, quiet: bool
) -> RefereeReport:
    """Listens until Ctrl-C or for some seconds; tells the first findings at once unless `quiet`.  Raises UserError."""
    if tolerance_s is not None and not 0 <= tolerance_s < 1e9:
        raise UsageError(f"--tolerance {tolerance_s:g}: must be 0 s or more")
    judge = Referee(plan, tolerance_ns=None if tolerance_s is None else round(tolerance_s * 1e9), late=True)
    buses = _open(_urls(plan, wanted))
    time_ns = 0
    try:
        if not quiet:
            print(f"listening on {', '.join(bus.url for bus in buses)}; Ctrl-C ends it", file=sys.stderr, flush=True)
        for time_ns, number, frame in _listen(buses, seconds):
            known = len(judge.kept)
            found = judge.observe(time_ns, number, frame) if frame is not None else []
            if not quiet and len(judge.kept) > known:
                for finding in found:
                    print(finding_text(finding), flush=True)
    except KeyboardInterrupt:
        pass
    finally:
        for bus in buses:
            bus.close()
    for finding in judge.finish(time_ns):
        if not quiet:
            print(finding_text(finding))
    return judge.report("bus")


def told(report: RefereeReport) -> Iterator[str]:
    """Yields the findings of a report, a line each."""
    for finding in report.findings:
        where = f"{finding.robot} " if finding.robot else ""
        yield f"{finding.time:.6f} s  {finding.bus} {finding.id}  {where}{finding.kind}: {finding.text}"


def verdict(report: RefereeReport) -> str:
    """Returns what was seen and found, in a line."""
    kinds = ", ".join(f"{kind} {count}" for kind, count in report.kinds.items())
    foreign = f", {report.unknown} frames of others" if report.unknown else ""
    seen = f"{report.frames} frames of {len(report.identifiers)} identifiers{foreign}{report.up_to}"
    return f"{seen}: {sum(report.kinds.values())} findings: {kinds}" if kinds else f"{seen}: no findings"


class _Shown:
    """A live table in a terminal, else a line or an object each second; and one at the end."""

    def __init__(self, table: CanTable, console: Console, as_json: bool) -> None:
        self._table = table
        self._console = console
        self._json = as_json
        self._next_s = time.monotonic()
        self._live: Live | None = None
        if console.is_terminal and not as_json:
            self._live = Live(console=console, auto_refresh=False)
            self._live.start()
        else:
            self._next_s += LINE_S

    def show_if_due(self, time_ns: int) -> None:
        """Shows how things stand at a run time, if it is time to."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = max(self._next_s + (LINE_S if self._live is None else SHOW_S), now_s)
        self._show(time_ns)
        if self._live is not None:  # a table may take long on a slow terminal: frames come first
            self._next_s = max(self._next_s, now_s + 4 * (time.monotonic() - now_s))

    def close(self, time_ns: int) -> None:
        """Shows how things stand at the end, and leaves it standing."""
        self._show(time_ns)
        if self._live is not None:
            self._live.stop()

    def _show(self, time_ns: int) -> None:
        if self._live is not None:
            self._live.update(self._table.render(time_ns, self._console.width), refresh=True)
        elif self._json:
            print(json.dumps(self._table.data(time_ns), allow_nan=False), flush=True)
        else:
            self._console.print(Text(self._table.line(time_ns)), soft_wrap=True)


def _urls(plan: Plan, wanted: str | None) -> list[str]:
    """Returns where the buses are: what --can says, one for each bus, else what the scenario says."""
    names = [bus.name for bus in plan.can.buses]
    urls = wanted.split(",") if wanted else [bus.url for bus in plan.can.buses]
    if len(urls) != len(names):
        raise UsageError(
            f"--can {wanted}: the scenario has {len(names)} buses, {', '.join(names)}: as many, with commas"
        )
    for number, url in enumerate(urls):
        if url == "auto":
            if not interface_is_up(f"vcan{number}"):
                raise UsageError(
                    f"{names[number]}: the bus is not named and there is no vcan{number}; give --can with what run.json in "
                    "the run's folder says of `buses`, e.g. --can udp_multicast:239.74.163.2:43113"
                )
            urls[number] = f"socketcan:vcan{number}"
        elif url.partition(":")[0] == "virtual":
            raise UsageError(f"{url}: is inside the process that opened it; --can socketcan:… or udp_multicast:…")
    return urls


def _open(urls: list[str]) -> list[Bus]:
    buses: list[Bus] = []
    try:
        for url in urls:
            full = resolve_url(url)
            kind, _, name = full.partition(":")
            if kind == "socketcan" and not interface_is_up(name):
                raise UsageError(f"--can {url}: there is no network interface {name} that is up")
            buses.append(open_bus(full))
    except (ValueError, OSError) as error:
        raise UsageError(str(error)) from None
    return buses


def _listen(buses: list[Bus], seconds: float | None) -> Iterator[Heard]:
    """Yields what comes, its time counted from now on by the kernel's stamps."""
    start_ns, start_s = time.time_ns(), time.monotonic()
    numbers = {bus.fileno(): number for number, bus in enumerate(buses)}
    errors = [0] * len(buses)
    while seconds is None or time.monotonic() - start_s < seconds:
        ready, _, _ = select.select(list(numbers), [], [], TICK_S)
        for descriptor in ready:
            number = numbers[descriptor]
            bus = buses[number]
            for _ in range(_AT_ONCE):
                received = bus.recv(0.0)
                if received is None:
                    break
                time_ns = max(0, received.time_ns - start_ns)
                yield Heard(time_ns, number, Frame(received.can_id, received.data, received.remote))
            if bus.counts.recv_failed > errors[number]:
                if not errors[number]:
                    print(f"echelon: {bus.url}: {bus.error}", file=sys.stderr, flush=True)
                errors[number] = bus.counts.recv_failed
                time.sleep(_PAUSE_S)
        yield Heard(max(0, time.time_ns() - start_ns), 0, None)


def _replay(folder: Path, plan: Plan, speed: float, seconds: float | None) -> Iterator[Heard]:
    """Yields the frames of a run's can.log, `speed` times as fast as they were, for so many seconds of the clock."""
    start_s, first_ns = time.monotonic(), 0
    for count, (time_ns, bus, frame) in enumerate(_read(folder, plan)):
        first_ns = first_ns if count else time_ns
        due_s = start_s + (time_ns - first_ns) * 1e-9 / speed
        while (ahead_s := due_s - time.monotonic()) > 0:
            if seconds is not None and time.monotonic() - start_s >= seconds:
                return
            time.sleep(min(ahead_s, TICK_S))
            yield Heard(round(time_ns - max(0.0, due_s - time.monotonic()) * speed * 1e9), 0, None)
        yield Heard(time_ns, bus, frame)


def _follow(folder: Path, plan: Plan, seconds: float | None) -> Iterator[Heard]:
    """Yields the frames of the can.log of a run that goes on as they are written, to its end or for so many seconds."""
    path, start_s, time_ns = folder / LOG, time.monotonic(), 0
    while not path.exists() and goes_on(folder):
        yield Heard(0, 0, None)
        time.sleep(TICK_S)
    try:
        with path.open(encoding="ascii", errors="replace") as log:
            rest, over = "", False
            while not over and (seconds is None or time.monotonic() - start_s < seconds):
                over = not goes_on(folder)  # asked before the log is read: what comes between is in it
                *lines, rest = (rest + log.read(_AT_ONCE_BYTES)).split("\n")
                for time_ns, bus, frame in of_run(read_lines(lines), plan):
                    yield Heard(time_ns, bus, frame)
                if lines:
                    over = False
                    continue
                yield Heard(time_ns, 0, None)
                time.sleep(0 if over else TICK_S)
    except OSError as error:
        raise UsageError(f"{path}: {error.strerror}") from None


def _read(folder: Path, plan: Plan) -> Iterator[tuple[int, int, Frame]]:
    try:
        yield from read_run_log(folder / LOG, plan)
    except OSError as error:
        raise UsageError(f"{folder / LOG}: {error.strerror}") from None


def _names(plan: Plan) -> tuple[str, ...]:
    return tuple(bus.name for bus in plan.can.buses)
