"""Small faults in the kernels for CPUs, each of which the reference must tell from the truth.

The kernels run as plain Python here: what they compile to is compared in `test_backends`.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.kernels import calls
from r3jax.mapping.occupancy import cells_of
from r3jax.scoring import formulas
from r3jax.visibility.views import for_kernels, layout_of, wrap
from tests.mapping.test_kernels import arrays_of
from tests.plain_kernels import Modules, kernels_as_python, load
from tests.scoring.test_backends import (
    CAMERA,
    CONFIG,
    NUM_BINS,
    known_after,
    poses_of,
    view_at,
    world,
)

SIGHT = ("views", "picture", "seen", "bricks")
SCORES = ("terms", "voxels", "sums", "pixels", "changes")
CHAIN = (
    *(f"r3jax.kernels.visibility.{name}" for name in SIGHT),
    "r3jax.kernels.mapping.bins",
    *(f"r3jax.kernels.scoring.{name}" for name in SCORES),
)
VIEWS = 5


@pytest.fixture(autouse=True, scope="module")
def plain_python():
    with kernels_as_python():
        yield


@functools.cache
def asked():
    """The map, cells, and the arguments that all passes share."""
    state, grid = world(2)
    # Some rows hold what is left of a voxel that was taken out (`MapState.take`).
    is_left = jnp.arange(state.capacity) % 7 == 0
    state = dataclasses.replace(state, count=jnp.where(is_left, 0.0, state.count))
    cells = cells_of(grid)
    return state, cells, arrays_of(state), cells_as_arrays(cells)


def cells_as_arrays(cells: calls.Cells) -> calls.Cells:
    return calls.Cells(*map(np.array, calls._as_bytes(cells)))


def views_of(kind: str):
    """Views, and the same as kernels take them."""
    views = [view_at(kind, pose) for pose in poses_of(2)[:VIEWS]]
    laid_out = [for_kernels(view, CONFIG.tolerance, CAMERA.focal) for view in views]
    together = calls.Views(*(np.stack(part) for part in zip(*laid_out, strict=True)))
    return views, together, layout_of(views[0])


@functools.cache
def expected(kind: str):
    """Sums, cells, and means in pixels of every view, by the formulas."""
    state, cells, *_ = asked()

    @jax.jit
    def look(view, position):
        at = position, CAMERA.focal, CONFIG
        sums = formulas.sums_in_view(state, cells, view, *at, NUM_BINS[kind])
        return *sums, formulas.mean_in_pixels(state, view, *at[:2], CONFIG.score)

    answers = [look(v, p[:3, 3]) for v, p in zip(views_of(kind)[0], poses_of(2), strict=False)]
    return [np.stack([np.array(x) for x in part]) for part in zip(*answers, strict=True)]


def tables_of(modules: Modules, state, bins: int):
    return modules["sums"].Tables(calls._lattice(state.num_bins), *calls._bins(bins))


def forms_of(modules: Modules):
    return modules["terms"].Choices(False, False)


def sums_agree(modules: Modules, kind: str = "panorama") -> None:
    state, _, rows, cells = asked()
    _, views, layout = views_of(kind)
    bins, none = NUM_BINS[kind], np.empty((VIEWS, 0), np.uint8)
    forms, tables = forms_of(modules), tables_of(modules, state, bins)
    deficits, unexplored, _ = expected(kind)
    for modules["sums"].MAX_VIEWS in (VIEWS, VIEWS - 1):  # without an index, and with one
        results = modules["sums"].Sums(*np.empty((2, VIEWS, bins), np.float32), none, none)
        modules["sums"].sums(rows, cells, views, layout, forms, tables, 2, results)
        np.testing.assert_allclose(results.deficits, deficits, atol=1e-4 * deficits.max())
        np.testing.assert_array_equal(results.unexplored, unexplored)


def images_agree(modules: Modules, kind: str = "pinhole") -> None:
    state, _, rows, _ = asked()
    _, views, layout = views_of(kind)
    means, images = np.empty(VIEWS, np.float32), np.empty((VIEWS, 0), np.int32)
    lattice = calls._lattice(state.num_bins)
    modules["pixels"].pixels(rows, views, layout, forms_of(modules), lattice, 2, means, images)
    np.testing.assert_allclose(means, expected(kind)[2], atol=1e-4)


def images_all_round(modules: Modules) -> None:
    images_agree(modules, "panorama")


def borders_agree(modules: Modules) -> None:
    """Each pixel of the border stands for the one that `wrap` glues it to."""
    picture, size = modules["picture"], 8
    ring = [picture._ring_pixel(i, (size, size)) for i in range(4 * size + 4)]
    row, column = np.array(ring).T
    is_outside = (row == -1) | (row == size) | (column == -1) | (column == size)
    assert len(set(ring)) == len(ring)
    assert is_outside.all()
    expected = np.stack(wrap(*jnp.asarray([row, column]), jnp.full(len(ring), size)), axis=1)
    found = [picture.wrap_pixel(*pixel, (size, size), True) for pixel in ring]
    np.testing.assert_array_equal(found, expected)


def in_images(modules: Modules) -> None:
    sums_agree(modules, "pinhole")


def points_lie_in_their_bricks(modules: Modules) -> None:
    """Each once, in the order that they had, as far from the middle as is said at most."""
    bricks, most = modules["bricks"], modules["bricks"].MOST
    points = np.random.default_rng(0).uniform(-4.0, 3.0, (3, 500)).astype(np.float32)
    points[:, 400:] = np.float32([2.4, -3.2, 0.8])[:, None]  # many in one place, on edges
    for bricks.MOST in (1 << 12, 5):
        order, (starts, spheres) = bricks.sorted_points(points)
        np.testing.assert_array_equal(np.sort(order), np.arange(500))
        assert 1 <= len(spheres) == len(starts) - 1 <= bricks.MOST
        for i, (*middle, radius) in enumerate(spheres):
            own = order[starts[i] : starts[i + 1]]
            assert len(own) > 0
            assert (np.diff(own) > 0).all()
            assert np.linalg.norm(points[:, own].T - middle, axis=1).max() <= radius
        assert radius < (1.0 if bricks.MOST > 5 else 12.0)  # edges of 0.8 and 12.8 m
    bricks.MOST = most
    for odd in (points[:, :0], np.full((3, 2), np.nan, np.float32)):
        order, (starts, spheres) = bricks.sorted_points(odd)
        assert order.tolist() == list(range(odd.shape[1]))
        assert starts.tolist() == [0, odd.shape[1]]
        np.testing.assert_array_equal(spheres, [[0.0, 0.0, 0.0, np.inf]])


def changes_agree(modules: Modules) -> None:
    (before, after), kept = known_after(2)
    positions, bins = poses_of(2)[:2, :3, 3], CONFIG.panorama_bins
    seen = [np.array(bits[:2]) for bits in kept]
    gone = before[1]._replace(unexplored=before[1].unexplored & ~after[1].unexplored)
    focals = np.full(2, CAMERA.focal, np.float32)
    results = np.empty((2, bins), np.float32), np.empty((2, bins), np.float32)
    modules["changes"].changes(
        arrays_of(before[0]), arrays_of(after[0]), cells_as_arrays(gone), seen,
        np.array(positions), focals, forms_of(modules), tables_of(modules, before[0], bins),
        results,
    )  # fmt: skip
    one = lambda bits, position: formulas.change_of_sums(
        before, after, bits, position, CAMERA.focal, CONFIG.score, bins
    )
    change, explored = jax.jit(jax.vmap(one))(seen, positions)
    np.testing.assert_allclose(results[0], change, atol=1e-4)
    np.testing.assert_array_equal(results[1], explored)


LAWS = (
    borders_agree, points_lie_in_their_bricks, sums_agree, in_images, images_agree,
    images_all_round, changes_agree,
)  # fmt: skip


@pytest.mark.parametrize("law", LAWS)
def test_the_laws_hold(law):
    law(load(CHAIN))
