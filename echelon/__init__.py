"""echelon: groups of wheeled robots in formation, every robot its own process, wheel torques on a CAN bus.

For notebooks and scripts:

    import echelon

    run = echelon.run("lab", {"law.lead": 0.0}, engine="inprocess")
    run.verdict                             whether the run holds, and the reasons if not
    run.blocks["inter"]["norm"]             |e| of a block over time, a numpy array
    run.figure("errors")                    a figure of the report

    echelon.load("lab")                     a scenario and the plan made from it
    echelon.open_run("runs/demo")           a run from its folder
    echelon.open_run("runs/real").latencies()   of a run on a wall clock: how long messages took
    echelon.Simulation("lab")               a run step by step
    echelon.replay("runs/demo", {…})        its messages fed to roles with other values: where their outputs differ
    echelon.diff("runs/a", "runs/b")        where two runs part
    echelon.analyse("lab").table            what each layer bears of delay and loss on each channel, without a run
    echelon.sweep("lab", vary={"law.lead": "0:1:0.1"}, seeds=20)    many runs, with values that vary
    echelon.open_sweep("runs/many")         a sweep from its folder

To write parts of your own, derive from `Law`, `Plant`, `Trajectory` or `DriveProtocol` (docs/add-a-law.md,
docs/add-a-protocol.md).
The command line is `echelon --help`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from echelon.agents.plant import Plant
    from echelon.bridge.protocols.protocol import DriveProtocol
    from echelon.controller.laws import Law
    from echelon.controller.trajectory import Trajectory
    from echelon.errors import UserError
    from echelon.sim.finished_run import Run
    from echelon.sim.notebook import Loaded, analyse, diff, load, open_run, open_sweep, replay, run, sweep
    from echelon.sim.replay.comparison import ChannelComparison, Difference
    from echelon.sim.replay.difference import RunDifference
    from echelon.sim.replay.replay import Replay
    from echelon.sim.results.analysis import AnalysisResult
    from echelon.sim.results.latencies import Latencies, LinkLatency
    from echelon.sim.simulation import Simulation
    from echelon.sim.sweep.study import Sweep

__version__ = "0.1.0"
__all__ = [
    "AnalysisResult",
    "ChannelComparison",
    "Difference",
    "DriveProtocol",
    "Latencies",
    "Law",
    "LinkLatency",
    "Loaded",
    "Plant",
    "Replay",
    "Run",
    "RunDifference",
    "Simulation",
    "Sweep",
    "Trajectory",
    "UserError",
    "__version__",
    "analyse",
    "diff",
    "load",
    "open_run",
    "open_sweep",
    "replay",
    "run",
    "sweep",
]


def __getattr__(name: str) -> Any:
    """Imports a public name when it is first used: most processes and commands need only a few of them."""
    found: dict[str, Any] = {}
    match name:
        case "Loaded" | "analyse" | "diff" | "load" | "open_run" | "open_sweep" | "replay" | "run" | "sweep":
            from echelon.sim.notebook import Loaded, analyse, diff, load, open_run, open_sweep, replay, run, sweep

            found = {"Loaded": Loaded, "diff": diff, "load": load, "open_run": open_run, "open_sweep": open_sweep}
            found |= {"analyse": analyse, "replay": replay, "run": run, "sweep": sweep}
        case "Run":
            from echelon.sim.finished_run import Run

            found = {"Run": Run}
        case "AnalysisResult":
            from echelon.sim.results.analysis import AnalysisResult

            found = {"AnalysisResult": AnalysisResult}
        case "ChannelComparison" | "Difference":
            from echelon.sim.replay.comparison import ChannelComparison, Difference

            found = {"ChannelComparison": ChannelComparison, "Difference": Difference}
        case "Replay":
            from echelon.sim.replay.replay import Replay

            found = {"Replay": Replay}
        case "Latencies" | "LinkLatency":
            from echelon.sim.results.latencies import Latencies, LinkLatency

            found = {"Latencies": Latencies, "LinkLatency": LinkLatency}
        case "RunDifference":
            from echelon.sim.replay.difference import RunDifference

            found = {"RunDifference": RunDifference}
        case "Simulation":
            from echelon.sim.simulation import Simulation

            found = {"Simulation": Simulation}
        case "Sweep":
            from echelon.sim.sweep.study import Sweep

            found = {"Sweep": Sweep}
        case "Plant":
            from echelon.agents.plant import Plant

            found = {"Plant": Plant}
        case "Law":
            from echelon.controller.laws import Law

            found = {"Law": Law}
        case "Trajectory":
            from echelon.controller.trajectory import Trajectory

            found = {"Trajectory": Trajectory}
        case "DriveProtocol":
            from echelon.bridge.protocols.protocol import DriveProtocol

            found = {"DriveProtocol": DriveProtocol}
        case "UserError":
            from echelon.errors import UserError

            found = {"UserError": UserError}
        case _:
            raise AttributeError(f"module 'echelon' has no attribute {name!r}")
    globals().update(found)
    return found[name]


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
