"""All warnings about a plan: what is allowed, but hardly what was meant.  `echelon validate` prints them, a line each."""

from math import degrees, pi, radians

from echelon.plan.plan import Plan
from echelon.sim.forecast.links import link_warnings
from echelon.sim.forecast.motion import motion_warnings
from echelon.sim.forecast.sampling import sampling_warnings
from echelon.sim.forecast.verdict import verdict_warnings


def warnings(plan: Plan) -> tuple[str, ...]:
    """Returns a line for each thing that is hardly meant; none if there is nothing to say."""
    return (
        *_heading_warnings(plan),
        *verdict_warnings(plan),
        *link_warnings(plan),
        *sampling_warnings(plan),
        *motion_warnings(plan),
    )


def _heading_warnings(plan: Plan) -> list[str]:
    """Headings are in radians: more than a whole turn is hardly meant."""
    turned = [robot for robot in plan.robots if abs(robot.heading) > 2 * pi]
    if not turned:
        return []
    first = turned[0]
    more = f" and {len(turned) - 1} more" if len(turned) > 1 else ""
    return [
        f"heading = {first.heading:g} ({first.name}{more}): is in radians, and {abs(degrees(first.heading)) / 360:.3g} turns; "
        f"if degrees were meant, write {radians(first.heading):.5g}"
    ]
