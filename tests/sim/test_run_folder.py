"""Names of runs in a comparison."""

from pathlib import Path

import pytest

from echelon.sim.run_folder import run_names


@pytest.mark.parametrize(
    ("folders", "names"),
    [
        (["runs/a"], ["a"]),
        (["runs/a", "runs/b"], ["a", "b"]),
        (["x/run", "y/run", "y/other"], ["x/run", "y/run", "y/other"]),
        (["x/run", "x/run"], ["run (1)", "run (2)"]),
        (["x/1/run", "x/2/run", "y/2/run", "x/1/run"], ["x/1/run (1)", "x/2/run", "y/2/run", "x/1/run (2)"]),
    ],
)
def test_runs_have_the_shortest_names_that_tell_them_apart(folders: list[str], names: list[str]) -> None:
    assert run_names([Path("/somewhere") / folder for folder in folders]) == names


def test_where_one_stands_has_a_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_names([Path(".")]) == [tmp_path.name]
