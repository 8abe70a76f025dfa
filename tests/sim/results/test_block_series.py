"""Block series against the defining formulas, written out by hand for the paper's first group."""

from math import sqrt

import numpy as np
import pytest

from echelon.sim.results.block_series import Blocks, BlockSeries, block_series, component_names
from echelon.sim.results.trace import Trace
from support.synthetic import DECAY, FIELD, decaying, with_states


@pytest.fixture(scope="module")
def run():
    return decaying(["duration=2.0"])


@pytest.fixture(scope="module")
def blocks(run) -> Blocks:
    return block_series(run.trace)


def named(blocks: Blocks, name: str) -> BlockSeries:
    return next(series for series in blocks.series if series.block.name == name)


def test_shape_variables_are_those_of_the_definition(run, blocks):
    _, states = run.trace.common()
    x = states[:, :, [FIELD["x"], FIELD["y"]]]
    one, two, three = x[:, 0], x[:, 1], x[:, 2]
    expected = np.hstack([(one - two) / sqrt(2), three - (one + two) / 2])
    np.testing.assert_allclose(named(blocks, "g1").value, expected, atol=1e-12)
    means = [x[:, first : first + 3].mean(axis=1) for first in (0, 3, 6)]
    expected = np.hstack([(means[0] - means[1]) / sqrt(2), means[2] - (means[0] + means[1]) / 2])
    np.testing.assert_allclose(named(blocks, "inter").value, expected, atol=1e-12)
    np.testing.assert_allclose(named(blocks, "centroid").value, x.mean(axis=1), atol=1e-12)


def test_desired_is_what_the_paper_says(blocks):
    for name in ("g1", "g2", "g3"):
        np.testing.assert_allclose(named(blocks, name).desired[[0, -1]], [[-4.9497, 0, 0, 6.0622]] * 2, atol=5e-5)
    np.testing.assert_allclose(named(blocks, "inter").desired[7], [-14.1421, 0, 0, 17.3205], atol=5e-5)
    t = blocks.seconds
    np.testing.assert_allclose(
        named(blocks, "centroid").desired, np.stack([t, 30 * np.sin(0.1 * t)], axis=1), atol=1e-12
    )


def test_errors_decay_as_they_were_made_to(run, blocks):
    for series in blocks.series:
        decay = np.exp(-blocks.seconds / DECAY[series.block.layer])
        start = run.start[series.block.name]
        np.testing.assert_allclose(series.error, start * decay[:, None], atol=1e-12)
        np.testing.assert_allclose(series.norm, np.linalg.norm(start) * decay, atol=1e-12)
        np.testing.assert_allclose(series.error_rate, -series.error / DECAY[series.block.layer], atol=1e-11)


def test_rates_are_the_derivatives_of_the_values(blocks):
    series = named(blocks, "centroid")
    central = (series.value[2:] - series.value[:-2]) / 2e-3
    np.testing.assert_allclose(series.rate[1:-1], central, atol=1e-5)


def test_only_common_instants_count(run):
    trace = run.trace
    times = (trace.times_ns[0][::2], *trace.times_ns[1:])
    thinned = block_series(Trace(trace.plan, times, (trace.states[0][::2], *trace.states[1:])))
    whole = block_series(trace)
    np.testing.assert_array_equal(thinned.times_ns, whole.times_ns[::2])
    np.testing.assert_array_equal(thinned.series[0].error, whole.series[0].error[::2])


@pytest.mark.filterwarnings("error")
def test_what_is_not_finite_raises_nothing_and_stays_in_its_blocks(run):
    states = [part.copy() for part in run.trace.states]
    states[8][5:, FIELD["x"]] = np.nan
    states[7][6:, FIELD["y"]] = 1e300
    blocks = block_series(with_states(run.trace, states))
    assert np.isfinite(named(blocks, "g1").norm).all()
    assert np.isfinite(named(blocks, "g3").norm[:5]).all()
    assert not np.isfinite(named(blocks, "g3").norm[5:]).any()


def test_no_instants_give_empty_series(run):
    robots = len(run.plan.robots)
    nothing = Trace(run.plan, (np.empty(0, np.int64),) * robots, (np.empty((0, len(FIELD))),) * robots)
    assert [series.norm.shape for series in block_series(nothing).series] == [(0,)] * len(run.plan.blocks)


def test_components_have_names(run):
    assert component_names(run.plan.blocks[0]) == ("z1_x", "z1_y", "z2_x", "z2_y")
    assert component_names(run.plan.blocks[-1]) == ("x", "y")
