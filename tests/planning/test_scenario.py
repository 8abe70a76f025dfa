import hashlib
import math
import tomllib
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from echelon import shipped
from echelon.plan.plan import Plan
from echelon.planning.loading import ScenarioError, effective_toml
from echelon.plugins import PartError
from echelon.scenario.part_fields import PartContext
from echelon.scenario.tables import RobotTable, Scenario, Shape
from echelon.scenario.values import Table
from echelon.sim.parts.loading import REGISTRY, load, parse

SCENARIOS = sorted(shipped.FOLDER.glob("*.toml"))


def digest(plan: Plan) -> str:
    """Returns a digest of everything in a plan."""

    def flat(value: Any) -> Any:
        if is_dataclass(value):
            return type(value).__name__, [flat(getattr(value, field.name)) for field in fields(value)]
        if isinstance(value, np.ndarray):
            return value.shape, value.tobytes()
        if isinstance(value, (tuple, list)):
            return [flat(item) for item in value]
        if isinstance(value, dict):
            return [(key, flat(item)) for key, item in value.items()]
        return value

    return hashlib.sha256(repr(flat(plan)).encode()).hexdigest()


def check_round_trip(scenario: Scenario, plan: Plan) -> None:
    """Checks that the effective scenario, read again, gives the same scenario, the same plan and the same text."""
    text = effective_toml(scenario)
    again, plan_again = parse(text, "effective.toml")
    assert again == scenario
    assert digest(plan_again) == digest(plan)
    assert effective_toml(again) == text


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_the_effective_scenario_reads_back(path):
    check_round_trip(*load(path))


LINES = st.one_of(
    st.floats(0, 10).map(lambda x: f"links.0.delay={x!r}"),
    st.floats(0, 1).map(lambda x: f"links.1.loss={x!r}"),
    st.just("links.0.delay={min=0.001,max=0.002}"),
    st.sampled_from(["links.2.source=g1/*", "links.0.receiver=coordinator", "links.0.channel=state"]),
    st.integers(0, 2**63 - 1).map(lambda x: f"seed={x}"),
    st.text().map(lambda x: f"description={x}"),
    st.floats(1e-3, 1e3).map(lambda x: f"law.gains.0.k1={x!r}"),
    st.just("law.gains.0={block='inter',k2=[[1,0,0,0],[0,1,0,0],[0,0,1,0],[0,0,0,1]]}"),
    st.just("law.coupling=[{value=-1},{block='g1',onto='centroid',value=[[1,2],[3,4],[5,6],[7,8]]}]"),
    st.sampled_from(["law.time_scales=multi", "law.epsilon=[0.1,0.2,0.3,0.4]", "law.lead=1"]),
    st.floats(0, 100, exclude_min=True).map(lambda x: f"robot.torque_limit={x!r}"),
    st.sampled_from(
        ["robot.torque_limit=inf", "formation.groups.g1.robot.wheel_speed_limit=inf", "robot.model=rigid_body"]
    ),
    st.floats(-1e6, 1e6).map(lambda x: f"formation.groups.g2.robots.r4.start=[{x!r}, 5e-324]"),
    st.sampled_from(
        [
            "trajectory={kind='line',velocity=[1,2]}",
            "trajectory={kind='waypoints',points=[[0,0],[1,1]],times=[0,3]}",
            "formation.shape={kind='wedge',spacing=9,angle=60,rotation=10}",
            "formation.shape={kind='vectors',vectors=[[1,2],[3,4]]}",
            "formation.shape={kind='points',points=[[1,2],[3,4],[-0.0,6]]}",
            "formation.period=0.02",
            "avoidance.enabled=true",
            "can.enabled=false",
            "can.url=virtual",
            "claims=[]",
            "periods.torque=0.0001",
        ]
    ),
)


@pytest.mark.slow
@settings(max_examples=200, suppress_health_check=list(HealthCheck))
@given(st.sampled_from(SCENARIOS), st.lists(LINES, min_size=1, max_size=5))
def test_any_effective_scenario_reads_back(path, overrides):
    try:
        scenario, plan = load(path, overrides)
    except ScenarioError:
        return
    check_round_trip(scenario, plan)


def test_the_effective_scenario_writes_defaults_out():
    table = tomllib.loads(effective_toml(load(SCENARIOS[0])[0]))
    assert table["avoidance"]["force_limit"] > 0
    assert table["record"]["display_period"] > 0
    assert table["links"] == []
    for key in Scenario.model_fields:
        assert key in table


@given(st.text())
def test_any_description_reads_back(text):
    scenario, _ = load(SCENARIOS[0])
    changed = scenario.model_copy(update={"description": text})
    assert parse(effective_toml(changed), "t.toml")[0] == changed


def models(above: type[Table] = Table) -> list[type[Table]]:
    """Returns all tables of a scenario."""
    return [model for child in above.__subclasses__() for model in (child, *models(child))]


@pytest.mark.parametrize("model", models())
def test_tables_are_frozen_and_know_their_keys(model):
    assert model.model_config["extra"] == "forbid"
    assert model.model_config["frozen"]
    assert model.__doc__


@pytest.mark.parametrize("number", [True, False, "1", "nan", math.nan, None, [1.0]])
def test_values_that_are_not_numbers_are_refused(number):
    for model, fields_of in ((RobotTable, ["mass", "offset", "torque_limit"]), (Shape, ["side", "rotation", "angle"])):
        for name in fields_of:
            if number is not None or (model is Shape and name != "side"):
                with pytest.raises(ValidationError):
                    model.model_validate(
                        {"kind": "triangle", "side": 1.0, name: number} if model is Shape else {name: number}
                    )


def test_limits_may_be_infinite_and_nothing_else():
    assert RobotTable(torque_limit=math.inf).torque_limit == math.inf
    for name in ("mass", "offset", "heading"):
        with pytest.raises(ValidationError):
            RobotTable.model_validate({name: math.inf})


@pytest.mark.parametrize("times", [[0.0], [0.0, 0.0], [1.0, 0.5], [0.0, 1.0, 2.0], [-1.0, 0.0]])
def test_waypoints_need_ascending_times(times):
    with pytest.raises(PartError):
        REGISTRY.make("trajectories", "waypoints", {"points": [(0.0, 0.0), (1.0, 1.0)], "times": times}, Path())


@pytest.mark.parametrize("name", ["", "A", "1a", "-a", "a.b", "a/b", "a b", "é", "a" * 33, "a\n", "**"])
def test_names(name):
    scenario, _ = load(SCENARIOS[0])
    with pytest.raises(ValidationError):
        Scenario.model_validate(scenario.model_dump() | {"name": name}, context=PartContext(REGISTRY, Path()))


def test_shipped_scenarios_match_their_descriptions():
    assert {path.stem for path in SCENARIOS} >= {"paper", "lab"}
    for path in SCENARIOS:
        scenario, plan = load(path)
        assert scenario.name == path.stem == plan.name
        assert scenario.description
        assert scenario.claims
