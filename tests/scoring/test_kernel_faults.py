"""Small faults in the kernels for CPUs, each of which the reference must tell from the truth.

The kernels run as plain Python here: what they compile to is compared in `test_backends`.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.geometry.sphere import fibonacci_lattice, nearest_bin_table
from r3jax.kernels import scoring
from r3jax.scoring.backends import reference
from r3jax.scoring.backends.views import row_of
from r3jax.scoring.cells import cells_of
from r3jax.scoring.terms import score_voxels
from r3jax.visibility.views import wrap
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

SIGHT, SCORES = scoring.visibility_kernels.__name__, scoring.__name__
BINS = f"{scoring.mapping_kernels.__name__}.bins"
CHAIN = (
    *(f"{SIGHT}.{name}" for name in ("views", "picture", "splat", "limit", "seen", "bricks")),
    BINS,
    *(
        f"{SCORES}.{name}"
        for name in ("voxels", "near", "terms", "shown", "few", "sums", "pixels", "rows", "changes")
    ),
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
    arrays = state.key, state.visited, state.count, state.m2, state.resolution
    space = cells.x, cells.y, cells.z, cells.unexplored.astype(jnp.uint8)
    known = (*(np.array(x) for x in arrays), np.float32(state.voxel_size))
    return state, cells, known, tuple(np.array(x) for x in space)


def frame_and_rows(kind: str):
    views = [view_at(kind, pose) for pose in poses_of(2)[:VIEWS]]
    rows = [np.array(row_of(view, CAMERA.focal, CONFIG)) for view in views]
    return views, (views[0].wraps, views[0].shape), np.stack(rows)


@functools.cache
def expected(kind: str, sample: int = 1):
    """Sums, cells, and means in pixels of every view, by the reference."""
    config = dataclasses.replace(CONFIG, sample=sample)
    state, cells, *_ = asked()
    views, *_ = frame_and_rows(kind)

    @jax.jit
    def look(view, position):
        at = position, CAMERA.focal, config
        sums = reference.sums_in_view(state, cells, view, *at, NUM_BINS[kind])
        return *sums, reference.mean_in_pixels(state, view, *at[:2], CONFIG.forms)

    answers = [look(v, p[:3, 3]) for v, p in zip(views, poses_of(2), strict=False)]
    return [np.stack([np.array(x) for x in part]) for part in zip(*answers, strict=True)]


def bins_of(state) -> np.ndarray:
    return fibonacci_lattice(state.num_bins).astype(np.float32)


def sums_agree(
    modules: Modules,
    kind: str = "panorama",
    num: int = VIEWS,
    way: str = "sums_of_many",
    sample: int = 1,
) -> None:
    state, _, known, space = asked()
    _, frame, rows = frame_and_rows(kind)
    bins = NUM_BINS[kind]
    table = np.ascontiguousarray(nearest_bin_table(bins).T)
    tables = bins_of(state), table, fibonacci_lattice(bins).astype(np.float32)
    none = np.empty((num, 0), np.uint8)
    results = (*np.empty((2, num, bins), np.float32), none, none)
    add_up = getattr(modules["sums"], way)
    add_up(known, space, rows[:num], frame, (False, False, sample), tables, 2, results)
    deficits, unexplored = (part[:num] for part in expected(kind, sample)[:2])
    np.testing.assert_allclose(sample * results[0], deficits, atol=1e-4 * deficits.max())
    np.testing.assert_array_equal(results[1], unexplored)


def few_agree(modules: Modules) -> None:
    """Without an index, by two threads that share the views' work."""
    sums_agree(modules, num=2, way="sums_of_few")


def samples_agree(modules: Modules) -> None:
    """One of four voxels is scored, and all of them hide what is behind them."""
    sums_agree(modules, sample=4)


def few_samples_agree(modules: Modules) -> None:
    sums_agree(modules, num=2, way="sums_of_few", sample=4)


def images_agree(modules: Modules, kind: str = "pinhole") -> None:
    state, _, known, _ = asked()
    _, frame, rows = frame_and_rows(kind)
    results = np.empty(VIEWS, np.float32), np.empty((VIEWS, 0), np.int32)
    modules["pixels"].pixels_pass(known, rows, frame, (False, False), bins_of(state), 2, results)
    np.testing.assert_allclose(results[0], expected(kind)[2], atol=1e-4)


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
    found = [picture.stands_for(*pixel, (size, size), True) for pixel in ring]
    np.testing.assert_array_equal(found, expected)


def in_images(modules: Modules) -> None:
    sums_agree(modules, "pinhole")


def points_lie_in_their_bricks(modules: Modules) -> None:
    """Each once, in the order that they had, as far from the middle as is said at most."""
    sort = modules["bricks"].sorted_points
    points = np.random.default_rng(0).uniform(-4.0, 3.0, (3, 500)).astype(np.float32)
    points[:, 400:] = np.float32([2.4, -3.2, 0.8])[:, None]  # many in one place, on edges
    for most in (1 << 12, 5):
        order, starts, spheres = sort(points, most)
        np.testing.assert_array_equal(np.sort(order), np.arange(500))
        assert 1 <= len(spheres) == len(starts) - 1 <= most
        for i, (*middle, radius) in enumerate(spheres):
            own = order[starts[i] : starts[i + 1]]
            assert len(own) > 0
            assert (np.diff(own) > 0).all()
            assert np.linalg.norm(points[:, own].T - middle, axis=1).max() <= radius
        assert radius < (1.0 if most > 5 else 12.0)  # edges of 0.8 and 12.8 m
    for odd in (points[:, :0], np.full((3, 2), np.nan, np.float32)):
        order, starts, spheres = sort(odd, 8)
        assert order.tolist() == list(range(odd.shape[1]))
        assert starts.tolist() == [0, odd.shape[1]]
        np.testing.assert_array_equal(spheres, [[0.0, 0.0, 0.0, np.inf]])


def terms_agree(modules: Modules) -> None:
    state, _, known, _ = asked()
    position = poses_of(2)[0, :3, 3]
    points = np.append(np.array(position), CAMERA.focal).astype(np.float32)[None]
    results = tuple(np.empty((modules["rows"].NUM_TERMS, 1, state.capacity), np.float32))
    modules["rows"].rows_pass(known, points, (False, False), bins_of(state), 2, results)
    terms = jax.jit(score_voxels)(state, position, CAMERA.focal)
    for found, (name, term) in zip(results, vars(terms).items(), strict=True):
        np.testing.assert_allclose(found[0], term, atol=1e-4, err_msg=name)


def changes_agree(modules: Modules) -> None:
    (before, after), kept = known_after(2)
    positions, bins = poses_of(2)[:2, :3, 3], CONFIG.panorama_bins
    some = [np.array(bits[:2]) for bits in kept]
    known = [
        (*(np.array(x) for x in (m.key, m.visited, m.count, m.m2, m.resolution)),
         np.float32(m.voxel_size))
        for m in (before[0], after[0])
    ]  # fmt: skip
    space = [np.array(x) for x in (before[1].x, before[1].y, before[1].z)]
    explored = np.array(before[1].unexplored & ~after[1].unexplored, np.uint8)
    points = np.float32([[*position, float(CAMERA.focal)] for position in positions.tolist()])
    table = np.ascontiguousarray(nearest_bin_table(bins).T)
    tables = bins_of(before[0]), table, fibonacci_lattice(bins).astype(np.float32)
    results = np.empty((2, bins), np.float32), np.empty((2, bins), np.float32)
    modules["changes"].changes_pass(
        *known, (*space, explored), some, points, (False, False), tables, results
    )
    one = lambda bits, position: reference.change_of_sums(
        before, after, bits, position, CAMERA.focal, CONFIG.forms, bins
    )
    change, explored = jax.jit(jax.vmap(one))(some, positions)
    np.testing.assert_allclose(results[0], change, atol=1e-4)
    np.testing.assert_array_equal(results[1], explored)


LAWS = (
    borders_agree, points_lie_in_their_bricks, sums_agree, few_agree, samples_agree,
    few_samples_agree, in_images, images_agree, images_all_round, terms_agree, changes_agree,
)  # fmt: skip


@pytest.mark.parametrize("law", LAWS)
def test_the_laws_hold(law):
    law(load(CHAIN))
