"""The figures of `echelon analyse`: delays that layers bear, eigenvalues of blocks, delays against time scales.

Layers have their own colour and mark, channels their own face and dashes."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from echelon.sim.report.drawing import CENTROID, DASHES, GROUPS, INTER, QUIET, Look, Picture, short
from echelon.sim.results.analysis import AnalysisResult
from echelon.sim.results.links_analysis import LinksResult, PolicyResult, ScaledDelays

LAYERS: Final = {
    "intra": Look(GROUPS[2], DASHES[0], "o"),
    "middle": Look(GROUPS[3], DASHES[1], "s"),
    "inter": Look(INTER, DASHES[2], "^"),
    "centroid": Look(CENTROID, DASHES[3], "D"),
    "robot": Look(GROUPS[0], DASHES[4], "v"),
}
POLICIES: Final = ("hold", "extrapolate", "predict", "zero")
"""Policies, each with its own colour and mark"""
DOWN: Final = ("command", "reference", "torque")
"""Channels towards the robots: their marks are hollow"""
WIDTH: Final = 7.2
"""Width of a figure [inches]"""


def analysis_figures(found: AnalysisResult, scaled: Sequence[ScaledDelays], command: str) -> dict[str, Picture]:
    """Returns the figures by name; `command` made them, and is written below them."""
    pictures = {"eigenvalues": _eigenvalues(found, command)}
    classes = [one for one in found.table if one.kind == "class" and one.delay.seconds]
    if classes:
        pictures["delays"] = _delays(found, classes, command)
    effects = [one for one in found.effects if one.delay is not None]
    if effects:
        pictures["policies"] = _policies(effects, command)
    if any(each.rows for each in scaled):
        pictures["delays-epsilon"] = _against_epsilon(scaled, command)
    return pictures


def _delays(found: AnalysisResult, classes: Sequence[LinksResult], command: str) -> Picture:
    """Draws the largest delay of each link class, and what its layer's block bears alone in continuous time."""

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_xscale("log")
        for at, one in enumerate(classes):
            look, ms = LAYERS[one.layer or "robot"], 1e3 * (one.delay.seconds or 0.0)
            axes.plot([ms], [at], look.mark, ms=8, mec=look.colour, mew=1.6, mfc=_face(one, look), zorder=3)
            axes.annotate(f"{ms:.4g} ms", (ms, at), (8, 0), textcoords="offset points", va="center", fontsize=8)
            if (runs := one.delay_by_runs) is not None and runs.value is not None:
                ends = [1e3 * (end if end else runs.value) for end in (runs.low, runs.high)]
                axes.plot(ends, [at + 0.2] * 2, color=look.colour, lw=1.4, zorder=2)
                axes.plot([1e3 * runs.value], [at + 0.2], "x", ms=6, color=look.colour, zorder=3)
            margins = [block.delay_margin for block in found.blocks if block.layer == one.layer and block.delay_margin]
            if margins:
                axes.plot([1e3 * min(margins)] * 2, [at - 0.3, at + 0.3], color=QUIET, lw=1.2, zorder=2)
        axes.set_yticks(range(len(classes)), labels=[one.name for one in classes])
        axes.set_ylim(len(classes) - 0.5, -0.5)
        axes.margins(x=0.25)
        _plain(axes.xaxis)
        axes.set_xlabel("largest additional delay of all links of the class [ms]")
        estimated = "; ×: by runs, as the links are" if any(one.delay_by_runs for one in classes) else ""
        axes.set_title(f"Delay that each layer bears (line: its block alone, continuous time{estimated})")
        _caption(figure, command)

    return Picture(WIDTH, 0.42 * len(classes) + 1.5, draw)


def _policies(effects: Sequence[PolicyResult], command: str) -> Picture:
    """Draws the largest delay and loss of each channel with each policy; an arrow: longer ones are not tried."""

    def draw(figure: Figure) -> None:
        delays, losses = figure.subplots(1, 2, sharey=True)
        for at, one in enumerate(effects):
            look, ms = Look.of_run(POLICIES.index(one.policy)), 1e3 * (one.delay or 0.0)
            more = ">" if one.delay_ends == "limit" else look.mark
            delays.plot([ms], [at], more, ms=8, color=look.colour)
            delays.annotate(f"{ms:.4g} ms", (ms, at), (7, 0), textcoords="offset points", va="center", fontsize=8)
            if one.loss.share is not None:
                losses.plot([100 * one.loss.share], [at], ">" if one.loss.ends == "limit" else look.mark, ms=8,
                            color=look.colour)  # fmt: skip
        if all(one.delay for one in effects):
            delays.set_xscale("log")
            _plain(delays.xaxis)
        delays.margins(x=0.25)
        delays.set_yticks(
            range(len(effects)), labels=[f"{one.channel.replace('_', ' ')}: {one.policy}" for one in effects]
        )
        delays.set_ylim(len(effects) - 0.5, -0.5)
        delays.set_xlabel("largest delay of the channel [ms]")
        losses.set_xlabel("largest loss in the mean square [%]")
        figure.suptitle("What policies buy (arrow: this and more)", fontsize=10)
        _caption(figure, command)

    return Picture(WIDTH, 0.34 * len(effects) + 1.6, draw)


def _eigenvalues(found: AnalysisResult, command: str) -> Picture:
    """Draws the eigenvalues of the sampled run, and the unit circle: the whole of it, and where the eigenvalues are."""
    points = [
        (LAYERS[block.layer], block, np.array([complex(*each) for each in block.eigenvalues])) for block in found.blocks
    ]
    near = np.concatenate([values for _, _, values in points if len(values)] or [np.array([1.0 + 0j])])
    reach = max(float((1 - near.real).max()), 2.0 * float(np.abs(near.imag).max()), 1e-6)

    def draw(figure: Figure) -> None:
        whole, close = figure.subplots(1, 2)
        angle = np.linspace(-np.pi, np.pi, 2001)
        for axes in (whole, close):
            axes.plot(np.cos(angle), np.sin(angle), color=QUIET, lw=1.0)
            for look, _, values in points:
                axes.plot(values.real, values.imag, look.mark, color=look.colour, ms=5, mfc="none", mew=1.3)
            axes.set_xlabel("Re z")
            axes.set_aspect("equal")
        whole.set(xlim=(-1.15, 1.15), ylim=(-1.15, 1.15), ylabel="Im z", title="Eigenvalues and unit circle")
        _zoom(close, reach)
        layers = dict.fromkeys(block.layer for _, block, _ in points)
        for layer in layers:
            close.plot([], [], LAYERS[layer].mark, color=LAYERS[layer].colour, mfc="none", mew=1.3, label=layer)
        figure.legend(loc="outside upper right", ncols=len(layers))
        _caption(figure, f"over {1e3 * found.hyperperiod:g} ms; {command}")

    return Picture(WIDTH, 4.2, draw)


def _zoom(axes: Axes, reach: float) -> None:
    axes.set(xlim=(1 - 1.2 * reach, 1 + 0.3 * reach), ylim=(-0.75 * reach, 0.75 * reach), title="Near 1")
    axes.locator_params(nbins=4)


def _against_epsilon(scaled: Sequence[ScaledDelays], command: str) -> Picture:
    """Draws what link classes bear when all ε are multiplied by a number."""
    names = dict.fromkeys(one.name for each in scaled for one in each.rows)

    def draw(figure: Figure) -> None:
        axes = figure.subplots()
        axes.set_xscale("log")
        axes.set_yscale("log")
        for name in names:
            rows = [(each.by, one) for each in scaled for one in each.rows if one.name == name and one.delay.seconds]
            if not rows:
                continue
            look = LAYERS[rows[0][1].layer or "robot"]
            down = rows[0][1].channel in DOWN
            values = [1e3 * (one.delay.seconds or 0.0) for _, one in rows]
            face = _face(rows[0][1], look)
            axes.plot([by for by, _ in rows], values, color=look.colour, ls=DASHES[1] if down else "-", marker=look.mark,
                      ms=4 if down else 7, mfc=face, mec=look.colour, label=name, lw=1.0 if down else 2.4)  # fmt: skip
        by, alone = zip(*((each.by, 1e3 * each.alone) for each in scaled), strict=True)
        axes.plot(by, alone, color=QUIET, lw=1.0, ls=DASHES[3], label="fastest block alone, continuous time")
        _plain(axes.xaxis)
        _plain(axes.yaxis)
        axes.set_xlabel("all ε multiplied by")
        axes.set_ylabel("largest additional delay [ms]")
        axes.set_title("Delay that each link class bears against the time scales")
        figure.legend(loc="outside right upper", handlelength=3)
        _caption(figure, command)

    return Picture(WIDTH, 3.8, draw)


def _plain(axis: Axis) -> None:
    """Gives a logarithmic axis ticks with plain numbers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter(FuncFormatter(lambda value, _: short(value)))
    axis.set_minor_formatter(NullFormatter())


def _face(one: LinksResult, look: Look) -> str:
    return "white" if one.channel in DOWN else look.colour


def _caption(figure: Figure, text: str) -> None:
    figure.supxlabel(text, fontsize=7, color=QUIET, x=0.01, ha="left")
