"""The bridge that a run in one process needs: chosen by its plan and its buses."""

from collections.abc import Sequence
from pathlib import Path

from echelon.bridge.roles.commander import Commander
from echelon.bridge.stations.bridge import Bridge, NoBridge
from echelon.bridge.stations.closed import ClosedBridge
from echelon.bridge.stations.mirror import MirrorBridge
from echelon.plan.plan import Plan


def open_bridge(plan: Plan, urls: Sequence[str], folder: Path, commander: Commander | None = None) -> Bridge:
    """Returns the bridge of a run in one process.

    On the closed path `commander` is the bridge's role.  The virtual drives get its frames directly; the buses only show them.
    Raises ValueError or OSError if a bus or a file cannot be opened."""
    if commander is not None:
        return ClosedBridge(plan, urls, folder, paired=False, role=commander)
    if urls:
        return MirrorBridge(plan, urls, folder)
    return NoBridge()
