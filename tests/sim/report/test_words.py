"""Labels of axes are words with units, never keys of a scenario."""

import tomllib

import pytest

from echelon.sim.report.studies.results import Key
from echelon.sim.report.studies.words import label_of
from echelon.sim.studies.study_file import read_study, shipped_studies

SCENARIO = tomllib.loads("""
links = [
    { channel = "state" },
    { name = "up", channel = "group_state" },
    { source = "g1/*" },
    { channel = "" },
    { name = "net" },
]
events = [{ kind = "blackout", at = 5.0 }]
""")


@pytest.mark.parametrize(
    ("key", "label"),
    [
        ("links.0.delay", "delay of state links [s]"),
        ("links.0.delay.max", "largest delay of state links [s]"),
        ("links.up.delay", "delay of group state links [s]"),
        ("links.1.loss", "loss of group state links"),
        ("links.0.loss.mean", "mean loss of state links"),
        ("links.0.loss.burst", "mean length of bursts of losses of state links [messages]"),
        ("links.2.delay", "delay of all links from g1/* [s]"),
        ("links.3.delay", "delay of links [s]"),
        ("links.net.delay", "delay of the links net [s]"),
        ("links.9.delay", "delay of links [s]"),
        ("events.0.duration", "duration of the blackout [s]"),
        ("law.epsilon", "ratio of time scales ε"),
        ("periods.acceleration", "acceleration period [s]"),
        ("formation.period", "period of the coordinator [s]"),
        ("formation.groups.g1.period", "period of g1 [s]"),
        ("formation.groups.g1.robot.offset", "offset of formation groups g1 robot [m]"),
        ("trajectory.anything_else", "anything else of trajectory"),
    ],
)
def test_a_key_in_words(key: str, label: str) -> None:
    assert label_of(key, SCENARIO) == label
    assert Key.of(key, [0.0, 1.0], SCENARIO).label == label


@pytest.mark.parametrize("name", shipped_studies())
def test_no_axis_of_a_shipped_study_has_a_raw_key(name: str) -> None:
    for part in read_study(name).sweeps:
        for text in (*part.vary, *([part.find] if part.find else [])):
            for key in text.partition("=")[0].split(","):
                label = label_of(key.strip(), SCENARIO)
                assert "." not in label.replace("[s]", "")
                assert "_" not in label
