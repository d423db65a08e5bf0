"""Camera positions: every one drawn where it was, in the color of its turn."""

import matplotlib
import numpy as np
import pytest

from experiments.pages.positions_figure import positions_figure
from r3jax.plots import style
from tests.experiments.pages.test_benchmark_figures import assert_drawn_inside

LOW, HIGH = np.zeros(3), np.array([6.0, 5.0, 2.5])


def paths(count=3):
    rng = np.random.default_rng(0)
    lengths = [30, 12, 1, 7, 9][:count]
    return {f"policy {i}": rng.uniform(LOW, HIGH, (n, 3)) for i, n in enumerate(lengths)}


def panels(figure):
    return [axes for axes in figure.axes if axes.name == "3d"]


def test_every_position_is_drawn_in_its_turn():
    given = paths()
    figure = positions_figure(given, (LOW, HIGH), "flat")
    assert_drawn_inside(figure)
    assert [axes.get_title() for axes in panels(figure)] == list(given)
    scale = matplotlib.colormaps[style.PATH_MAP]
    for axes, found in zip(panels(figure), given.values(), strict=True):
        (cloud,) = axes.collections
        np.testing.assert_allclose(np.column_stack([*cloud._offsets3d]), found)
        turn = (np.arange(1, len(found) + 1) - 1) / (30 - 1)  # the longest run sets the scale
        np.testing.assert_allclose(cloud.cmap(cloud.norm(cloud.get_array())), scale(turn))
        path, shadow = (np.column_stack([*line.get_data_3d()]) for line in axes.lines)
        np.testing.assert_allclose(path, found)
        np.testing.assert_allclose(shadow[:, :2], found[:, :2])
        assert np.all(shadow[:, 2] == LOW[2])
    assert figure.axes[-1].get_ylabel() == "order of acquisition"


@pytest.mark.full
def test_all_panels_share_one_box():
    for box in ((LOW, HIGH), None):
        figure = positions_figure(paths(5), box)
        limits = {(*axes.get_xlim(), *axes.get_ylim(), *axes.get_zlim()) for axes in panels(figure)}
        assert len(limits) == 1
        assert_drawn_inside(figure)
        if box is not None:
            assert limits.pop() == pytest.approx((0.0, 6.0, 0.0, 5.0, 0.0, 2.5))


def test_a_flat_path_still_has_a_box():
    same_height = {"r3": np.array([[0.0, 0.0, 1.5], [4.0, 2.0, 1.5]])}
    (axes,) = panels(positions_figure(same_height))
    assert axes.get_zlim() == pytest.approx((1.1, 1.9))
    assert_drawn_inside(positions_figure({"r3": np.ones((1, 3))}))


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="no positions"):
        positions_figure({})
    for shape in ((3, 2), (0, 3), (3,)):
        with pytest.raises(ValueError, match=r"r3: positions must be \[n, 3\]"):
            positions_figure({"r3": np.zeros(shape)})
