"""The display of a run in progress: a live table with a progress bar, or plain lines if there is no terminal.

A thread of its own writes: a terminal that is stopped (Ctrl-S), or a pipe that nobody reads, must not stop who watches a run.
"""

import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from math import isfinite
from queue import SimpleQueue
from typing import Any, TextIO

import numpy as np
from rich.console import Console, Group
from rich.live import Live
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from echelon.controller.transformation import Transformation
from echelon.plan.plan import Plan
from echelon.runtime.link import LinkCounts
from echelon.sim.processes.outcome import Progress
from echelon.sim.results.desired import Desired

PLAIN_S = 2.0
"""Time between two plain lines [s]"""
CLOSE_S = 10.0
"""How long the last lines of a run may take to be written [s]"""
FAULTS = 3
"""How many faults of drives are named; further ones are shown as …"""


class Display:
    """Shows the progress of a run on a stream, by default standard error; nothing but notes if `quiet`.

    `show` may be called at any rate."""

    def __init__(self, plan: Plan, stream: TextIO = sys.stderr, quiet: bool = False) -> None:
        self._plan = plan
        self._quiet = quiet
        self._stream = stream
        self._cbt = Transformation(plan)
        self._trajectory = Desired(plan)
        self._console = Console(file=stream, stderr=stream is sys.stderr)
        self._live: Live | None = None
        self._said_s = time.monotonic()
        self._note = ""
        self._todo: SimpleQueue[Callable[[], object] | None] = SimpleQueue()
        self._free = threading.Event()
        """Set while no table waits to be written"""
        self._free.set()
        self._writer: threading.Thread | None = threading.Thread(target=self._write, name="display", daemon=True)
        self._writer.start()
        if not quiet and self._console.is_terminal:
            self._live = Live(console=self._console, auto_refresh=False, transient=True)
            self._todo.put(self._live.start)

    def show(self, progress: Progress) -> None:
        """Shows the present state of the run; while the last table is not written yet, only notes."""
        note = progress.note or progress.bridge.note or progress.drives.note
        if note and note != self._note:
            self.say(note)
        self._note = note or self._note
        if self._quiet or (self._live is not None and not self._free.is_set()):
            return
        if self._live is None:
            if time.monotonic() - self._said_s < PLAIN_S:
                return
            self._said_s = time.monotonic()
        self._free.clear()
        self._todo.put(partial(self._draw, replace(progress, links=dict(progress.links))))

    def say(self, text: str) -> None:
        """Prints a line that stays."""
        if self._writer is None:
            self._print(text)
        else:
            self._todo.put(partial(self._print, text))

    def close(self) -> None:
        """Removes the table, and waits up to `CLOSE_S` until all is written.  A second call does nothing."""
        if self._writer is None:
            return
        if self._live is not None:
            self._todo.put(self._end_table)
        self._todo.put(None)
        self._writer.join(CLOSE_S)
        self._writer = None

    def _write(self) -> None:
        while (work := self._todo.get()) is not None:
            try:
                work()
            except OSError:
                pass  # the terminal is gone

    def _draw(self, progress: Progress) -> None:
        try:
            if self._live is not None:
                self._live.update(self._table(progress), refresh=True)
            else:
                print(self._line(progress), file=self._stream, flush=True)
        finally:
            self._free.set()

    def _end_table(self) -> None:
        if self._live is not None:
            self._live.stop()
        self._live = None

    def _print(self, text: str) -> None:
        if self._live is not None:
            self._console.print(text, markup=False, highlight=False)
        else:
            print(text, file=self._stream, flush=True)

    def errors(self, progress: Progress) -> dict[str, float]:
        """Returns the norm of each block's error [m] in the last states of the robots, by the block's name."""
        if progress.states is None:
            return {}
        z_cd = self._trajectory.at(progress.states_ns * 1e-9)
        with np.errstate(all="ignore"):
            e = (self._cbt.forward(progress.states[:, :2]) - self._cbt.desired(z_cd[0])).ravel()
            return {
                block.name: float(np.linalg.norm(e[block.offset : block.offset + block.size]))
                for block in self._plan.blocks
            }

    def _line(self, progress: Progress) -> str:
        facts = [f"{name} {value}" for name, value in self._facts(progress)]
        errors = [f"{name} {_metres(error, 3)}" for name, error in self.errors(progress).items()]
        return f"{progress.phase:>9}  {'  '.join(facts)}{'  |  ' if errors else ''}{'  '.join(errors)}"

    def _facts(self, progress: Progress) -> list[tuple[str, str]]:
        run_s, whole_s = progress.time_ns / 1e9, self._plan.duration_ns / 1e9
        wall_s = time.monotonic() - progress.started_s if progress.started_s else 0.0
        factor = f"{run_s / wall_s:.3g}" if wall_s > 0.2 else "–"
        tick = progress.time_ns // self._plan.robots[0].period_ns
        facts = [
            ("t", f"{run_s:.2f} of {whole_s:g} s"),
            ("tick", f"{tick}"),
            ("real time", f"× {factor}"),
            ("messages", f"{progress.messages}"),
        ]
        if progress.bridge.frames:
            facts.append(("CAN load", f"{100 * progress.bridge.load:.0f} %"))
        if progress.bridge.stopped:
            facts.append(("torques stopped", progress.bridge.stopped))
        if faults := progress.bridge.faults:
            facts.append(("drive faults", ", ".join(faults[:FAULTS]) + (" …" if len(faults) > FAULTS else "")))
        return facts

    def _table(self, progress: Progress) -> Any:
        table = Table(box=None, padding=(0, 2), show_header=False)
        for name, value in self._facts(progress):
            table.add_row(Text(name, style="dim"), value)
        if progress.bridge.url:
            table.add_row(Text("bus", style="dim"), progress.bridge.url)
        errors = Table(box=None, padding=(0, 2))
        errors.add_column("block", style="dim")
        errors.add_column("error", justify="right")
        for name, error in self.errors(progress).items():
            errors.add_row(name, _metres(error, 4))
        bar = ProgressBar(total=self._plan.duration_ns, completed=progress.time_ns, width=60)
        columns = Table.grid(padding=(0, 6))
        columns.add_row(table, errors)
        title = Text(f"{self._plan.name}: {progress.phase}", style="bold")
        late = any(not link.ideal for link in self._plan.links)
        return Group(title, bar, columns, *([self._links(progress)] if late else []))

    def _links(self, progress: Progress) -> Table:
        """Returns a table of links: one row for each rule with a name, and for each channel of the others, with the ages of the
        link on which they are largest."""
        groups: dict[str, list[LinkCounts]] = {}
        for link in self._plan.links:
            if counts := progress.links.get((link.receiver, link.source, link.channel)):
                groups.setdefault(link.name or link.channel.name.lower(), []).append(counts)
        table = Table(box=None, padding=(0, 1))
        table.add_column("links", style="dim")
        for head in ("sent", "lost", "in flight", "twice", "p50 [s]", "p95", "p99", "largest"):
            table.add_column(head, justify="right")
        for name, links in groups.items():
            worst = max(links, key=lambda each: (each.age_p99_ns, each.age_max_ns))
            sent, lost = sum(each.sent for each in links), sum(each.lost for each in links)
            flying, twice = sum(each.in_flight for each in links), sum(each.duplicates for each in links)
            ages_ns = worst.age_p50_ns, worst.age_p95_ns, worst.age_p99_ns, max(each.age_max_ns for each in links)
            table.add_row(name, *map(str, (sent, lost, flying, twice)), *[f"{age_ns / 1e9:.3g}" for age_ns in ages_ns])
        return table


def _metres(error: float, digits: int) -> str:
    return f"{error:.{digits}g} m" if isfinite(error) else "not finite"
