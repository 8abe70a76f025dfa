"""The published schema of summary.json is that of the records, describes every key, and holds for real summaries."""

import json
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from echelon.sim.results.rendering import json_text, read_summary, summary_schema, to_json
from support.runs import ROOT, echelon, summary_of

PUBLISHED = ROOT / "docs" / "summary.schema.json"


def test_what_is_published_is_up_to_date() -> None:
    assert json.loads(PUBLISHED.read_text(encoding="utf-8")) == summary_schema(), "make docs"


def test_every_record_and_every_key_is_described() -> None:
    schema = summary_schema()
    for name, table in {**schema["$defs"], "Summary": schema}.items():
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


def strict(schema: Any) -> Any:
    """Returns a schema that allows no key it does not name."""
    if isinstance(schema, dict):
        more = {"additionalProperties": False} if "properties" in schema else {}
        return {key: strict(value) for key, value in schema.items()} | more
    return [strict(item) for item in schema] if isinstance(schema, list) else schema
