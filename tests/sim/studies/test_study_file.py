"""Files of studies: what they may hold, and that a finding says the numbers that are checked."""

import re
from dataclasses import replace
from typing import Any

import pytest

from echelon.errors import UsageError
from echelon.sim.studies.running import Measured, command_of, measure, request_of
from echelon.sim.studies.study_file import Number, parse_study, read_study, shipped_studies
from echelon.sim.sweep.preparing import prepare
from support.runs import ROOT, plan_of
from support.studies import study as results

SMALL: dict[str, Any] = {
    "title": "t",
    "question": "q",
    "finding": "1.5 times",
    "scenario": "lab",
    "sweeps": [{"name": "a", "vary": ["law.lead=0,0.5"]}],
}
NUMBER: dict[str, Any] = {"says": "1.5", "value": 1.5, "within": 0.1, "sweep": "a", "column": "share"}


@pytest.mark.parametrize("name", shipped_studies())
def test_the_finding_says_the_numbers_that_are_checked_in_two_or_three_sentences(name: str) -> None:
    study = read_study(name)
    assert study.numbers
    for number in study.numbers:
        assert number.says in study.finding
        digits = re.search(r"\d+(\.\d+)?", number.says)
        if digits and number.says.endswith(" times"):
            assert abs(number.value - float(digits[0])) <= number.within + 0.5 * 10.0 ** -len(
                digits[0].partition(".")[2]
            )
    assert len(re.findall(r"[.:;] [A-Z]|\.$", study.finding.strip())) <= 3


@pytest.mark.parametrize("name", shipped_studies())
def test_the_sweeps_of_shipped_studies_can_begin(name: str) -> None:
    for part in read_study(name).sweeps:
        assert prepare(request_of(part)).points
        assert command_of(part).startswith(f"echelon sweep {part.scenario} --set ")


@pytest.mark.parametrize(
    ("change", "text"),
    [
        ({"colour": "red"}, "colour: there is no such key"),
        ({"title": 3}, "title = 3: is of the wrong type"),
        ({"sweeps": []}, "sweeps: there is none"),
        ({"sweeps": {}}, r"sweeps: must be an array of tables, \[\[sweeps\]\]"),
        ({"sweeps": [{"vary": []}]}, "sweeps.0: name: is missing"),
        ({"sweeps": [{"name": "a", "seeds": "many"}]}, "sweeps.0: seeds = 'many': is of the wrong type"),
        ({"numbers": [NUMBER | {"sweep": "b"}]}, "numbers: there is no sweep 'b'; there are a"),
        ({"sweeps": [{"name": "a", "vary": [0.5]}]}, r"sweeps.0: vary = \[0.5\]: is of the wrong type"),
        ({"sweeps": [{"name": "a"}, {"name": "a"}]}, "sweeps: two of them have the name 'a'"),
        ({"numbers": [NUMBER | {"over": {"sweep": "b"}}]}, "numbers: there is no sweep 'b'; there are a"),
        ({"numbers": [NUMBER | {"over": {"at": 1}}]}, "numbers: '1.5': over: at = 1: is of the wrong type"),
        ({"numbers": [NUMBER | {"over": {"rows": 1}}]}, "numbers: '1.5': over: rows: there is no such key"),
        ({"sweeps": [{"name": "a", "beside": "a"}]}, "sweeps: a: beside: there is no other sweep 'a'"),
        (
            {
                "sweeps": [
                    {"name": "a", "vary": ["law.lead=0,0.5"]},
                    {"name": "b", "beside": "a", "vary": ["law.lead=0,1"]},
                ]
            },
            "sweeps: b: beside: one key must vary here, and in 'a' several as a grid",
        ),
        ({"numbers": [NUMBER | {"within": -1.0}]}, "numbers: '1.5': value and within must be finite"),
    ],
)
def test_mistakes_are_one_line_that_names_the_place(change: dict[str, Any], text: str) -> None:
    with pytest.raises(UsageError, match=f"^f: {text}"):
        parse_study(SMALL | change, "f", "f")
    with pytest.raises(UsageError, match="finding: is missing"):
        parse_study({key: value for key, value in SMALL.items() if key != "finding"}, "f", "f")


def test_a_name_that_is_no_study_lists_those_that_are(tmp_path) -> None:
    with pytest.raises(UsageError, match="nothing: no such file, and no shipped study; those are bursts, "):
        read_study("nothing")
    (tmp_path / "bad.toml").write_text("title = ", encoding="utf-8")
    with pytest.raises(UsageError, match=r"bad\.toml: Invalid value"):
        read_study(str(tmp_path / "bad.toml"))


def test_numbers_are_read_in_the_row_that_they_name() -> None:
    delay, policy = "links.uplink.delay", "links.uplink.policy"
    found = {"a": results({delay: [0.0, 0.1, 0.2], policy: ["hold", "predict"]}, lambda d, p: float(d < 0.15))}
    number = Number(says="", value=0.0, within=0.0, sweep="a", column="ise.inter", at={delay: 0.1, policy: "predict"})
    (row,) = (3,)
    column = found["a"].points["ise.inter"]
    assert measure(number, found) == column[row]
    ratio = replace(number, over={"at": {delay: 0.0, policy: "hold"}})
    assert measure(ratio, found) == column[row] / column[0]
    assert measure(replace(number, column="largest", at={policy: "hold"}), found) == 0.1
    nothing = measure(replace(number, at={delay: 0.15}), found)
    assert nothing != nothing  # no such row: NaN
    assert not Measured(number, nothing).agrees
    assert Measured(replace(number, value=1.0, within=0.1), 1.1 - 1e-12).agrees
    assert not Measured(replace(number, value=1.0, within=0.1), 1.2).agrees


def test_slow_leaders_and_coordinator_send_as_few_messages_as_the_finding_says() -> None:
    slow = [
        "formation.period=0.6",
        "duration=36",
        *(f"formation.groups.{name}.period=0.1" for name in ("g1", "g2", "g3")),
    ]
    rates = [sum(1e9 / link.period_ns for link in plan_of("lab", *changes).links) for changes in ([], slow)]
    assert rates == [pytest.approx(2400), pytest.approx(190)]
    assert "190 instead of 2400 messages" in read_study("rates").finding.replace("\n", " ")


@pytest.mark.parametrize("name", shipped_studies())
def test_the_page_of_studies_has_the_finding_of_each(name: str) -> None:
    page = (ROOT / "docs" / "studies.md").read_text(encoding="utf-8")
    assert f"(../deploy/studies/{name}.toml) | {' '.join(read_study(name).finding.split())} |" in page
