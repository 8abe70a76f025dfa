"""What a sweep varies, and the points that its designs make of it."""

from math import prod

import numpy as np
import pytest
from scipy.stats import kstest, qmc

from echelon.errors import UsageError
from echelon.sim.sweep.design import Kind, design, unit_points
from echelon.sim.sweep.values import Vary, parse_vary, vary_of


@pytest.mark.parametrize(
    ("text", "values"),
    [
        ("links.up.delay=0:0.4:0.1", (0.0, 0.1, 0.2, 0.3, 0.4)),
        ("a=0:0.1:0.02", (0.0, 0.02, 0.04, 0.06, 0.08, 0.1)),
        ("a=0:1:0.3", (0.0, 0.3, 0.6, 0.9)),
        ("a=-2:2:2", (-2, 0, 2)),
        ("a=1e-3:3e-3:1e-3", (0.001, 0.002, 0.003)),
        ("a=0.5", (0.5,)),
        ("a=1,2.5", (1, 2.5)),
        ("a=true,false", (True, False)),
        ("a=hold,predict", ("hold", "predict")),
        ("a='x:y',\"z\"", ("x:y", "z")),
        ("a='my.py:A,B',z", ("my.py:A,B", "z")),
        ('a="my.py:A,B",z,"', ("my.py:A,B", "z", '"')),
        ("a=[0.1,0.2],[0.2,0.4]", ([0.1, 0.2], [0.2, 0.4])),
        ("a={mean=0.1,burst=3},0.1", ({"mean": 0.1, "burst": 3}, 0.1)),
    ],
)
def test_a_text_says_which_values(text: str, values: tuple[object, ...]) -> None:
    found = parse_vary(text)
    assert found.key == text.partition("=")[0]
    assert found.values == values
    assert [type(value) for value in found.values] == [type(value) for value in values]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a", "must be KEY="),
        ("a=", "must be KEY="),
        ("=1", "must be KEY="),
        ("a=1:0:0.1", "must go up"),
        ("a=0:1:0", "step must be more than 0"),
        ("a=0:1:-0.1", "step must be more than 0"),
        ("a=0:1:2", "step must be more than 0 and at most"),
        ("a=0:1:x", "must be a range"),
        ("a=0:nan:1", "must be a range"),
        ("a=0:1:0.1:2", "must be a range"),
        ("a=0:1:1e-9", "more than 1000000 values"),
        ("a=1,1", "twice"),
        ("seed=1,2", "--seeds"),
        ("name=x,y", "cannot be varied"),
    ],
)
def test_a_mistake_is_one_line(text: str, said: str) -> None:
    with pytest.raises(UsageError) as refused:
        parse_vary(text)
    (line,) = refused.value.lines
    assert line.startswith(f"--vary {text}")
    assert said in line


def test_a_notebook_gives_arrays_lists_or_texts() -> None:
    assert vary_of("a", np.linspace(0, 1, 3)).values == (0.0, 0.5, 1.0)
    assert vary_of("a", range(3)).values == (0, 1, 2)
    assert vary_of("a", "0:1:0.5").values == (0.0, 0.5, 1.0)
    for wrong in (3, [], object()):
        with pytest.raises(UsageError, match="a"):
            vary_of("a", wrong)


A, B = parse_vary("a=1:3:1"), parse_vary("b=x,y")


def test_a_grid_has_every_combination_and_the_last_key_changes_first() -> None:
    points = design("grid", [A, B])
    assert points == [(1, "x"), (1, "y"), (2, "x"), (2, "y"), (3, "x"), (3, "y")]
    assert len(points) == prod((len(A.values), len(B.values)))


def test_a_zip_takes_values_together() -> None:
    assert design("zip", [A, parse_vary("c=7,8,9")]) == [(1, 7), (2, 8), (3, 9)]
    with pytest.raises(UsageError, match="3 of a, 2 of b"):
        design("zip", [A, B])


def test_nothing_varied_is_one_point() -> None:
    assert design("grid", []) == [()]


def test_a_sobol_design_is_that_of_scipy() -> None:
    expected = qmc.Sobol(2, scramble=True, seed=np.random.default_rng(5)).random(64)
    np.testing.assert_array_equal(unit_points("sobol", 2, 64, 5), expected)
    points = design("sobol", [parse_vary("a=2:4"), parse_vary("b=-1.0:1.0")], 64, 5)
    # 2:4 are integers, each as likely as the others
    assert [a for a, _ in points] == [2 + int(3 * share) for share in expected[:, 0]]
    np.testing.assert_allclose([b for _, b in points], 2 * expected[:, 1] - 1)


def test_a_sobol_design_is_more_even_than_a_random_one() -> None:
    even, random = (qmc.discrepancy(unit_points(kind, 3, 256, 1)) for kind in ("sobol", "random"))
    assert even < random / 5


def test_random_points_are_uniform_and_repeatable() -> None:
    varied = [parse_vary("a=0.0:2.0"), parse_vary("b=x,y,z,w")]
    points = design("random", varied, 4000, 3)
    assert points == design("random", varied, 4000, 3)
    assert points != design("random", varied, 4000, 4)
    assert kstest([float(a) / 2 for a, _ in points], "uniform").pvalue > 1e-3
    counts = [sum(b == value for _, b in points) for value in "xyzw"]
    assert min(counts) > 900


@pytest.mark.parametrize(
    ("kind", "varied", "samples", "said"),
    [
        ("grid", [parse_vary("a=0:1")], 0, "give a step"),
        ("grid", [A, A], 0, "varied twice"),
        ("grid", [parse_vary(f"{key}=0:999:1") for key in "abc"], 0, "1000000000 points"),
        ("random", [], 4, "needs a key to vary"),
        ("random", [A], 0, "number of points"),
        ("sobol", [A], 100, "power of two, such as 64 or 128"),
    ],
)
def test_a_design_that_cannot_be_made_is_refused(kind: Kind, varied: list[Vary], samples: int, said: str) -> None:
    with pytest.raises(UsageError, match=said):
        design(kind, varied, samples)
