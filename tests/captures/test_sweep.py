"""Depth swept from photos: the kernels against their formulas, and depth against known surfaces."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.captures import sweep as formulas
from r3jax.captures.sweep import (
    RADIUS,
    Photo,
    agreed_depth,
    best_planes,
    choose_sources,
    homographies,
    sweep,
)
from r3jax.kernels import sweep as kernels
from r3jax.kernels.constants import NO_SCORE
from tests.apps.audit.room import pose_at

HEIGHT, WIDTH = 24, 32
LENS = np.array([28.0, 28.0, WIDTH / 2, HEIGHT / 2])
PLANES = np.linspace(0.2, 1.2, 9).astype(np.float32)


def texture(points: np.ndarray) -> np.ndarray:
    """Brightness in [0, 1] of points: waves of several lengths, different everywhere."""
    rng = np.random.default_rng(3)
    waves = rng.normal(size=(3, 12)) * np.geomspace(2.0, 14.0, 12)
    return 0.5 + 0.5 * np.tanh(np.sin(points @ waves + rng.uniform(0, 6, 12)).sum(axis=-1) / 2)


def wall_photo(pose: np.ndarray, *, textured: bool = True) -> tuple[Photo, np.ndarray]:
    """A photo of the wall x = 2, and its depth."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    fx, fy, cx, cy = LENS
    rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], -1) @ pose[:3, :3].T
    depth = (2.0 - pose[0, 3]) / rays[..., 0]
    points = pose[:3, 3] + depth[..., None] * rays
    gray = texture(points) if textured else np.full_like(u, 0.5)
    return Photo(gray.astype(np.float32), LENS, pose), depth


def poses() -> list[np.ndarray]:
    """Side by side before the wall, all towards its middle."""
    return [pose_at([0.1 * (i % 2), 0.15 * i, 0.1 * (i % 3)], [2.0, 0.3, 0.0]) for i in range(6)]


@settings(max_examples=5)
@given(seed=st.integers(0, 99), num=st.integers(2, 5))
def test_the_kernel_compares_as_the_formula_does(seed, num):
    rng = np.random.default_rng(seed)
    chosen = rng.choice(6, num + 1, replace=False)
    reference, *sources = [wall_photo(poses()[i])[0] for i in chosen]
    plain = reference.gray.copy()
    plain[: HEIGHT // 3] = 0.5  # without texture
    where = homographies(reference, sources)
    stack = np.stack([source.gray for source in sources])
    sizes = np.array([source.gray.shape for source in sources], np.int64)
    found = kernels.plane_scores(plain, stack, sizes, where.A, where.b, PLANES)
    by_formula = formulas.plane_scores(*map(jnp.asarray, (plain, stack, where.A, where.b, PLANES)))
    by_formula = np.asarray(by_formula)
    # At the rim of a source, or of what counts as texture, rounding decides.
    is_off = np.abs(found - by_formula) > 2e-3
    assert is_off.mean() < 0.01
    assert (found[: HEIGHT // 3 - RADIUS] == NO_SCORE).all()
    assert (found > 0.5).any()
    small, large = np.float32(0.1), np.float32(0.6)
    smooth = kernels.smooth_scores(found, small, large)
    np.testing.assert_allclose(
        smooth, formulas.smooth_scores(jnp.asarray(found), jnp.float32(0.1), jnp.float32(0.6)),
        atol=1e-4,
    )  # fmt: skip


def test_a_source_smaller_than_the_others_counts_as_it_is():
    photos = [wall_photo(pose)[0] for pose in poses()[:3]]
    where = homographies(photos[0], photos[1:])
    sizes = np.array([photo.gray.shape for photo in photos[1:]], np.int64)
    stack = np.stack([photo.gray for photo in photos[1:]])
    padded = np.pad(stack, ((0, 0), (0, 5), (0, 7)), constant_values=0.9)
    arguments = sizes, where.A, where.b, PLANES
    np.testing.assert_array_equal(
        kernels.plane_scores(photos[0].gray, stack, *arguments),
        kernels.plane_scores(photos[0].gray, padded, *arguments),
    )


@pytest.fixture(scope="module")
def wall():
    found = [wall_photo(pose) for pose in poses()]
    return [photo for photo, _ in found], [depth for _, depth in found]


def points_of(photos, depths):
    """A few points that a photo shows, as a structure from motion has them."""

    def of(index):
        rows, columns = np.meshgrid([4, 12, 20], [5, 16, 27], indexing="ij")
        z = depths[index][rows, columns].reshape(-1)
        fx, fy, cx, cy = LENS
        x, y = (columns.reshape(-1) + 0.5 - cx) / fx, (rows.reshape(-1) + 0.5 - cy) / fy
        pose = photos[index].pose
        return (z * np.stack([x, y, np.ones_like(x)])).T @ pose[:3, :3].T + pose[:3, 3]

    return of


def test_a_textured_wall_is_where_it_is(wall):
    photos, depths = wall
    found = sweep(photos, points_of(photos, depths))
    kept = np.stack(found) > 0.0
    off = np.abs(np.stack(found) / np.stack(depths) - 1.0)[kept]
    assert kept.mean() > 0.4
    assert np.median(off) < 0.01
    assert np.percentile(off, 95) < 0.05


def test_a_plain_wall_is_not_known(wall):
    _, depths = wall
    photos = [wall_photo(pose, textured=False)[0] for pose in poses()]
    assert not np.stack(sweep(photos, points_of(photos, depths))).any()


def test_sources_see_the_same_points_from_a_little_aside(wall):
    photos, depths = wall
    away = photos[0]._replace(pose=pose_at([0.0, 0.0, 0.0], [-2.0, 0.0, 0.0]))
    same = photos[0]._replace(pose=photos[0].pose)
    chosen = choose_sources([*photos, away, same], points_of([*photos, away, same], [*depths] * 2))
    assert 6 not in chosen[0]
    assert 0 not in chosen[0]
    # Who stands on the same spot says nothing of depth, and goes last.
    assert 7 not in chosen[0][:4]


def test_depth_is_kept_where_two_others_agree(wall):
    photos, depths = wall
    exact = [depth.astype(np.float32) for depth in depths]
    others = np.arange(1, 6)
    kept = agreed_depth(0, exact, photos, others)
    is_kept = kept > 0.0
    assert is_kept.mean() > 0.8
    np.testing.assert_allclose(kept[is_kept], exact[0][is_kept], rtol=2e-2)
    alone = [exact[0], exact[1], *(np.zeros_like(depth) for depth in exact[2:])]
    assert not agreed_depth(0, alone, photos, others).any()
    moved = [1.2 * exact[0], *exact[1:]]
    assert not agreed_depth(0, moved, photos, others).any()


@given(peak=st.floats(2.0, 6.0), height=st.floats(0.5, 2.0))
def test_the_parabola_finds_a_peak_between_planes(peak, height):
    scores = height - 0.1 * (np.arange(9) - peak) ** 2
    inverse, _ = best_planes(scores[None, None], PLANES)
    step = PLANES[1] - PLANES[0]
    assert inverse[0, 0] == pytest.approx(PLANES[0] + peak * step, abs=1e-4)
