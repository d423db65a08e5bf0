"""Ridges and scatters: areas, ticks and points of the views that were given."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.pages.distribution_figures import density, ridge_figure
from tests.apps.benchmark.test_figures import assert_drawn
from tests.evaluation.records import benchmark


@given(st.lists(st.integers(0, 40), min_size=1, max_size=30))
def test_a_density_integrates_to_one_where_the_values_are(values):
    grid = np.linspace(-300.0, 340.0, 3000)
    found = density(np.array(values, float), grid)
    assert np.all(found >= 0.0)
    assert np.trapezoid(found, grid) == pytest.approx(1.0, abs=1e-3)
    mean = np.trapezoid(found * grid, grid)
    assert mean == pytest.approx(np.mean(values), abs=1e-3 * (1 + abs(np.mean(values))))


def ridges(axes):
    return [c for c in axes.collections if c.get_paths() and len(c.get_paths()[0].vertices) > 100]


def test_a_ridge_for_every_method_and_snapshot():
    cells = benchmark(("random", "active-gs", "r3"), snapshots=(30, 60))
    cells = [c for c in cells if (c["policy"], c["snapshot"]) != ("random", "views:30")]
    figure = ridge_figure(cells)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["views:30", "views:60"]
    assert [len(ridges(axes)) for axes in figure.axes] == [2, 3]
    names = [label.get_text() for label in figure.axes[0].get_yticklabels()]
    assert names == ["r3", "active-gs", "random"]  # from below
    for axes, snapshot in zip(figure.axes, ("views:30", "views:60"), strict=True):
        dots = {int(line.get_ydata()[0]): line.get_xdata()[0] for line in axes.lines
                if line.get_marker() == "."}  # fmt: skip
        ticks = {}
        for found in axes.collections:
            vertices = found.get_paths()[0].vertices
            if len(vertices) == 2:
                ticks[round(vertices[0, 1])] = vertices[0, 0]
        for place, policy in enumerate(names):
            chosen = [c for c in cells if (c["policy"], c["snapshot"]) == (policy, snapshot)]
            if not chosen:
                assert place not in ticks
                continue
            views = np.concatenate([c["views"]["psnr"] for c in chosen])
            assert ticks[place] == pytest.approx(np.median(views))
            assert dots[place] == pytest.approx(np.percentile(views, 5))
    assert_drawn(figure)
