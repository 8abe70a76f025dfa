"""All warnings about a plan: what is allowed, but probably not intended.  `echelon validate` prints them, one line each."""

from math import degrees, pi, radians

from echelon.plan.plan import Plan
from echelon.sim.forecast.links import link_warnings
from echelon.sim.forecast.motion import motion_warnings
from echelon.sim.forecast.sampling import sampling_warnings
from echelon.sim.forecast.verdict import verdict_warnings


def warnings(plan: Plan) -> tuple[str, ...]:
    """Returns all warnings about a plan, one line each; empty if there are none."""
    return (
        *_heading_warnings(plan),
        *verdict_warnings(plan),
        *link_warnings(plan),
        *sampling_warnings(plan),
        *motion_warnings(plan),
    )


def _heading_warnings(plan: Plan) -> list[str]:
    """Returns a line if headings are more than a whole turn: they are probably in degrees instead of radians."""
    turned = [robot for robot in plan.robots if abs(robot.heading) > 2 * pi]
    if not turned:
        return []
    first = turned[0]
    more = f" and {len(turned) - 1} more" if len(turned) > 1 else ""
    return [
        f"heading = {first.heading:g} ({first.name}{more}): is in radians, and {abs(degrees(first.heading)) / 360:.3g} turns; "
        f"if degrees were meant, write {radians(first.heading):.5g}"
    ]
