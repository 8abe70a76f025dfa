"""What `echelon can` shows: the torque, state and faults of every wheel, as the frames on the buses say them."""

import json
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Final

from rich.console import Console
from rich.live import Live
from rich.text import Text

from echelon.bridge.referee.referee import Referee
from echelon.cli.frame_sources import Heard, follow, listen, open_buses, read_log, replay
from echelon.cli.judging import terms_of
from echelon.plan.plan import Plan
from echelon.sim.judged_log import Terms
from echelon.sim.run_state import goes_on
from echelon.sim.view.wheel_table import CanTable

SHOW_S: Final = 0.25
"""Time between two tables in a terminal [s]"""
LINE_S: Final = 1.0
"""Time between two lines, or two objects of JSON [s]"""


def show_live(
    plan: Plan, wanted: str | None, seconds: float | None, as_json: bool, console: Console | None = None
) -> None:
    """Shows what comes on the plan's buses, until Ctrl-C or for some seconds; `wanted` is what `--can` says.

    Raises UsageError if a bus cannot be opened."""
    buses = open_buses(plan, wanted)
    table = CanTable(plan, Referee(plan, late=True), tuple(bus.url for bus in buses))
    try:
        _show(table, listen(buses, seconds), as_json, console or Console())
    finally:
        for bus in buses:
            bus.close()


def show_end(plan: Plan, folder: Path, as_json: bool) -> None:
    """Shows how a run ended, by its can.log.  Raises UsageError if that cannot be read."""
    terms = terms_of(folder, plan)
    table = CanTable(plan, Referee(plan, tolerance_ns=terms.tolerance_ns), _names(plan))
    for logged in read_log(folder, plan):
        if terms.last_ns is not None and logged[0] > terms.last_ns and not table.referee.over:
            _finish(table, terms)
            table.referee.rest()
        table.take(*logged)
    if not table.referee.over:
        _finish(table, terms)
    if as_json:
        print(json.dumps(table.data(table.time_ns), allow_nan=False))
    else:
        console = Console()
        console.print(table.render(table.time_ns, console.width))


def show_growing(
    plan: Plan, folder: Path, seconds: float | None, as_json: bool, console: Console | None = None
) -> None:
    """Shows a run that goes on, by its can.log, until the run ends, until Ctrl-C, or for some seconds.

    The log is better than the bus here: it has run times, while a listener knows only when frames reach it.  Raises UsageError
    if the log cannot be read."""
    table = CanTable(plan, Referee(plan, tolerance_ns=terms_of(folder, plan).tolerance_ns), _names(plan))

    def heard() -> Iterator[Heard]:
        yield from follow(folder, plan, seconds)
        if not goes_on(folder):
            _finish(table, terms_of(folder, plan))

    _show(table, heard(), as_json, console or Console())


def show_again(plan: Plan, folder: Path, speed: float, seconds: float | None, as_json: bool) -> None:
    """Shows a run's can.log `speed` times as fast as the run was, to its end, until Ctrl-C, or for some seconds.

    Raises UsageError if the log cannot be read."""
    table = CanTable(plan, Referee(plan), _names(plan))
    _show(table, replay(folder, plan, speed, seconds), as_json, Console())


def _show(table: CanTable, heard: Iterator[Heard], as_json: bool, console: Console) -> None:
    """Shows frames as they are heard, until there are no more or until Ctrl-C."""
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


def _finish(table: CanTable, terms: Terms) -> None:
    """Ends the judgement of a run that is over: at its planned end if the log must reach it, else at the last frame."""
    end_ns = max(table.time_ns, table.plan.duration_ns) if terms.whole else table.time_ns
    table.referee.finish(end_ns, cut=not terms.whole)


def _names(plan: Plan) -> tuple[str, ...]:
    return tuple(bus.name for bus in plan.can.buses)


class _Shown:
    """What is shown: in a terminal a live table, otherwise a line (or an object of JSON) every second and at the end."""

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
        """Shows the state at a run time if enough real time has passed since it was last shown."""
        now_s = time.monotonic()
        if now_s < self._next_s:
            return
        self._next_s = max(self._next_s + (LINE_S if self._live is None else SHOW_S), now_s)
        self._show(time_ns)
        if self._live is not None:  # on a slow terminal a table may take long: most of the time is left for frames
            self._next_s = max(self._next_s, now_s + 4 * (time.monotonic() - now_s))

    def close(self, time_ns: int) -> None:
        """Shows the state at the end, which stays on the screen."""
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
