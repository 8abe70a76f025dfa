"""A study is made from its file: sweeps, figures, the page, and its numbers beside what was measured."""

from pathlib import Path

import numpy as np
import pytest

from echelon import open_sweep
from echelon.errors import UsageError
from echelon.sim.report.studies.results import Boundary, Predicted
from echelon.sim.studies.beside import with_line
from support.runs import echelon
from support.studies import study as results

TEXT = """
title = "Bursts & others"
question = "Is it the mean?"
finding = "At 20 % it is as with independent losses, and at 30 % 7 times as much."
scenario = "lab"

[[sweeps]]
name = "bursts"
engine = "inprocess"
set = ["duration=0.3", "claims=[]", "links=[{channel='state',loss={mean=0.1,burst=2}}]"]
vary = ["links.0.loss.mean=0.1:0.3:0.1", "links.0.loss.burst=2,8"]
seeds = 2

[[sweeps]]
name = "independent"
beside = "bursts"
engine = "inprocess"
set = ["duration=0.3", "claims=[]", "links=[{channel='state',loss=0.1}]"]
vary = ["links.0.loss=0.1:0.3:0.1"]
seeds = 2

[[numbers]]
says = "At 20 %"
value = 1
within = 1e-9
sweep = "bursts"
column = "ise_mean.g1"
at = { "links.0.loss.mean" = 0.2, "links.0.loss.burst" = "independent" }
over = { sweep = "independent", at = { "links.0.loss" = 0.2 } }

[[numbers]]
says = "7 times"
value = 7
within = 0.1
sweep = "bursts"
column = "ise_mean.g1"
at = { "links.0.loss.mean" = 0.3, "links.0.loss.burst" = 8 }
over = { at = { "links.0.loss.mean" = 0.1, "links.0.loss.burst" = 2 } }
"""


def test_a_study_is_made_and_the_number_that_differs_is_named(tmp_path: Path) -> None:
    (tmp_path / "tiny.toml").write_text(TEXT, encoding="utf-8")
    done = echelon("study", tmp_path / "tiny.toml", "--out", tmp_path, "--quiet")
    assert done.returncode == 1, done.stderr
    folder = tmp_path / "tiny"
    bursts, independent = (open_sweep(folder / name).points for name in ("bursts", "independent"))
    ise = bursts["ise_mean.g1"]
    assert len(set(ise.tolist())) > 1
    assert len(set(independent["ise_mean.g1"].tolist())) == 3
    said = done.stdout.splitlines()
    assert said[0] == "tiny: At 20 % it is as with independent losses, and at 30 % 7 times as much."
    assert said[1].split() == ["At", "20", "%", "measured", "1"]
    row = f"7 times measured {ise[5] / ise[0]:.6g}; differs from 7 by more than 0.1"  # of the points (0.3, 8) and (0.1, 2)
    assert " ".join(said[2].split()) == row
    assert said[3].split() == ["page", str(folder / "index.html")]

    page = (folder / "index.html").read_text(encoding="utf-8")
    assert "<h1>Bursts &amp; others</h1>" in page
    assert "At 20 % it is as with independent losses" in page
    for name in ("bursts", "independent"):
        assert (folder / "figures" / name / "integrals.svg").stat().st_size > 5000
    for key in ("links.0.loss.mean", "links.0.loss"):
        assert f"--vary {key}=0.1:0.3:0.1" in page
    drawn = (folder / "figures" / "bursts" / "integrals.svg").read_text(encoding="utf-8")
    assert [name for name in ("2", "8", "32", "independent") if f"burst {name}" in drawn] == ["2", "8", "independent"]
    assert "burst" not in (folder / "figures" / "independent" / "integrals.svg").read_text(encoding="utf-8")


def test_a_sweep_is_a_line_in_the_figures_of_another_one() -> None:
    mean, burst, loss = "links.0.loss.mean", "links.0.loss.burst", "links.0.loss"
    host = results({mean: [0.1, 0.2], burst: [2.0, 8.0]}, predicted=Predicted((Boundary({burst: "2"}, 0.3),)))
    cost = {"g1": np.array([1.0, 2.0, 3.0])}
    other = results({loss: [0.1, 0.2, 0.4]}, predicted=Predicted((Boundary({}, 0.8, by="predicted"),), {}, cost))
    found = with_line(host, other, "independent")
    assert found.axis is not None
    assert found.axis.name == mean
    assert [line.name for line in found.series(found.axis)] == ["burst 2", "burst 8", "burst independent"]
    rows = found.series(found.axis)[2].rows
    assert found.axis.numbers is not None
    assert found.axis.numbers[rows].tolist() == found.points[mean][rows].tolist() == [0.1, 0.2, 0.4]
    assert found.points["point"].tolist() == list(range(7))
    assert sorted(set(found.runs["point"].tolist())) == list(range(7))
    assert found.numbers("ise_mean.g1")[rows].tolist() == other.numbers("ise_mean.g1").tolist()
    assert [(dict(one.at), one.value) for one in found.predicted.boundaries] == [
        ({burst: "2"}, 0.3), ({burst: "independent"}, 0.8),
    ]  # fmt: skip
    np.testing.assert_array_equal(found.predicted.costs["g1"], [np.nan] * 4 + [1.0, 2.0, 3.0])
    assert "independent" in {name for one in found.boundaries() for name in one.at.values()}


def test_a_sweep_in_which_names_vary_is_no_line_of_another_one() -> None:
    host = results({"links.0.loss.mean": [0.1, 0.2], "links.0.loss.burst": [2.0, 8.0]})
    other = results({"links.0.policy": ["hold", "predict"]})
    with pytest.raises(UsageError, match=r"^sweeps: one: beside: what varies must be numbers in both sweeps"):
        with_line(host, other, "one")
