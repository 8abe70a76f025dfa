"""The commands `echelon figures` and `echelon study`: mistakes, each one line."""

from pathlib import Path

import echelon as library
from support.runs import echelon


def test_what_is_not_the_folder_of_a_sweep_is_one_line(tmp_path: Path) -> None:
    library.sweep(
        "lab", {"duration": 0.1, "claims": []}, vary={"law.lead": [0, 0.5, 1]}, out=tmp_path / "a", quiet=True
    )
    (tmp_path / "a" / "scenario.toml").unlink()
    for folder, said in (("a", "a/scenario.toml: No such file"), ("b", "b: is not the folder of a sweep")):
        done = echelon("figures", tmp_path / folder)
        assert done.returncode == 2, done.stderr
        (line,) = done.stderr.splitlines()
        assert said in line
    assert not (tmp_path / "a" / "figures").exists()


def test_a_study_that_does_not_exist_is_one_line() -> None:
    done = echelon("study", "nothing")
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert "nothing: no such file, and no shipped study; those are bursts, " in line
