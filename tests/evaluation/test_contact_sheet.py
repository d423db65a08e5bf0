"""The contact sheet: the right pictures in the right places, numbers of their own view."""

import dataclasses
import io

import numpy as np
import pytest
from PIL import Image

from r3jax.errors import InputError
from r3jax.evaluation.contact_sheet import ERROR_SCALE, SheetView, contact_sheet, error_picture
from r3jax.plots import style
from r3jax.plots.pictures import BEYOND
from tests.evaluation.test_scores import row

HEIGHT, WIDTH = 6, 8


def sheet_view(number, *, renderability=True):
    rng = np.random.default_rng(number)
    truth, render = rng.integers(0, 256, (2, HEIGHT, WIDTH, 3), dtype=np.uint8)
    expected = rng.uniform(0.1, 1.0, (3, 4)) if renderability else None
    return SheetView(row(number, 10.0 + number), truth, render, expected)


def pictures(figure):
    """Arrays shown, line by line from left to right (color bars left out)."""
    shown = [axes for axes in figure.axes if axes.images]
    order = lambda axes: (-round(axes.get_position().y0, 3), round(axes.get_position().x0, 3))
    return [np.asarray(axes.images[0].get_array()) for axes in sorted(shown, key=order)]


def texts(figure):
    inside = [text.get_text() for axes in figure.axes for text in axes.texts]
    titles = [axes.get_title(loc="left") for axes in figure.axes]
    return inside + [t for t in titles if t] + [text.get_text() for text in figure.texts]


def test_error_is_the_mean_over_colors():
    truth, render = np.zeros((1, 2, 3), np.uint8), np.zeros((1, 2, 3), np.uint8)
    truth[0, 0], render[0, 0] = (255, 0, 10), (0, 30, 10)
    np.testing.assert_allclose(error_picture(truth, render), [[(255 + 30) / 3 / 255, 0.0]])
    np.testing.assert_allclose(error_picture(truth, render), error_picture(render, truth))


def test_every_line_shows_its_view():
    views = [sheet_view(3), sheet_view(1)]
    shown = pictures(contact_sheet(views, "title"))
    assert len(shown) == 8
    for i, view in enumerate(views):
        truth, render, error, expected = shown[4 * i : 4 * i + 4]
        np.testing.assert_array_equal(truth, view.truth)
        np.testing.assert_array_equal(render, view.render)
        np.testing.assert_allclose(error, error_picture(view.truth, view.render))
        np.testing.assert_allclose(expected, view.renderability)


def test_what_is_out_of_range_is_told_apart_from_what_was_never_seen():
    view = sheet_view(2)
    known, beyond = np.array(view.renderability), np.zeros((HEIGHT, WIDTH), bool)
    known[0], beyond[:2, : WIDTH // 2] = 0.0, True
    view = dataclasses.replace(view, renderability=known, beyond=beyond)
    axes = [axes for axes in contact_sheet([view], "title").axes if len(axes.images) == 2]
    (axes,) = axes
    blue, values = (np.asarray(image.get_array()) for image in axes.images)
    np.testing.assert_array_equal(blue[..., 3] == 1.0, beyond)
    np.testing.assert_allclose(blue[beyond][:, :3], np.broadcast_to(BEYOND, (beyond.sum(), 3)))
    assert np.isnan(np.ma.filled(values.astype(float), np.nan)[0]).all()
    assert axes.get_facecolor()[:3] != BEYOND


def test_captions_and_scales_are_told():
    figure = contact_sheet([sheet_view(3), sheet_view(1)], "two\nlines")
    found = texts(figure)
    assert "two\nlines" in found
    captions = [text for text in found if text.startswith("frame")]
    assert [caption.splitlines()[:2] for caption in captions] == [
        ["frame 3", "PSNR 13.0 dB"],
        ["frame 1", "PSNR 11.0 dB"],
    ]
    assert {"SSIM 0.800", "LPIPS 0.200", "R 0.50"} <= set(captions[0].splitlines())
    labels = [axes.get_xlabel() for axes in figure.axes]
    assert any(f"saturates at {ERROR_SCALE:g}" in label for label in labels)


def test_without_a_map_there_is_no_fourth_column():
    views = [sheet_view(2, renderability=False)]
    figure = contact_sheet(views, "title")
    assert len(pictures(figure)) == 3
    assert "renderability" not in texts(figure)


def test_what_the_map_does_not_know_is_gray():
    view = sheet_view(5)
    view.renderability[0, 0] = 0.0
    shown = np.ma.filled(np.ma.masked_invalid(pictures(contact_sheet([view], "t"))[3]), -1.0)
    assert shown[0, 0] == -1.0
    assert (shown >= 0.0).sum() == shown.size - 1


def test_it_is_a_png_whose_pictures_do_not_overlap():
    figure = contact_sheet([sheet_view(i) for i in range(3)], "title")
    image = Image.open(io.BytesIO(style.to_png(figure)))
    assert image.size[0] > 800
    boxes = [axes.get_position() for axes in figure.axes]
    for i, a in enumerate(boxes):
        assert 0.0 <= a.x0 < a.x1 <= 1.0
        assert 0.0 <= a.y0 < a.y1 <= 1.0
        for b in boxes[:i]:
            apart = a.x1 <= b.x0 or b.x1 <= a.x0 or a.y1 <= b.y0 or b.y1 <= a.y0
            assert apart


def test_no_views_is_a_mistake():
    with pytest.raises(InputError):
        contact_sheet([], "title")


def test_a_dollar_sign_in_a_name_is_no_formula():
    figure = contact_sheet([sheet_view(0)], "runs/$x^$")
    assert style.to_png(figure).startswith(b"\x89PNG")
