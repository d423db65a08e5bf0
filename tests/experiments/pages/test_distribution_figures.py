"""Ridges and scatters: areas, ticks and points of the views that were given."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from experiments.pages.distribution_figures import density, ridge_figure, scatter_figure
from experiments.rank_statistics import kendall, spearman
from tests.evaluation.records import benchmark, record
from tests.experiments.pages.test_benchmark_figures import assert_drawn_inside, legend_of


@given(st.lists(st.integers(0, 40), min_size=1, max_size=30))
def test_a_density_integrates_to_one_where_the_values_are(values):
    grid = np.linspace(-300.0, 340.0, 3000)
    found = density(np.array(values, float), grid)
    assert np.all(found >= 0.0)
    assert np.trapezoid(found, grid) == pytest.approx(1.0, abs=1e-3)
    mean = np.trapezoid(found * grid, grid)
    assert mean == pytest.approx(np.mean(values), abs=1e-3 * (1 + abs(np.mean(values))))


def test_a_density_of_normal_data_is_normal():
    values = np.random.default_rng(0).normal(25.0, 3.0, 4000)
    grid = np.linspace(10.0, 40.0, 301)
    expected = np.exp(-0.5 * ((grid - 25.0) / 3.0) ** 2) / (3.0 * np.sqrt(2.0 * np.pi))
    assert np.abs(density(values, grid) - expected).max() < 0.1 * expected.max()


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
    assert_drawn_inside(figure)


def test_the_tail_of_lpips_is_above():
    cells = [record("r3", psnr=np.linspace(10.0, 30.0, 50))]
    axes = ridge_figure(cells, "lpips").axes[0]
    dot = next(line.get_xdata()[0] for line in axes.lines if line.get_marker() == ".")
    assert dot == pytest.approx(np.percentile(cells[0]["views"]["lpips"], 95))


def test_equal_values_make_a_ridge_too():
    assert len(ridges(ridge_figure([record(psnr=[20.0] * 9)]).axes[0])) == 1


def scatter_data(n=150):
    rng = np.random.default_rng(2)
    x = rng.uniform(0.0, 1.0, n)
    return x, 15.0 + 10.0 * x + rng.normal(0.0, 2.0, n), ["15 views"] * 50 + ["40 views"] * (n - 50)


def part(figure, name):
    return next(axes for axes in figure.axes if axes.get_label() == name)


def test_scatter_shows_every_view_once_in_the_color_of_its_group():
    x, y, groups = scatter_data()
    x[3], y[60] = np.nan, np.nan
    figure = scatter_figure(x, y, groups, title="flat", resamples=50)
    clouds = part(figure, "main").collections
    assert [len(cloud.get_offsets()) for cloud in clouds] == [49, 99]
    keep = ~np.isnan(x + y)
    drawn = np.concatenate([np.asarray(cloud.get_offsets()) for cloud in clouds])
    np.testing.assert_allclose(drawn, np.column_stack([x, y])[keep])
    assert not np.array_equal(clouds[0].get_facecolor(), clouds[1].get_facecolor())
    assert legend_of(figure) == ["15 views", "40 views"]
    assert_drawn_inside(figure)


def test_scatter_tells_the_coefficients_with_intervals():
    x, y, groups = scatter_data()
    figure = scatter_figure(x, y, groups, title="flat", resamples=50, seed=4)
    title = part(figure, "top").get_title(loc="left")
    labels = {"strata": np.array(groups), "seed": 4, "resamples": 50}
    rho, tau = spearman(x, y, **labels), kendall(x, y, **labels)
    assert title == (
        f"flat\nSpearman {rho.value:.2f} [{rho.low:.2f}, {rho.high:.2f}], "
        f"Kendall {tau.value:.2f} [{tau.low:.2f}, {tau.high:.2f}], 150 views"
    )


def test_side_distributions_have_the_areas_of_their_groups():
    x, y, groups = scatter_data()
    figure = scatter_figure(x, y, groups, resamples=20)
    top, side = part(figure, "top"), part(figure, "side")
    for i, share in enumerate((1 / 3, 2 / 3)):
        for grid, height in (top.lines[i].get_data(), side.lines[i].get_data()[::-1]):
            assert np.trapezoid(height, grid) == pytest.approx(share, rel=0.15)
    assert top.get_xlim() == part(figure, "main").get_xlim()
    assert side.get_ylim() == part(figure, "main").get_ylim()


def test_one_group_needs_no_legend():
    x, y, _ = scatter_data()
    assert not scatter_figure(x, y, ["flat"] * len(x), resamples=20).legends


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="no metric 'mse'"):
        ridge_figure([record()], "mse")
    with pytest.raises(ValueError, match="the clock"):
        ridge_figure([record(), record(seed=1, clock="wall")])
    silent = record()
    silent["views"]["lpips"] = None
    with pytest.raises(ValueError, match="no record has a value of lpips"):
        ridge_figure([silent], "lpips")
    with pytest.raises(ValueError, match="one length"):
        scatter_figure(np.ones(4), np.ones(5), ["a"] * 4)
