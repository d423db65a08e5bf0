"""The stored form: what is rounded once stays as it is, through files and back."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from r3jax.exploration.config import BEYOND_RANGE
from r3jax.exploration.taken_views import content_hash, from_integers, stored_form, to_integers
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.runs.header import RunError
from r3jax.runs.reader import read_png
from r3jax.runs.writer import encode_png

CAMERA = Camera.from_fov(6, 4)
SIZE = (4, 6)


def make_frame(rgb: np.ndarray, depth: np.ndarray) -> Frame:
    return Frame(jnp.asarray(rgb), jnp.asarray(depth), jnp.eye(4), CAMERA)


def random_frame(seed: int) -> Frame:
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.0, 5.0, SIZE).astype(np.float32)
    depth[0, 0], depth[0, 1] = 0.0, np.inf
    return make_frame(rng.random((*SIZE, 3), dtype=np.float32), depth)


depths = st.one_of(
    st.floats(0.0, 20.0, width=32), st.just(0.0), st.just(float("inf")), st.floats(0.0, 1e-3)
)


@given(
    hnp.arrays(np.float32, (*SIZE, 3), elements=st.floats(0, 1, width=32)),
    hnp.arrays(np.float32, SIZE, elements=depths.map(np.float32)),
)
def test_rounding_is_close_idempotent_and_keeps_meanings(rgb, depth):
    stored = stored_form(make_frame(rgb, depth))
    again = stored_form(stored)
    np.testing.assert_array_equal(stored.rgb, again.rgb)
    np.testing.assert_array_equal(stored.depth, again.depth)
    assert np.abs(np.asarray(stored.rgb) - rgb).max() <= 0.5 / 255 + 1e-6
    kept = np.asarray(stored.depth)
    np.testing.assert_array_equal(kept == 0.0, depth == 0.0)  # no surface is ever lost
    is_near = depth <= 13.1
    near = is_near & (depth > 1e-4)
    np.testing.assert_allclose(kept[near], depth[near], atol=1.01e-4)
    assert np.all(np.isinf(kept[depth > 13.107]))


def test_every_stored_depth_reads_back_to_itself():
    camera = Camera.from_fov(256, 256)
    codes = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    black = np.zeros((256, 256, 3), np.uint8)
    frame = from_integers(black, codes, np.eye(4), camera)
    np.testing.assert_array_equal(to_integers(frame)[1], codes)
    assert np.isinf(np.asarray(frame.depth).reshape(-1)[BEYOND_RANGE])


def test_png_files_hold_the_integers_exactly(tmp_path):
    rgb, depth = to_integers(random_frame(0))
    (tmp_path / "a.png").write_bytes(encode_png(rgb))
    (tmp_path / "a.depth.png").write_bytes(encode_png(depth))
    np.testing.assert_array_equal(read_png(tmp_path / "a.png", 6, 4, is_depth=False), rgb)
    read = read_png(tmp_path / "a.depth.png", 6, 4, is_depth=True)
    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, depth)


def test_the_hash_sees_one_changed_pixel():
    rgb, depth = to_integers(random_frame(1))
    before = content_hash(rgb, depth)
    assert content_hash(rgb.copy(), depth.copy()) == before
    depth[2, 3] += 1
    assert content_hash(rgb, depth) != before


@pytest.mark.parametrize(
    "content",
    [
        None,
        b"no picture at all",
        encode_png(to_integers(random_frame(2))[0])[:40],
        encode_png(np.zeros((9, 9, 3), np.uint8)),
        encode_png(np.zeros(SIZE, np.uint16)),
    ],
)
def test_a_broken_image_is_named(tmp_path, content):
    if content is not None:
        (tmp_path / "a.png").write_bytes(content)
    with pytest.raises(RunError, match=r"a\.png"):
        read_png(tmp_path / "a.png", 6, 4, is_depth=False)
