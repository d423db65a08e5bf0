"""Camera models: the examples of COLMAP's documentation, and what no camera is."""

import numpy as np
import pytest

from r3jax.formats.lenses import Lens, pinhole_lens
from r3jax.geometry.cameras import Camera
from r3jax.validation.errors import ForeignFileError

EXAMPLES = [
    (Lens("SIMPLE_PINHOLE", 3072, 2304, (2559.81, 1536.0, 1152.0)), (2559.81, 2559.81), {}),
    (Lens("PINHOLE", 3072, 2304, (2560.56, 2561.56, 1536.0, 1152.0)), (2560.56, 2561.56), {}),
    (
        Lens("SIMPLE_RADIAL", 3072, 2304, (2559.69, 1536.0, 1152.0, -0.0218531)),
        (2559.69, 2559.69),
        {"k": -0.0218531},
    ),
]
"""https://colmap.github.io/format.html#cameras-txt, with two different focal lengths."""


@pytest.mark.parametrize(("lens", "focal", "distortion"), EXAMPLES)
def test_the_documented_examples(lens, focal, distortion):
    assert lens.intrinsics == (*focal, 1536.0, 1152.0)
    assert lens.distortion == distortion
    assert lens.is_pinhole == (not distortion)
    np.testing.assert_allclose([lens.camera.fx, lens.camera.fy], focal, rtol=1e-7)


def test_a_model_without_its_distortion_is_a_pinhole_unless_it_is_a_fisheye():
    values = (500.0, 501.0, 320.0, 240.0)
    assert Lens("OPENCV", 640, 480, (*values, 0.0, 0.0, 0.0, 0.0)).is_pinhole
    assert not Lens("OPENCV", 640, 480, (*values, 0.0, 0.0, 0.0, 1e-9)).is_pinhole
    assert not Lens("OPENCV_FISHEYE", 640, 480, (*values, 0.0, 0.0, 0.0, 0.0)).is_pinhole
    assert not Lens("FISHEYE", 640, 480, values).is_pinhole


def test_a_camera_comes_back():
    camera = Camera(40, 30, 31.3, 30.7, 21.1, 14.2)
    assert pinhole_lens(camera).camera == camera


@pytest.mark.parametrize(
    ("fields", "reason"),
    [
        (("CYLINDER", 10, 10, (10.0, 10.0)), "CYLINDER"),
        (("EQUIRECTANGULAR", 20, 10, (20.0,)), "w h.*1"),
        (("EQUIRECTANGULAR", 20, 10, (40.0, 20.0)), "20 x 10.*40 20"),
        (("EQUIRECTANGULAR", 20, 8, (20.0, 8.0)), "20 x 8"),
        (("PINHOLE", 10, 10, (10.0, 5.0, 5.0)), "fx fy cx cy.*3"),
        (("PINHOLE", 0, 10, (10.0, 10.0, 5.0, 5.0)), "0 x 10 pixels"),
        (("PINHOLE", 10, 1 << 40, (10.0, 10.0, 5.0, 5.0)), "pixels"),
        (("PINHOLE", 10, 10, (10.0, 0.0, 5.0, 5.0)), "10 and 0"),
        (("PINHOLE", 10, 10, (10.0, 1e30, 5.0, 5.0)), "focal lengths"),
        (("PINHOLE", 10, 10, (10.0, 10.0, 5.0, float("nan"))), "not finite"),
        (("PINHOLE", 10, 10, (10.0, 10.0, 5.0, -1e30)), "principal point"),
    ],
)
def test_what_is_no_camera_is_refused(fields, reason):
    with pytest.raises(ForeignFileError, match=reason):
        Lens(*fields)
