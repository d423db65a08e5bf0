"""Figures of the benchmark: the artists hold the data that was given, everything is inside."""

import io

import numpy as np
import pytest
from PIL import Image
from skimage.color import rgb2lab

from r3jax.apps.benchmark.figures import curve_figure, sweep_figure
from r3jax.apps.benchmark.policy_style import OKABE_ITO, styles_of
from r3jax.plots import style
from tests.evaluation.records import SKILL, benchmark, record

SNAPSHOTS = (10, 30, 60)


def lines_of(axes):
    """Data of the lines with a label, by label."""
    return {
        line.get_label(): np.array(line.get_data())
        for line in axes.lines
        if not line.get_label().startswith("_")
    }


def band_of(axes, i=0):
    """Lowest and highest y of the i-th filled band at each of its x."""
    corners = axes.collections[i].get_paths()[0].vertices
    return {
        x: (corners[corners[:, 0] == x, 1].min(), corners[corners[:, 0] == x, 1].max())
        for x in np.unique(corners[:, 0])
    }


def legend_of(figure):
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def assert_drawn(figure):
    """It becomes a PNG of some size, without a warning."""
    assert min(Image.open(io.BytesIO(style.to_png(figure))).size) > 200


def test_curves_are_means_over_seeds_with_their_range():
    cells = benchmark(("random", "r3"), snapshots=SNAPSHOTS)
    figure = curve_figure(cells[::-1])
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["flat", "house"]
    for axes, scene in zip(figure.axes, ("flat", "house"), strict=True):
        drawn = lines_of(axes)
        assert list(drawn) == ["random", "r3"]
        assert len(axes.collections) == 2  # bands only: seeds have the same numbers of views
        for i, policy in enumerate(drawn):
            means = np.array([
                [np.mean(record(policy, scene, seed, n)["views"]["psnr"]) for n in SNAPSHOTS]
                for seed in (0, 1, 2)
            ])  # fmt: skip
            np.testing.assert_array_equal(drawn[policy][0], SNAPSHOTS)
            np.testing.assert_allclose(drawn[policy][1], means.mean(axis=0))
            for j, n in enumerate(SNAPSHOTS):
                assert band_of(axes, i)[n] == pytest.approx((means[:, j].min(), means[:, j].max()))
    assert legend_of(figure) == ["random", "r3"]
    assert_drawn(figure)


def test_every_method_has_its_own_look():
    variants = ["r3", "r3 (bins=32)", "r3 (bins=8)"]
    looks = styles_of([*SKILL, *variants[1:], "mine"])
    assert len({(look.color, str(look.dashes)) for look in looks.values()}) == len(SKILL) + 3
    # Nor do points without a line look the same.
    assert len({(look.color, look.marker, look.fill) for look in looks.values()}) == len(SKILL) + 3
    assert len({look.color for name, look in looks.items() if name in variants}) == 1
    assert len({looks[name].marker for name in SKILL}) == len(SKILL)
    assert styles_of(["r3"])["r3"] == looks["r3"]  # whoever else is drawn
    own = ("r3", "r3-pano")
    floor = max(look.width for name, look in looks.items() if name.split()[0] not in own)
    assert min(looks["r3"].width, looks["r3-pano"].width) > floor


def seen_by(eye, color):
    """CIELAB of a color `#rrggbb` after the matrix of an eye on linear RGB."""
    encoded = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255.0
    linear = np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)
    linear = np.clip(eye @ linear, 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return rgb2lab(encoded)


def test_colors_differ_without_red_or_green():
    """Protanopia, deuteranopia (matrices of Machado et al. 2009) and full color vision."""
    eyes = np.array([
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216],
         [-0.003882, -0.048116, 1.051998]],
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413],
         [-0.011820, 0.042940, 0.968881]],
        np.eye(3),
    ])  # fmt: skip
    policies = sorted({look.color for look in styles_of([*SKILL, "mine"]).values()})
    assert len(policies) == len(SKILL) + 1
    for colors in (policies, OKABE_ITO):
        for eye in eyes:
            seen = [seen_by(eye, color) for color in colors]
            for i, first in enumerate(seen):
                for second in seen[:i]:
                    assert np.linalg.norm(first - second) > 15.0  # 2.3 is just noticeable


def test_a_sweep_draws_what_was_tried_in_order():
    scores = {"flat": np.array([[3.0, 5.0], [1.0, 1.0], [2.0, np.nan], [np.nan, np.nan]])}
    figure = sweep_figure("lambda1", [0.5, 0.1, 1.0, 2.0], scores, "PSNR [dB]", chosen=1.0)
    axes = figure.axes[0]
    np.testing.assert_allclose(lines_of(axes)["flat"], [[0.1, 0.5, 1.0], [1.0, 4.0, 2.0]])
    assert band_of(axes)[0.5] == (3.0, 5.0)
    assert axes.get_xscale() == "linear"
    assert [line.get_xdata()[0] for line in axes.lines if line.get_label().startswith("_")] == [1.0]
    assert axes.get_title(loc="right") == "chosen: lambda1 = 1.0"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("lambda1", "PSNR [dB]")
    assert_drawn(figure)
    wide = sweep_figure("bins", [32, 2048], {"a": np.ones((2, 1))}, "PSNR [dB]")
    assert wide.axes[0].get_xscale() == "log"


def test_a_sweep_of_names_places_them_side_by_side():
    scores = {"flat": np.array([[1.0], [2.0], [3.0]])}
    axes = sweep_figure("form", ["max", "sum", True], scores, "SSIM").axes[0]
    np.testing.assert_allclose(lines_of(axes)["flat"], [[0, 1, 2], [1.0, 2.0, 3.0]])
    assert [label.get_text() for label in axes.get_xticklabels()] == ["max", "sum", "True"]


def test_quantities_that_cannot_stand_together_are_refused():
    cells = [record(snapshot=30), record(snapshot=30) | {"snapshot": "seconds:30"}]
    with pytest.raises(ValueError, match="seconds"):
        curve_figure(cells)
    with pytest.raises(ValueError, match="'mse'"):
        curve_figure([record()], y="mse")
    with pytest.raises(ValueError, match="resolution"):
        curve_figure([record(), record(seed=1, resolution=512)])
    with pytest.raises(ValueError, match=r"\(3, 1\)"):
        sweep_figure("s", [1, 2], {"flat": np.ones((3, 1))}, "y")
    with pytest.raises(ValueError, match="s=3"):
        sweep_figure("s", [1, 2], {"flat": np.ones((2, 1))}, "y", chosen=3)
