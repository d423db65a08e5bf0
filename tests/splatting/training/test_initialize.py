"""Initial Gaussians: on the recorded surfaces, as many as asked for, in the recorded colors."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial import KDTree

from r3jax.formats.recordings import read_recording
from r3jax.geometry.cameras import Camera, look_at, transform, unproject
from r3jax.kernels.constants import SH0
from r3jax.splatting.errors import ViewsError
from r3jax.splatting.training import initialize as initialize_module
from r3jax.splatting.training.initialize import (
    fitting_voxel_size,
    initialize,
    neighbor_scales,
    surface_points,
    thin,
)
from r3jax.splatting.views import Views, load_views

CAMERA = Camera(64, 48, 50.0, 52.0, 30.0, 25.0)
FLOOR, WALL = np.array([200, 60, 40]), np.array([30, 90, 220])


def room_views(num: int = 4, wall: float = 2.0) -> Views:
    """A red floor z = 0 and a blue wall x = `wall` behind it, seen from `num` places.

    Worked out by hand: the depth of the nearer plane along each ray, in float64.
    """
    columns, rows = np.meshgrid(np.arange(64) + 0.5, np.arange(48) + 0.5)
    rays = np.stack([(columns - 30.0) / 50.0, (rows - 25.0) / 52.0, np.ones_like(rows)], axis=-1)
    rgb, depth, poses = [], [], []
    for i in range(num):
        position = np.array([-1.0, -0.6 + 0.4 * i, 1.2])
        pose = np.asarray(look_at(position, np.array([1.5, 0.0, 0.3])), dtype=np.float64)
        world = rays @ pose[:3, :3].T
        to_floor = np.where(world[..., 2] < 0.0, -position[2] / world[..., 2], np.inf)
        to_wall = np.where(world[..., 0] > 0.0, (wall - position[0]) / world[..., 0], np.inf)
        depth.append(np.minimum(to_floor, to_wall))
        rgb.append(np.where((to_floor < to_wall)[..., None], FLOOR, WALL))
        poses.append(pose)
    return views_of(np.stack(rgb), np.stack(depth), np.stack(poses))


def views_of(rgb: np.ndarray, depth: np.ndarray, poses: np.ndarray) -> Views:
    return Views(
        rgb=jnp.asarray(rgb, dtype=jnp.uint8),
        depth=jnp.asarray(depth, dtype=jnp.float32),
        T_world_camera=jnp.asarray(poses, dtype=jnp.float32),
        cameras=jax.tree.map(lambda x: jnp.full(len(rgb), x), CAMERA),
    )


def alive(scene, values) -> np.ndarray:
    return np.asarray(values)[np.asarray(scene.is_alive)]


def test_surfaces() -> None:
    """Every Gaussian lies on its plane, in the plane's color, and no plane is left out."""
    views = room_views()
    scene = initialize_module.initialize(views, 900, 1000)
    means, color = alive(scene, scene.means), 0.5 + SH0 * alive(scene, scene.sh[:, 0])
    on_floor, on_wall = np.abs(means[:, 2]) < 2e-5, np.abs(means[:, 0] - 2.0) < 2e-5
    # A voxel in the corner holds points of both planes.
    mixed = ~on_floor & ~on_wall
    assert mixed.mean() < 0.1
    assert on_floor.sum() > 200
    assert on_wall.sum() > 200
    plain = [(FLOOR, on_floor & (means[:, 0] < 1.9)), (WALL, on_wall & (means[:, 2] > 0.1))]
    for expected, mask in plain:
        assert np.abs(color[mask] * 255.0 - expected).max() < 0.1
    np.testing.assert_array_equal(alive(scene, scene.sh)[:, 1:], 0.0)
    np.testing.assert_array_equal(alive(scene, scene.quats), [[1.0, 0.0, 0.0, 0.0]] * len(means))
    opacity = jax.nn.sigmoid(scene.opacity_logits)[scene.is_alive]
    np.testing.assert_allclose(opacity, 0.1, rtol=1e-6)


def test_thinning() -> None:
    """Means over voxels, against a dictionary; in voxels of 1/4 m and steps of 1/16 m."""

    @given(st.integers(0, 2**32 - 1), st.integers(1, 60))
    def check(seed, count):
        rng = np.random.default_rng(seed)
        points = rng.integers(-20, 20, (count, 3)) / 16.0
        colors = rng.random((count, 3))
        members: dict[tuple, list[int]] = {}
        for i, corner in enumerate(np.floor((points - points.min(0)) / 0.25)):
            members.setdefault(tuple(corner), []).append(i)
        groups = [members[corner] for corner in sorted(members)]
        found_points, found_colors = initialize_module.thin(points, colors, 0.25)
        expected = np.stack([points[group].mean(0) for group in groups])
        np.testing.assert_allclose(found_points, expected, atol=1e-12)
        expected = np.stack([colors[group].mean(0) for group in groups])
        np.testing.assert_allclose(found_colors, expected, atol=1e-12)

    check()


def test_scales() -> None:
    """All distances, squared, sorted: the root of the mean of three, within limits."""

    @given(st.integers(0, 2**32 - 1), st.integers(2, 30))
    def check(seed, count):
        rng = np.random.default_rng(seed)
        points = rng.normal(size=(count, 3)) * rng.choice([0.01, 1.0, 30.0], (count, 1))
        found = initialize_module.neighbor_scales(points)
        squared = ((points[:, None] - points[None]) ** 2).sum(-1)
        nearest = np.sort(squared, axis=1)[:, 1:4]
        exact = np.sqrt(nearest.mean(axis=1))
        typical = np.median(exact)
        np.testing.assert_allclose(found, exact.clip(typical / 5.0, typical * 5.0), rtol=1e-6)

    check()


def test_points_are_the_unprojected_pixels():
    views = room_views(2)
    points, colors = surface_points(views)
    expected = [
        transform(view.T_world_camera, unproject(view.camera, view.depth)).reshape(-1, 3)
        for view in (views.view(0), views.view(1))
    ]
    distance, index = KDTree(np.concatenate(expected)).query(points)
    assert distance.max() < 1e-5
    np.testing.assert_allclose(colors * 255.0, views.rgb.reshape(-1, 3)[index], atol=1e-3)


def test_edges() -> None:
    """A step in depth costs the pixels on both sides of it and no others; a hole costs none."""
    depth = np.full((2, 48, 64), 2.0)
    depth[0, :, 40:] = 4.0
    depth[1, 20:24, 10:15] = 0.0
    depth[1, :3, :3] = np.inf
    poses = np.stack([np.eye(4), np.eye(4)])
    views = views_of(np.zeros((2, 48, 64, 3)), depth, poses)
    points = initialize_module.surface_points(views)[0]
    steps = 48 * 64 - 2 * 48
    assert len(points) == steps + (48 * 64 - 4 * 5 - 9 - 6)
    column = points[:steps, 0] / points[:steps, 2] * 50.0 + 30.0
    assert not ((column > 39.0) & (column < 41.0)).any()


def test_where_all_pixels_are_edges_they_are_used_after_all():
    rows, columns = np.indices((48, 64))
    depth = np.where((rows + columns) % 2, 1.0, 3.0)
    views = views_of(np.zeros((2, 48, 64, 3)), np.stack([depth] * 2), np.stack([np.eye(4)] * 2))
    assert len(surface_points(views)[0]) == depth.size * 2


@pytest.mark.parametrize("target", [1, 2, 30, 300, 3000])
def test_about_as_many_as_asked(target):
    scene = initialize(room_views(), target)
    assert 0.8 * target <= scene.capacity <= target
    assert bool(scene.is_alive.all())


@given(st.integers(0, 2**32 - 1), st.integers(1, 400), st.sampled_from([0.01, 1.0, 1e4]))
def test_never_more_than_asked_in_any_cloud(seed, target, size):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(500, 3)) ** 3 * size
    found = thin(points, points, fitting_voxel_size(points, target))[0]
    assert 1 <= len(found) <= target
    if size >= 1.0:
        assert len(found) >= 0.7 * target


def test_identical_points_are_one_gaussian():
    points = np.ones((10, 3))
    size = fitting_voxel_size(points, 5)
    assert len(thin(points, points, size)[0]) == 1
    np.testing.assert_array_equal(neighbor_scales(np.ones((1, 3))), [0.05])
    coinciding = neighbor_scales(np.ones((5, 3)))
    assert np.isfinite(np.log(coinciding)).all()


def test_voxels_in_metres():
    views = room_views()
    scene = initialize(views, 7, voxel_size=0.25)
    points, colors = surface_points(views)
    assert scene.capacity == len(thin(points, colors, 0.25)[0]) > 7
    spacing = np.exp(np.asarray(scene.log_scales))
    assert 0.1 < np.median(spacing) < 0.4


def test_the_same_input_gives_the_same_scene_and_unused_rows_are_dead():
    first, second = (initialize(room_views(), 500, 800, 2) for _ in range(2))
    assert jax.tree.all(jax.tree.map(lambda a, b: (a == b).all(), first, second))
    assert first.capacity == 800
    assert first.sh_degree == 2
    count = int(first.is_alive.sum())
    assert 400 <= count <= 500
    assert bool(first.is_alive[:count].all())
    assert jax.tree.all(jax.tree.map(lambda x: jnp.isfinite(x).all(), first))
    assert float(jax.nn.sigmoid(first.opacity_logits[count:]).max()) == 0.0


def test_of_very_many_pixels_each_view_lends_another_part(monkeypatch):
    views = room_views(4)
    everything = surface_points(views)[0]
    monkeypatch.setattr("r3jax.splatting.training.initialize._MAX_POINTS", views.depth.size // 4)
    part = surface_points(views)[0]
    assert 0.2 * len(everything) < len(part) < 0.3 * len(everything)
    # One place seen four times: the four parts together are the whole picture.
    still = views_of(
        np.asarray(views.rgb)[[0] * 4],
        np.asarray(views.depth)[[0] * 4],
        np.asarray(views.T_world_camera)[[0] * 4],
    )
    monkeypatch.setattr("r3jax.splatting.training.initialize._MAX_POINTS", 10**9)
    whole = surface_points(jax.tree.map(lambda x: x[:1], still))[0]
    monkeypatch.setattr("r3jax.splatting.training.initialize._MAX_POINTS", views.depth.size // 4)
    parts = surface_points(still)[0]
    order = lambda points: points[np.lexsort(points.T)]
    np.testing.assert_array_equal(order(parts), order(whole))


def test_without_depth_only_a_key_helps():
    views = room_views()
    for nothing in (0.0, np.inf):
        blind = views_of(
            np.asarray(views.rgb),
            np.full(views.depth.shape, nothing),
            np.asarray(views.T_world_camera),
        )
        with pytest.raises(ViewsError, match="4 views"):
            initialize(blind, 100)
        scene = initialize(blind, 100, 120, key=jax.random.key(3))
        assert int(scene.is_alive.sum()) == 100
        assert jax.tree.all(jax.tree.map(lambda x: jnp.isfinite(x).all(), scene))
        means = alive(scene, scene.means)
        centers = np.asarray(views.T_world_camera[:, :3, 3])
        assert (means.min(0) < centers.min(0) + 0.3).all()
        assert means[:, 0].max() > 0.0  # ahead of the cameras, which look along x
        color = 0.5 + SH0 * alive(scene, scene.sh[:, 0])
        mean = np.asarray(views.rgb).mean((0, 1, 2)) / 255.0
        np.testing.assert_allclose(color, np.broadcast_to(mean, color.shape), atol=1e-5)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"num_gaussians": 0}, "got 0 and 3"),
        ({"sh_degree": 4}, "100000 and 4"),
        ({"voxel_size": 0.0}, "voxel_size"),
        ({"voxel_size": float("nan")}, "voxel_size"),
        ({"voxel_size": 1e-7}, "too small for points that span"),
        ({"num_gaussians": 500, "capacity": 100}, "capacity of 100"),
    ],
)
def test_bad_settings(arguments, message):
    with pytest.raises(ValueError, match=message):
        initialize(room_views(), **arguments)


def test_a_real_recording(shared):
    recording = read_recording(shared("recordings", "hololens_lounge"))
    views = load_views((recording.frame(i) for i in range(0, len(recording), 8)), 180)
    scene = initialize(views, 5000, 6000)
    assert 4500 <= int(scene.is_alive.sum()) <= 5000
    assert jax.tree.all(jax.tree.map(lambda x: jnp.isfinite(x).all(), scene))
    scales = np.exp(alive(scene, scene.log_scales))
    assert scales.max() <= 5.001 * np.median(scales)
    # Every Gaussian is a mean of pixels: no farther from the nearest than a voxel's diagonal.
    points = surface_points(views)[0]
    size = fitting_voxel_size(points, 5000)
    distance, _ = KDTree(points).query(alive(scene, scene.means))
    assert distance.max() < np.sqrt(3.0) * size
