"""The published schema of summary.json is that of the records, describes every key, and holds for real summaries."""

import json
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator

from echelon.sim.results.rendering import analysis_schema, json_text, read_summary, summary_schema, to_json
from support.runs import ROOT, echelon, summary_of
from support.schemas import strict

PUBLISHED = ROOT / "docs" / "summary.schema.json"


def test_what_is_published_is_up_to_date() -> None:
    assert json.loads(PUBLISHED.read_text(encoding="utf-8")) == summary_schema(), "make docs"
    analyses = PUBLISHED.with_name("analysis.schema.json")
    assert json.loads(analyses.read_text(encoding="utf-8")) == analysis_schema(), "make docs"


def test_every_record_and_every_key_is_described() -> None:
    summaries, analyses = summary_schema(), analysis_schema()
    tables = {**summaries["$defs"], "Summary": summaries, **analyses["$defs"], "AnalysisResult": analyses}
    for name, table in tables.items():
        assert table["description"], name
        assert table["properties"], name
        assert not [key for key, value in table["properties"].items() if not value.get("description")], name


@pytest.mark.slow
@pytest.mark.parametrize(
    "arguments",
    [
        ("lab", "--engine", "inprocess", "--set", "duration=0.2", "--set", "claims=[]"),
        ("lab", "--engine", "inprocess", "--can", "none", "--set", "duration=0.2", "--set", "claims=[]"),
        ("drives", "--set", "duration=0.2", "--set", "claims=[]"),
        ("paper", "--engine", "inprocess", "--set", "duration=0.05", "--set", "periods.torque=0.001"),
    ],
)
def test_real_summaries_fit_the_schema_and_read_back(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    echelon("run", *arguments, "--quiet", "--no-report", "--out", tmp_path)
    summary = summary_of(tmp_path)
    validator = Draft202012Validator(strict(summary_schema()))
    assert [error.message for error in validator.iter_errors(summary)] == []
    record = read_summary(tmp_path / "summary.json")
    assert to_json(record) == summary
    assert json_text(record) + "\n" == (tmp_path / "summary.json").read_text(encoding="utf-8")
