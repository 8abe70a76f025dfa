"""Scenarios that between them have all that the batch engine can do: laws, plants, limits, timings, links, policies, clocks."""

from pathlib import Path

TIMED = Path(__file__).with_name("delays_by_time.csv")
"""Delays that rise and fall within 0.1 s, and a message that is lost"""
LATE = 'links=[{source="**", receiver="**", loss=0.1, delay={min=0.01, max=0.05}}]'
SOON = 'links=[{source="**", receiver="**", loss=0.05, delay={min=0.0, max=0.015}}]'
STOPS = (
    'links=[{source="**", receiver="**", loss=0.3, delay={min=0.0, max=0.05}, policy="hold_then_stop", timeout=0.06}]'
)
GAINS = (
    'law.gains=[{block="intra", k1=[[0.3,0.05,0,0],[0,0.3,0,0],[0,0,0.3,0.1],[0,0,0,0.3]], k2=0.5}, '
    '{block="centroid", k1=[[0.3,0.1],[0,0.25]], k2=0.6}]'
)


def brought(policy: str) -> str:
    """Returns links whose states are late, lossy and brought to the present, and whose commands are late."""
    late = "loss=0.1, delay={min=0.003, max=0.06}"
    return (
        f'links=[{{channel="state", {late}, policy="{policy}"}}, {{channel="group_state", {late}, policy="{policy}"}}, '
        '{channel="command", loss=0.05, delay={min=0.012, max=0.03}}, {channel="reference", delay={min=0.002, max=0.03}}]'
    )


CASES: dict[str, tuple[str, ...]] = {
    "lab": ("lab", "duration=40"),
    "integral": ("integral", "duration=6"),
    "sliding": ("sliding", "duration=6"),
    "crossing": ("crossing", "duration=8"),
    "unequal": ("unequal", "duration=8"),
    "three_levels": ("three_levels", "duration=4"),
    "multi": ("multi", "duration=2"),
    "paper": ("paper", "duration=0.3"),
    "paper, robots avoid each other": ("paper", "duration=0.3", "avoidance.enabled=true"),
    "late and lossy": ("lab", "duration=20", LATE),
    "late, lossy, coupled": ("lab", "duration=4", LATE, "law.coupling=[{value=0.1}]"),
    "late, lossy, three levels": ("three_levels", "duration=4", SOON, "avoidance.enabled=true"),
    "stops on old messages": ("unequal", "duration=4", STOPS),
    "only one group is late": ("multi", "duration=1", 'links=[{source="g1/*", receiver="**", loss=0.2, delay=0.003}]'),
    "matrices as gains": ("lab", "duration=4", GAINS),
    "matrices as gains, integral": ("integral", "duration=4", GAINS),
    "limits act": ("lab", "duration=4", "robot.torque_limit=0.1", "robot.torque_rate_limit=5.0"),
    "event-driven: half a period late": ("lab", "duration=4", 'links=[{source="**", receiver="**", delay=0.003}]'),
    "event-driven: more than a period late": (
        "unequal", "duration=4", 'links=[{source="**", receiver="**", loss=0.1, delay={min=0.002, max=0.024}}]',
    ),
    "event-driven: only one group is late": (
        "multi", "duration=1", 'links=[{source="g1/*", receiver="**", loss=0.2, delay=0.0007}]', "law.coupling=[]",
    ),
    "event-driven: old commands are not used": (
        "unequal", "duration=4",
        'links=[{source="**", receiver="**", channel="command", loss=0.3, delay={min=0.0, max=0.03}, '
        'policy="hold_then_stop", timeout=0.021}]',
    ),
    "event-driven in part": (
        "three_levels", "duration=3", "formation.period=0.04", "formation.groups.west.period=0.02", SOON,
        'formation.groups.west.timing="time_driven"', 'formation.groups.east.robot.timing="time_driven"',
    ),
    "gamma, in bursts, for all receivers at once": (
        "lab", "duration=4",
        'links=[{source="**", receiver="**", loss={mean=0.1, burst=3.0}, loss_of="message", '
        'delay={kind="gamma", min=0.001, shape=2.0, scale=0.004}}]',
    ),
    "normal, correlated, in order, twice": (
        "unequal", "duration=4",
        'links=[{source="**", receiver="**", duplicates=0.3, order="fifo", loss=0.05, '
        'delay={kind="normal", mean=0.01, std=0.004, correlation=0.9}}]',
    ),
    "blackouts": (
        "lab", "duration=4", 'links=[{source="g1/*", receiver="**", delay=0.004, policy="hold_then_stop", timeout=0.05}]',
        'events=[{kind="blackout", at=1.0, duration=0.3, source="g1/**"}, '
        '{kind="cut_off", at=2.0, duration=0.2, member="g2/r4"}]',
    ),
    "zeros, and clocks that are wrong": (
        "lab", "duration=4",
        'links=[{source="**", receiver="**", channel="command", loss=0.3, delay={min=0.0, max=0.03}, policy="zero"}]',
        'formation.groups.g1.clock={offset=0.004, drift=0.001}',
    ),
    "time-driven": ("lab", "duration=4", LATE, 'timing="time_driven"'),
    "the reference of now": ("lab", "duration=4", LATE, 'law.reference="now"'),
    "late states extrapolated": ("lab", "duration=6", "law.coupling=[{value=0.1}]", brought("extrapolate")),
    "late states predicted": ("lab", "duration=6", brought("predict"), 'formation.groups.g2.robot.timing="time_driven"'),
    "predicted in three levels, groups with periods of their own": (
        "three_levels", "duration=4", "formation.period=0.04", "formation.groups.west.period=0.02", "avoidance.enabled=true",
        brought("predict"), 'formation.groups.west.timing="time_driven"',
    ),
    "extrapolated in three levels, groups with periods of their own": (
        "three_levels", "duration=4", "formation.period=0.04", "formation.groups.west.period=0.02", "avoidance.enabled=true",
        brought("extrapolate"),
    ),
    "predicted by clocks that are wrong, and held for long": (
        "lab", "duration=4", brought("predict"), "robot.clock={offset=0.004, drift=0.001}",
        "formation.groups.g1.clock={offset=-0.03, drift=0.002}", "formation.clock={offset=0.001, drift=-0.002}",
        'events=[{kind="blackout", at=1.0, duration=1.5, source="g1/**"}]',
    ),
    "predicted two seconds ahead": ("lab", "duration=6", 'links=[{channel="state", delay=2.0, policy="predict"}]'),
    "heavy tails": (
        "lab", "duration=4",
        'links=[{source="**", receiver="**", delay={kind="pareto", min=0.004, shape=0.8}}]',
    ),
    "delays and losses as measured, in order of sending": (
        "lab", "duration=4", 'links=[{source="**", receiver="**", delay={kind="trace", file="wifi.csv"}}]',
    ),
    "delays as measured, by time": (
        "lab", "duration=4", f'links=[{{channel="state", delay={{kind="trace", file="{TIMED}", by="time"}}}}]',
    ),
    "rigid body": ("unequal", "duration=3", 'robot.model="rigid_body"'),
    "periods of groups": (
        "three_levels", "duration=3", "formation.period=0.04", "formation.groups.west.period=0.02", SOON,
    ),
    "robots meet": ("lab", "duration=6", "formation.groups.g1.robots.r1.start=[0.3,1.2]", "avoidance.enabled=false"),
    "diverges": ("paper", "duration=2", 'links=[{source="**", receiver="**", delay=0.02}]'),
}  # fmt: skip
