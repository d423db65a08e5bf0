"""Figures of the benchmark: the artists hold the data that was given, everything is inside."""

import io

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_hex
from PIL import Image
from skimage.color import rgb2lab

from experiments.pages.benchmark_figures import (
    curve_figure,
    latency_figure,
    memory_figure,
    sweep_figure,
)
from experiments.pages.policy_style import OKABE_ITO, legend_below, styles_of
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


def assert_drawn_inside(figure):
    """It becomes a PNG without a warning, and no text leaves it."""
    image = Image.open(io.BytesIO(style.to_png(figure)))
    assert min(image.size) > 200
    frame, canvas = figure.bbox, FigureCanvasAgg(figure)
    canvas.draw()
    renderer = canvas.get_renderer()
    texts = [*figure.texts, *(t for legend in figure.legends for t in legend.get_texts())]
    for axes in figure.axes:
        texts += [axes.title, axes._left_title, axes.xaxis.label, axes.yaxis.label, *axes.texts]
    for text in texts:
        if text.get_text() and text.get_visible():
            box = text.get_window_extent(renderer)
            assert frame.x0 - 1 <= box.x0, text
            assert box.x1 <= frame.x1 + 1, text
            assert frame.y0 - 1 <= box.y0, text
            assert box.y1 <= frame.y1 + 1, text


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
    assert_drawn_inside(figure)


def test_seeds_are_points_where_their_seconds_differ():
    cells = benchmark(("r3",), ("flat",), snapshots=SNAPSHOTS)
    axes = curve_figure(cells, "seconds", "views").axes[0]
    seconds = np.array([c["exploration"]["seconds"] for c in cells]).reshape(3, 3)
    np.testing.assert_allclose(lines_of(axes)["r3"], [seconds.mean(axis=0), SNAPSHOTS])
    points = axes.collections[0].get_offsets()
    assert sorted(map(tuple, np.asarray(points))) == sorted(
        zip(seconds.ravel(), np.tile(SNAPSHOTS, 3), strict=True)
    )
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("mission clock [s]", "views")


def test_a_line_ends_where_a_seed_is_missing():
    cells = benchmark(("random", "r3"), ("flat",), snapshots=SNAPSHOTS)
    cells = [c for c in cells if (c["policy"], c["seed"], c["snapshot"]) != ("r3", 1, "views:60")]
    axes = curve_figure(cells).axes[0]
    np.testing.assert_array_equal(lines_of(axes)["r3"][0], [10, 30])
    np.testing.assert_array_equal(lines_of(axes)["random"][0], SNAPSHOTS)
    cells = [
        c for c in cells if (c["policy"], c["seed"]) != ("r3", 0) or c["snapshot"] == "views:60"
    ]
    figure = curve_figure(cells)  # now no snapshot has all seeds of ours: points only
    assert list(lines_of(figure.axes[0])) == legend_of(figure) == ["random"]
    assert sum(len(c.get_offsets()) for c in figure.axes[0].collections if len(c.get_offsets()) > 1)


def test_a_metric_that_some_lack():
    cells = benchmark(("random", "r3"), ("flat",), snapshots=SNAPSHOTS)
    for cell in cells:
        if cell["policy"] == "random":
            cell["views"]["lpips"] = None
    assert list(lines_of(curve_figure(cells, y="lpips").axes[0])) == ["r3"]


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
    assert_drawn_inside(figure)
    wide = sweep_figure("bins", [32, 2048], {"a": np.ones((2, 1))}, "PSNR [dB]")
    assert wide.axes[0].get_xscale() == "log"


def test_a_sweep_of_names_places_them_side_by_side():
    scores = {"flat": np.array([[1.0], [2.0], [3.0]])}
    axes = sweep_figure("form", ["max", "sum", True], scores, "SSIM").axes[0]
    np.testing.assert_allclose(lines_of(axes)["flat"], [[0, 1, 2], [1.0, 2.0, 3.0]])
    assert [label.get_text() for label in axes.get_xticklabels()] == ["max", "sum", "True"]


def test_latency_shows_its_percentiles():
    frames, rng = np.arange(1, 40, 5), np.random.default_rng(0)
    given = {m: (frames, rng.lognormal(2.0, 0.3, (len(frames), 50))) for m in ("random", "r3")}
    figure = latency_figure(given, "a machine")
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["random", "r3"]
    for axes, (_, samples) in zip(figure.axes, given.values(), strict=True):
        p50, p95, p99 = np.percentile(samples, [50, 95, 99], axis=1)
        np.testing.assert_allclose(lines_of(axes)["p50"], [frames, p50])
        np.testing.assert_allclose(lines_of(axes)["p99"], [frames, p99])
        assert band_of(axes)[frames[2]] == pytest.approx((p50[2], p95[2]))
        told = axes.texts[0].get_text()
        assert told.startswith(f"all: p50 {np.percentile(samples, 50):.3g}, p95 ")
        assert f"p99 {np.percentile(samples, 99):.3g} ms" in told
        assert axes.get_yscale() == "log"
    assert figure.axes[0].get_ylim() == figure.axes[1].get_ylim()
    assert legend_of(figure) == ["p50", "to p95", "p99"]
    assert_drawn_inside(figure)


def test_latency_of_fewer_repeats():
    samples = np.array([[1.0, 3.0, np.nan], [1.0, 2.0, 9.0]])
    axes = latency_figure({"r3": (np.array([5, 15]), samples)}).axes[0]
    np.testing.assert_allclose(lines_of(axes)["p50"], [[5, 15], [2.0, 2.0]])
    assert axes.texts[0].get_text().startswith("all: p50 2, ")


def test_memory_is_in_megabytes_from_zero():
    frames = np.arange(5)
    figure = memory_figure({"r3": (frames, 1e6 * frames)}, "device memory", limit=300e6)
    axes = figure.axes[0]
    np.testing.assert_allclose(lines_of(axes)["r3"], [frames, frames])
    assert axes.get_ylim()[0] == 0.0
    assert axes.get_ylim()[1] > 300.0
    assert axes.texts[0].get_text() == "300 MB"
    assert to_hex(axes.lines[0].get_color()) == styles_of(["r3"])["r3"].color.lower()
    assert_drawn_inside(figure)


@pytest.mark.full
def test_many_methods_fit():
    named = [{**c, "settings": {"pool_size": 9}} for c in benchmark(("active-gs",))]
    for scenes in (("flat",), ("flat", "house", "office", "gallery", "lounge")):
        figure = curve_figure(
            [*benchmark(scenes=scenes), *(c for c in named if c["scene"] in scenes)]
        )
        assert len(figure.axes) == len(scenes)
        assert len(legend_of(figure)) == len(SKILL) + 1
        assert_drawn_inside(figure)
    empty = style.new_figure(3.0, 3.0)
    legend_below(empty, ["nothing"])
    assert not empty.legends


def test_mistakes_are_named():
    cells = [record(snapshot=30), record(snapshot=30) | {"snapshot": "seconds:30"}]
    with pytest.raises(ValueError, match="of one kind, got seconds and views"):
        curve_figure(cells)
    with pytest.raises(ValueError, match="no quantity 'mse'; there are views, seconds"):
        curve_figure([record()], y="mse")
    with pytest.raises(ValueError, match="the resolution of exploration"):
        curve_figure([record(), record(seed=1, resolution=512)])
    with pytest.raises(
        ValueError, match=r"flat: needs scores \[2 values, seeds\], got shape \(3, 1\)"
    ):
        sweep_figure("s", [1, 2], {"flat": np.ones((3, 1))}, "y")
    with pytest.raises(ValueError, match=r"s=3 was not tried; tried were \[1, 2\]"):
        sweep_figure("s", [1, 2], {"flat": np.ones((2, 1))}, "y", chosen=3)
