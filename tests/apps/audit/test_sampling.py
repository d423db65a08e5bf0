"""Thinned and straightened images: against COLMAP's own library, and what must not move."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.audit.sampling import distorted, sampling_table, thinned
from r3jax.formats.lenses import MODELS, Lens
from r3jax.formats.validation.errors import ForeignFileError

SOME = {
    "SIMPLE_RADIAL": (400.0, 320.0, 240.0, -0.12),
    "RADIAL": (400.0, 320.0, 240.0, -0.12, 0.03),
    "OPENCV": (400.0, 410.0, 320.0, 240.0, -0.12, 0.03, 0.002, -0.003),
    "FULL_OPENCV": (400.0, 410.0, 320.0, 240.0, -0.1, 0.02, 0.002, -0.003, 0.01, 0.05, 0.01, 0.0),
    "OPENCV_FISHEYE": (400.0, 410.0, 320.0, 240.0, 0.05, -0.01, 0.003, 0.001),
    "SIMPLE_RADIAL_FISHEYE": (400.0, 320.0, 240.0, 0.05),
    "RADIAL_FISHEYE": (400.0, 320.0, 240.0, 0.05, -0.01),
}


@pytest.mark.parametrize("model", SOME)
def test_distortion_is_colmaps(model):
    pycolmap = pytest.importorskip("pycolmap")
    lens = Lens(model, 640, 480, SOME[model])
    rng = np.random.default_rng(0)
    x, y = rng.uniform(-0.7, 0.7, (2, 50))
    camera = pycolmap.Camera(model=model, width=640, height=480, params=list(SOME[model]))
    expected = np.asarray(camera.img_from_cam(np.stack([x, y, np.ones_like(x)], axis=1)))
    fx, fy, cx, cy = lens.intrinsics
    found_x, found_y = distorted(lens, x, y)
    found = np.stack([fx * found_x + cx, fy * found_y + cy], axis=1)
    np.testing.assert_allclose(found, expected, atol=1e-6)


@given(width=st.integers(1, 60), height=st.integers(1, 60), stride=st.integers(1, 7))
def test_a_thinned_pixel_looks_where_the_pixel_that_it_takes_looks(width, height, stride):
    lens = Lens("PINHOLE", width, height, (31.0, 37.0, 0.4 * width, 0.6 * height))
    table, camera = sampling_table(lens, stride), thinned(lens.camera, stride)
    assert table.row.shape == (camera.height, camera.width)
    assert table.is_there.all()
    fx, fy, cx, cy = lens.intrinsics
    column, row = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    slope = lambda at, center, focal: (at - float(center)) / float(focal)
    np.testing.assert_allclose(
        slope(column, camera.cx, camera.fx), (table.column + 0.5 - cx) / fx, atol=1e-4
    )
    np.testing.assert_allclose(
        slope(row, camera.cy, camera.fy), (table.row + 0.5 - cy) / fy, atol=1e-4
    )


def test_nothing_is_invented_where_the_lens_saw_nothing():
    lens = Lens("SIMPLE_RADIAL", 64, 48, (40.0, 32.0, 24.0, 0.6))  # bends corners far outwards
    table = sampling_table(lens, 1)
    assert 0.3 < table.is_there.mean() < 1.0
    image = np.full((48, 64, 3), 200, np.uint8)
    taken = table.take(image)
    np.testing.assert_array_equal(taken[~table.is_there], 0)
    np.testing.assert_array_equal(taken[table.is_there], 200)
    assert table.is_there[24, 32]
    assert (image == 200).all()


def test_a_lens_nobody_straightens_here_is_named():
    params = (40.0, 40.0, 32.0, 24.0, *[0.1] * (len(MODELS["THIN_PRISM_FISHEYE"][1]) - 4))
    with pytest.raises(ForeignFileError, match="THIN_PRISM_FISHEYE lens are not straightened"):
        sampling_table(Lens("THIN_PRISM_FISHEYE", 64, 48, params), 2)
