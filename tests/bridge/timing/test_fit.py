"""The fit that `echelon validate` reports, compared with the frames of a run."""

import pytest

from echelon.bridge.protocols.registry import shared_cyclic
from echelon.bridge.roles.commander import Commander
from echelon.bridge.timing.fit import bus_fit, robot_streams
from echelon.sim.engines.in_process import Engine
from support.runs import plan_of

SECONDS = 2


@pytest.mark.slow
@pytest.mark.parametrize(("protocol", "robots_on_bus"), [("native", 9), ("odrive", 3), ("cia402", 3)])
def test_cyclic_identifiers_come_as_often_and_wait_no_longer_than_the_fit_says(
    protocol: str, robots_on_bus: int
) -> None:
    three_buses = [
        "can.buses={can0={}, can1={}, can2={}}",
        "formation.groups.g2.robot.bus=can1",
        "formation.groups.g3.robot.bus=can2",
    ]
    overrides = [f"robot.drive.protocol={protocol}", "can.path=closed", f"duration={SECONDS}", "claims=[]"]
    overrides.append(f"can.bitrate={1_000_000 if protocol == 'odrive' else 500_000}")
    plan = plan_of("lab", *overrides, *([] if robots_on_bus == 9 else three_buses))
    engine = Engine(plan)
    commander = engine.roles[plan.bridge.index]
    assert isinstance(commander, Commander)
    traffic, fit = commander.buses[0].traffic, bus_fit(plan, 0)
    before: dict[int, int] = {}
    for time_ns in engine.instants():
        if time_ns == 0:  # the frames of the bring-up are not cyclic
            before = {can_id: row.delivered for can_id, row in traffic.items()}
            for row in traffic.values():
                row.latency_max_ns = 0
    assert (fit.robots, fit.fits) == (robots_on_bus, True)
    streams = [stream for robot in range(robots_on_bus) for stream in robot_streams(plan, robot)]
    periods = {stream.can_id: stream.period_ns for stream in streams}
    periods |= {can_id: period_ns for bus, can_id, period_ns in shared_cyclic(plan) if bus == 0}
    assert periods.keys() == fit.responses_ns.keys()
    for can_id, bound_ns in fit.responses_ns.items():
        row, expected = traffic[can_id], plan.duration_ns // periods[can_id]
        assert abs(row.delivered - before[can_id] - expected) <= 1
        assert bound_ns is not None
        assert 0 < row.latency_max_ns <= bound_ns
