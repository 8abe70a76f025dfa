"""Opens recordings for `echelon replay` and `echelon diff`."""

import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from hashlib import sha256
from importlib.metadata import version
from pathlib import Path
from typing import Final

from echelon.errors import PartRunError, UsageError, UserError
from echelon.plan.plan import Plan
from echelon.runtime.arrivals import FILE as ARRIVALS
from echelon.shipped import EFFECTIVE, scenario_path
from echelon.sim.kept_parts import HASH_OF
from echelon.sim.out_folder import RECORDING
from echelon.sim.parts.foreign_parts import stalled_in, unstalled
from echelon.sim.parts.loading import load, parse
from echelon.sim.parts.time_limit import TookTooLong
from echelon.sim.recording.arrivals import read_arrivals
from echelon.sim.recording.mcap_reader import read_metadata, read_scenario
from echelon.sim.recording.messages import read_messages
from echelon.sim.replay.difference import RunDifference, difference
from echelon.sim.replay.replay import Replay, Replaying, chosen
from echelon.sim.report.differences import differing
from echelon.sim.results.recorded import Recorded

PATIENCE_S: Final = 30.0
"""How long a part that is not built in may take for one instant of a replay [s]"""


def open_recorded(folder: Path) -> Recorded:
    """Opens the messages that a run recorded, also of a run that was killed.  Raises UserError."""
    if not folder.is_dir():
        raise UsageError(f"{folder}: is not the folder of a run")
    path = folder / RECORDING
    try:
        _, plan = parse(read_scenario(path), str(path), folder=folder, trial=False)
        recorded = read_messages(path, plan)
        if recorded.by_arrival and (folder / ARRIVALS).exists():
            return replace(recorded, arrivals=read_arrivals(folder / ARRIVALS, plan))
        return recorded
    except OSError as error:
        raise UserError(f"{error.filename}: {error.strerror}") from None
    except (UserError, ValueError) as error:  # which begins with the file
        raise UserError(f"{error}{_by_another_version(path)}") from None


def _by_another_version(path: Path) -> str:
    """Returns words to follow an error about a recording, if another version wrote it; otherwise ""."""
    try:
        then = read_metadata(path).get("echelon")
    except (OSError, ValueError):
        return ""
    return "" if then == version("echelon") else f" (recorded by echelon {then}, this is {version('echelon')})"


def replay_run(
    folder: Path, scenario: str | None, overrides: Sequence[str], only: Sequence[str], tolerance: float
) -> Replay:
    """Replays a run with the roles of its own scenario, or of `scenario`, with `overrides`.

    Raises UserError for input that is wrong, and PartRunError if a part that is not built in fails."""
    recorded = open_recorded(folder)
    path = folder / EFFECTIVE if scenario is None else scenario_path(scenario)
    _, plan = load(path, overrides)
    return replay(recorded, plan, folder, only, tolerance)


def replay(recorded: Recorded, plan: Plan, folder: Path, only: Sequence[str], tolerance: float) -> Replay:
    """Replays a run with the roles of a plan.  Raises UserError and PartRunError."""
    check_tolerance(tolerance)
    replaying = Replaying(recorded, plan, chosen(plan, only), tolerance)
    try:
        for _ in unstalled(plan, replaying.instants(), PATIENCE_S):
            pass
    except TookTooLong as error:
        raise PartRunError(f"stalled for {PATIENCE_S:.0f} s: everyone waits for {stalled_in(plan, error)}") from None
    return replaying.result(str(folder), tuple(_remarks(recorded, folder)))


def diff_runs(first: Path, second: Path, tolerance: float) -> RunDifference:
    """Compares two runs from their folders.  Raises UserError."""
    check_tolerance(tolerance)
    one, other = map(open_recorded, (first, second))
    rows = differing((one.scenario, other.scenario), (_facts(one.metadata), _facts(other.metadata)))
    return difference(one, other, (str(first), str(second)), {key: (a, b) for key, a, b in rows}, tolerance)


def check_tolerance(tolerance: float) -> None:
    """Raises UsageError for a tolerance that is negative or not finite."""
    if not 0 <= tolerance < float("inf"):
        raise UsageError(f"tolerance {tolerance:g}: must be 0 or more, and finite")


def _facts(metadata: Mapping[str, str]) -> dict[str, str]:
    """Returns how a run was made."""
    return {key: metadata.get(key, "") for key in ("engine", "clock", "echelon", "python", "numpy")}


def _remarks(recorded: Recorded, folder: Path) -> Iterator[str]:
    """Yields what of the run itself limits a replay."""
    today = {"echelon": version("echelon"), "python": platform.python_version(), "numpy": version("numpy")}
    then = recorded.metadata
    other = [f"{key} {then[key]}, now {now}" for key, now in today.items() if then.get(key, now) != now]
    if other:
        yield f"recorded with {'; '.join(other)}: last digits may differ, which --tolerance allows for"
    scenario = folder / EFFECTIVE
    if not scenario.is_file() or scenario.read_bytes() != recorded.scenario.encode():
        yield f"{scenario} is not the scenario that the run used"
    for key, digest in then.items():
        if key.startswith(HASH_OF):
            path = folder / Path(key.removeprefix(HASH_OF)).name
            if not path.is_file() or sha256(path.read_bytes()).hexdigest() != digest:
                yield f"{path} is not the file that the run used"
    if recorded.arrivals is not None and recorded.arrivals.damaged:
        yield f"{folder / ARRIVALS}: is damaged; what stands behind the damage is left out"
    if recorded.by_arrival and recorded.arrivals is None:
        yield (
            "on a wall clock: when each message arrived is not recorded, so the replay uses it at its nominal instant; outputs "
            "differ by what moves in the meantime, which --tolerance allows for"
        )
