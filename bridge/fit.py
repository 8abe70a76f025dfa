"""Whether a plan's frames fit their buses, and if not, how they would.  Pure."""

from collections.abc import Sequence

from echelon.plan import Plan


def describe_fit(plan: Plan) -> Sequence[str]:
    """Returns one line per bus and one per way to make it fit."""
    return [f"{bus.name}" for bus in plan.can.buses]
