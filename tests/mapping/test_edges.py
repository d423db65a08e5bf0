"""Which pixels count as depth edges: steps, thin parts and holes, but not slopes or noise."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.ndimage import median_filter

from r3jax.mapping import associate as real

HEIGHT, WIDTH = 24, 32  # one shape: one compile
VOXEL = 0.05

real_edges = jax.jit(real.edge_pixels)


def edges_of(depth: np.ndarray, edges=real_edges) -> np.ndarray:
    return np.asarray(edges(jnp.asarray(depth, jnp.float32), jnp.float32(VOXEL)))


def plane(distance: float) -> np.ndarray:
    return np.full((HEIGHT, WIDTH), distance)


def noisy(depth: np.ndarray, seed: int) -> np.ndarray:
    """As an RGB-D camera sees it: noise of 1 % of the depth."""
    return depth * (1.0 + 0.01 * np.random.default_rng(seed).normal(size=depth.shape))


def grazing(height: float) -> np.ndarray:
    """A ceiling so far above the camera: beyond 1 m its depth changes by voxels a pixel."""
    row = np.arange(HEIGHT)[:, None] + 0.5
    return np.broadcast_to(height * 111.0 / (3.0 + row), (HEIGHT, WIDTH)).copy()


@given(st.floats(0.3, 1.2), st.floats(-0.01, 0.01))
def test_a_plane_seen_at_a_grazing_angle_has_no_edges(height, turn):
    """Any plane is linear in inverse depth; only the image's border lacks a neighbor."""
    depth = 1.0 / (1.0 / grazing(height) + turn * np.arange(WIDTH) / height / 111.0)
    assert np.abs(np.diff(depth, axis=0)).max() > 2 * VOXEL
    assert not edges_of(depth)[2:-2, 2:-2].any()


def test_a_step_on_a_slope_is_an_edge():
    depth = grazing(0.8)
    depth[:, 16:] += 1.0
    edges = edges_of(depth)
    assert edges[2:-2, 15:17].all()
    assert not edges[2:-2, :14].any()  # the median smears a steep slope by a pixel


@pytest.mark.parametrize("step", [0.06, 0.5, 3.0])
def test_both_sides_of_a_step_are_edges_and_nothing_else(step):
    depth = plane(2.0)
    depth[:, 16:] += step
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[:, 15:17] = True
    np.testing.assert_array_equal(edges_of(depth), expected)
    np.testing.assert_array_equal(edges_of(np.ascontiguousarray(np.flip(depth, 1))), expected)


def test_a_step_between_rows_is_an_edge_too():
    depth = plane(2.0)
    depth[10:] = 3.0
    assert np.flatnonzero(edges_of(depth).all(axis=1)).tolist() == [9, 10]
    assert edges_of(depth).sum() == 2 * WIDTH


def test_less_than_a_voxel_is_no_edge():
    depth = plane(2.0)
    depth[:, 16:] += 0.9 * VOXEL
    assert not edges_of(depth).any()


@given(st.floats(-0.03, 0.03), st.floats(-0.015, 0.015))
def test_slopes_of_less_than_a_voxel_a_pixel_are_no_edges(slope_x, slope_y):
    row, column = np.mgrid[:HEIGHT, :WIDTH]
    assert not edges_of(3.0 + slope_x * column + slope_y * row).any()


@pytest.mark.parametrize(
    ("distance", "at_most"), [(1.0, 0.0), (2.0, 0.002), (3.0, 0.02), (4.0, 0.05)]
)
def test_noise_is_hardly_taken_for_edges(distance, at_most):
    shares = [edges_of(noisy(plane(distance), seed)).mean() for seed in range(8)]
    assert np.mean(shares) <= at_most


def test_steps_are_found_under_noise():
    found = []
    for seed in range(8):
        depth = plane(2.0)
        depth[:, 16:] = 2.4
        found.append(edges_of(noisy(depth, seed))[:, 15:17].mean())
    assert np.mean(found) > 0.99


def test_bars_of_one_pixel_and_their_sides_are_edges():
    depth = plane(3.0)
    depth[:, 16] = 2.0
    depth[12, :8] = 2.0
    edges = edges_of(depth)
    assert edges[:, 15:18].all()
    assert edges[11:14, :8].all()
    assert not edges[:10, :14].any()


def test_holes_are_no_edges_and_make_none():
    depth = plane(2.0)
    depth[5:8, 5:8] = 0.0
    depth[::3, 20::3] = 0.0
    depth[14:17, 5:8] = 0.0
    depth[15, 6] = 2.0  # alone among holes
    assert not edges_of(depth).any()


def test_a_step_beside_a_hole_is_seen():
    depth = plane(2.0)
    depth[:, 16:] = 3.0
    depth[::2, 14] = 0.0
    edges = edges_of(depth)
    assert edges[:, 15:17].all()
    assert not edges[depth == 0.0].any()


def test_the_rim_of_what_is_out_of_range_is_an_edge():
    depth = plane(2.0)
    depth[:, 16:] = np.inf
    edges = edges_of(depth)
    assert edges[:, 15].all()
    assert not edges[:, :15].any()
    assert not edges_of(plane(np.inf)).any()


def test_a_surface_that_fills_the_image_has_no_edges_at_the_border():
    assert not edges_of(plane(2.0)).any()


def test_median_is_the_median():
    image = np.random.default_rng(0).random((HEIGHT, WIDTH)).astype(np.float32)
    median = real._median9(real._neighborhood(jnp.asarray(image)))
    np.testing.assert_array_equal(median, median_filter(image, size=3, mode="nearest"))


# Laws of fixed examples ---------------------------------------------------------------------------


def test_law_holds_without_a_fault() -> None:
    edges = jax.jit(real.edge_pixels)
    depth = plane(2.0)
    depth[:, 16:] = 2.06
    depth[20:, 4] = 3.0
    depth[2:9, 2:5] = 0.0
    depth[7, 3] = 2.0  # alone among holes
    expected = np.zeros((HEIGHT, WIDTH), bool)
    expected[:, 15:17] = True
    found = edges_of(depth, edges)
    np.testing.assert_array_equal(found[:16], expected[:16])
    assert found[20:, 3:6].all()
    assert edges_of(noisy(plane(4.0), 0), edges).mean() < 0.1
    assert not edges_of(grazing(0.35), edges).any(axis=1)[2:-2].any()
