"""Faults put into the kernels on purpose; every one must show in images, gradients or lists.

The kernels run here as plain Python over NumPy, so that a fault costs no compilation.
"""

import dataclasses
from unittest import mock

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.baselines.information import pixel_squares, pixel_tallies
from r3jax.geometry.cameras import invert_pose
from r3jax.kernels.constants import ALPHA_MIN, TILE
from r3jax.kernels.splatting import records
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.backends import reference
from r3jax.splatting.projection import project_gaussians
from tests.plain_kernels import Modules, kernels_as_python, load
from tests.splatting.clouds import random_cloud, safe_pixels, view

PACKAGE = "r3jax.kernels.splatting"
CHAIN = tuple(
    f"{PACKAGE}.{name}" for name in ("project", "compositing", "gradient", "passes", "squares")
)
COUNT, SIZE, BUDGET = 70, (40, 24), 1024
BEHIND = np.array([0.2, 0.7, 0.4], np.float32)
LEAST = (0.3, 0.02)


@pytest.fixture(autouse=True, scope="module")
def plain_python():
    with kernels_as_python():
        yield


class Case:
    """A view from within a cloud, some of it broad and solid, by the readable rasterizer."""

    def __init__(self):
        cloud, is_broad = random_cloud(2, COUNT), jnp.arange(COUNT) % 4 == 0
        self.scene = dataclasses.replace(
            cloud,
            opacity_logits=jnp.where(is_broad, 6.0, cloud.opacity_logits),
            log_scales=jnp.where(is_broad[:, None], -0.8, cloud.log_scales),
        )
        self.camera, self.pose = view(*SIZE, distance=0.6)
        self.safe = safe_pixels(self.scene, self.camera, self.pose)
        rng = np.random.default_rng(0)
        shapes = ((3, *SIZE[::-1]), SIZE[::-1], SIZE[::-1])
        weights = [(rng.standard_normal(s) * self.safe).astype(np.float32) for s in shapes]
        self.weights = np.ascontiguousarray(np.moveaxis(weights[0], 0, -1)), *weights[1:]
        self.rows = self.count_rows()

        def loss(scene, view_numbers, offsets):
            images = self.reference_images(scene, view_numbers, offsets)
            pairs = zip(images, self.weights, strict=True)
            return sum(jnp.sum(image * weight) for image, weight in pairs), images

        pose = np.asarray(self.pose)
        camera = [float(getattr(self.camera, name)) for name in ("fx", "fy", "cx", "cy")]
        arguments = self.scene, (jnp.asarray(pose), jnp.asarray(camera)), jnp.zeros((COUNT, 2))
        step = jax.jit(jax.value_and_grad(loss, argnums=(0, 1, 2), has_aux=True))
        (_, self.images), (by_scene, by_view, by_offsets) = step(*arguments)
        self.by_cloud = (*jax.tree.leaves(by_scene), by_offsets)
        self.by_pose, self.by_camera = by_view
        squares, _ = pixel_squares(
            self.scene, self.camera, self.pose, jnp.asarray(BEHIND), RasterConfig(), "reference"
        )
        self.squares = [*jax.tree.leaves(squares)[:4], squares.sh.reshape(COUNT, -1)]

    def reference_images(self, scene, view_numbers, offsets):
        pose, (fx, fy, cx, cy) = view_numbers
        camera = type(self.camera)(*SIZE, fx, fy, cx, cy)
        result = reference.rasterize(scene, camera, pose, offsets, RasterConfig())
        return result.rgb, result.depth_sum, result.alpha

    def count_rows(self) -> int:
        """Rows of tiles in which some pixel sees a Gaussian, over all Gaussians."""
        zeros = jnp.zeros((COUNT, 2))
        projected = project_gaussians(self.scene, self.camera, self.pose, zeros)
        center, conic = np.asarray(projected.center), np.asarray(projected.conic)
        total = 0
        for i in np.flatnonzero(projected.is_drawn):
            dx = center[0, i] - np.arange(SIZE[0]) - 0.5
            dy = (center[1, i] - np.arange(SIZE[1]) - 0.5)[:, None]
            s = 0.5 * (conic[0, i] * dx * dx + conic[2, i] * dy * dy) + conic[1, i] * dx * dy
            seen = float(projected.opacity[i]) * np.exp(-s) >= ALPHA_MIN
            columns = np.arange(SIZE[0]) // TILE
            total += sum(seen[:, columns == c].any(axis=1).sum() for c in set(columns))
        return total

    def view_numbers(self, pose):
        T = invert_pose(pose)
        intrinsics = jnp.stack([getattr(self.camera, name) for name in ("fx", "fy", "cx", "cy")])
        return jnp.concatenate([T[:3, :3].ravel(), T[:3, 3], pose[:3, 3], intrinsics])


@pytest.fixture(scope="module", autouse=True)
def case():
    global _case
    _case = Case()
    return _case


_case: Case


def dirty(shape, dtype=np.float64) -> np.ndarray:
    """Memory as it may be: NaN, or -1."""
    array = np.ndarray(shape, dtype)
    array.view(np.uint8)[...] = 255
    return array


def arguments():
    """The cloud's arrays and the numbers of the view, as the passes take them."""
    cloud = tuple(np.array(x) for x in jax.tree.leaves(_case.scene))
    cloud = (*cloud[:4], cloud[4].reshape(COUNT, -1), np.zeros((COUNT, 2), np.float32))
    return cloud, np.array(_case.view_numbers(_case.pose))


def forward(modules: Modules):
    """Images, totals, records, lists."""
    tiles = -(-SIZE[0] // TILE) * -(-SIZE[1] // TILE)
    images = tuple(dirty(weight.shape, np.float32) for weight in _case.weights)
    totals, table = dirty(2, np.int32), dirty((COUNT, records.SIZE), np.float32)
    sizes = (BUDGET, np.int32), (BUDGET, np.int32), (BUDGET, np.uint8)
    lists = tuple(dirty(*size) for size in (*sizes, (tiles + 1, np.int32), (tiles, np.int32)))
    with mock.patch.object(np, "empty", dirty):
        modules["passes"].forward_pass(*arguments(), 2, images, totals, table, lists)
    return images, totals, table, lists


def backward(modules: Modules):
    """Gradients by the cloud, the pose and the camera."""
    images, _, table, lists = forward(modules)
    cloud, numbers = arguments()
    by_cloud = tuple(dirty(x.shape, np.float32) for x in cloud)
    by_view = dirty(records.VIEW_SIZE, np.float32)
    with mock.patch.object(np, "empty", dirty):
        modules["passes"].backward_pass(
            cloud, numbers, 2, images, table, lists, _case.weights, by_cloud, by_view
        )
    _, pull_back = jax.vjp(_case.view_numbers, _case.pose)
    return by_cloud, *pull_back(jnp.asarray(by_view)), by_view[15:]


def assert_near(found, expected, tolerance: float) -> None:
    off = np.linalg.norm(np.ravel(found) - np.ravel(expected))
    assert off <= tolerance * np.linalg.norm(expected)  # fails for NaN


def images_agree(modules: Modules) -> None:
    images, totals, *_ = forward(modules)
    assert totals[1] == 0
    for found, expected in zip(images, _case.images, strict=True):
        assert np.abs(found - np.asarray(expected))[_case.safe].max() < 1e-4


def gradients_agree(modules: Modules) -> None:
    by_cloud, by_pose, by_camera = backward(modules)
    for found, expected in zip(by_cloud, _case.by_cloud, strict=True):
        assert_near(found, expected, 1e-3)
    assert_near(by_pose, _case.by_pose, 1e-3)
    assert_near(by_camera, _case.by_camera, 1e-3)


def squares_agree(modules: Modules) -> None:
    images, _, table, lists = forward(modules)
    cloud, numbers = arguments()
    squares = tuple(dirty(x.shape, np.float32) for x in cloud[:5])
    with mock.patch.object(np, "empty", dirty):
        modules["squares"].squares_pass(
            cloud, numbers, 2, images, table, lists, np.float32(BEHIND.sum()), squares
        )
    for found, expected in zip(squares, _case.squares, strict=True):
        # Of roots: the few Gaussians next to the camera must not outweigh all others.
        assert_near(np.sqrt(np.abs(found)), np.sqrt(expected), 1e-4)


def tallies_agree(modules: Modules) -> None:
    _, _, table, lists = forward(modules)
    value, found = np.abs(_case.weights[1]), dirty((COUNT, 2), np.float32)
    counts = (_case.safe & (value > 0.5)).astype(np.float32)
    with mock.patch.object(np, "empty", dirty):
        modules["squares"].tallies_pass(table, lists, 2, value, counts, np.array(LEAST), found)
    value, counts = jnp.asarray(value), jnp.asarray(counts)
    expected, _ = pixel_tallies(
        _case.scene, _case.camera, _case.pose, value, counts, RasterConfig(),
        least_through=LEAST[0], least_weight=LEAST[1], source="reference",
    )  # fmt: skip
    assert_near(found[:, 0], expected[:, 0], 1e-3)
    assert_near(found[:, 1], expected[:, 1], 1e-3)


def lists_are_tight(modules: Modules) -> None:
    """No row in which a pixel sees the Gaussian is left out, and hardly another is listed."""
    _, totals, _, lists = forward(modules)
    rows = lists[2][: totals[0]].astype(int)
    listed = np.sum((rows >> 4) - (rows & 15) + 1)
    # Between the centers of pixels an ellipse may pass unseen, and there is some slack.
    assert _case.rows <= listed <= 1.01 * _case.rows


@pytest.mark.parametrize(
    "law", [images_agree, gradients_agree, squares_agree, tallies_agree, lists_are_tight]
)
def test_the_laws_hold(law):
    law(load(CHAIN))
