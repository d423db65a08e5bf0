"""Wrong arguments of the public calls: refused by name, or NaN where nothing can be refused."""

from inspect import unwrap

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.geometry.cameras import is_rigid, rigid_error
from r3jax.splatting.scene import empty_scene

SIDE = 16
CAMERA = r3jax.Camera.from_fov(SIDE, SIDE, 60.0)
POSE = np.asarray(r3jax.look_at(np.zeros(3), np.array([1.0, 2.0, 0.5])))
MAP = r3jax.empty_map(capacity=1 << 6)
GRID = r3jax.empty_grid(np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]]))
FRAME = r3jax.Frame(np.zeros((SIDE, SIDE, 3)), np.ones((SIDE, SIDE)), POSE, CAMERA)
SCENE = empty_scene(2, sh_degree=0)
K = np.array([[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]])
POSES = np.stack([POSE] * 3)
STACKED_CAMERAS = jax.tree.map(lambda x: jnp.stack([x] * 3), CAMERA)

WRONG = {
    "stacked poses": (r3jax.renderability, (MAP, CAMERA, POSES), "use jax.vmap over the 3"),
    "stacked poses of an image": (r3jax.renderability_image, (MAP, CAMERA, POSES), "over the 3"),
    "stacked poses of a utility": (r3jax.view_utility, (MAP, GRID, CAMERA, POSES), "over the 3"),
    "stacked poses to explain": (r3jax.explain_view, (MAP, GRID, CAMERA, POSES), "over the 3"),
    "stacked poses to render": (r3jax.render, (SCENE, CAMERA, POSES), "over the 3"),
    "stacked positions": (r3jax.panorama, (MAP, GRID, CAMERA, POSES[:, :3, 3]), "over the 3"),
    "stacked cameras": (r3jax.renderability, (MAP, STACKED_CAMERAS, POSE), "one Camera"),
    "no array": (r3jax.renderability, (MAP, CAMERA, POSE.tolist()), "array .4, 4., got list"),
    "rows left out": (r3jax.renderability, (MAP, CAMERA, POSE[:3]), "4x4 matrix, got shape"),
    "K": (r3jax.renderability, (MAP, K, POSE), r"camera must be an r3jax.Camera .*shape \(3, 3\)"),
    "K of a utility": (r3jax.view_utility, (MAP, GRID, K, POSE), "camera must be"),
    "K of a panorama": (r3jax.panorama, (MAP, GRID, K, POSE[:3, 3]), "camera must be"),
    "K of next views": (r3jax.next_views, (MAP, GRID, K, 2), "camera must be"),
    "K to render": (r3jax.render, (SCENE, K, POSE), "camera must be"),
    "swapped": (r3jax.renderability, (CAMERA, MAP, POSE), "the call is renderability.state, cam"),
    "swapped for a voxel": (r3jax.voxel_renderability, (POSE[:3, 3], MAP), "state must be"),
    "swapped for a frame": (r3jax.integrate, (FRAME, MAP), "state must be an r3jax.MapState"),
    "swapped for points": (r3jax.integrate_points, (POSES, MAP, POSES, POSE), "state must be"),
    "swapped for a row": (r3jax.lookup, (POSES, MAP), "state must be"),
    "swapped to write": (r3jax.write_scene, (SCENE, "x.ply"), "scene must be"),
    "no grid": (r3jax.view_utility, (MAP, None, CAMERA, POSE), "grid must be .* got NoneType"),
    "no grid to explain": (r3jax.explain_view, (MAP, None, CAMERA, POSE), "grid must be"),
    "no grid round about": (r3jax.panorama, (MAP, None, CAMERA, POSE[:3, 3]), "grid must be"),
    "no grid for next views": (r3jax.next_views, (MAP, None, CAMERA, 2), "grid must be"),
    "no grid for depth": (r3jax.integrate_depth, (None, FRAME), "grid must be"),
    "a map for a grid": (r3jax.integrate_depth, (MAP, FRAME), "grid must be"),
    "an image for a frame": (r3jax.integrate, (MAP, K), "frame must be"),
    "points without z": (r3jax.lookup, (MAP, K[:, :2]), "points_world must have shape"),
    "a grid to merge": (r3jax.merge, (MAP, GRID), "b must be an r3jax.MapState"),
    "a number to grow": (r3jax.grow, (1 << 7, MAP), "state must be"),
    "a scene for settings": (r3jax.fit, (SCENE,), "views must be an r3jax.Views"),
    "frames to train on": (r3jax.fit, ([FRAME, FRAME],), "r3jax.load_views"),
    "other settings": (r3jax.renderability, (MAP, CAMERA, POSE, 5.0), "config must be"),
    "a gray background": (r3jax.render, (SCENE, CAMERA, POSE, jnp.ones(1)), "background must"),
    "directions": (
        unwrap(r3jax.pose_along),
        (POSES[:, :3, 3], POSES[:, :3, 2]),
        "position must have",
    ),
    "nowhere to look": (r3jax.look_at, (POSE[:3, 3], POSE[:3, 3]), "the same point"),
    "no direction": (r3jax.pose_along, (POSE[:3, 3], np.zeros(3)), "direction has no length"),
    "a bare frame": (unwrap(r3jax.load_views), (FRAME,), "frames must be several"),
}


@pytest.mark.parametrize(("call", "arguments", "message"), WRONG.values(), ids=WRONG)
def test_arguments_that_cannot_be_meant_are_refused_by_name(call, arguments, message):
    with pytest.raises((TypeError, ValueError), match=message):
        call(*arguments)


def scaled(factor):
    return POSE @ np.diag([factor, factor, factor, 1.0]).astype(np.float32)


def with_entry(row, column, value):
    pose = POSE.copy()
    pose[row, column] = value
    return pose


BAD_POSES = {
    "a NaN": with_entry(0, 1, np.nan),
    "nowhere": with_entry(2, 3, np.inf),
    "a scale of 1 %": scaled(1.01),
    "a scale of 0.5": scaled(0.5),
    "a shear": with_entry(0, 1, POSE[0, 1] + 0.01),
    "mirrored": POSE @ np.diag([1.0, -1.0, 1.0, 1.0]).astype(np.float32),
    "transposed": with_entry(3, 0, 1.0),
    "nothing": np.zeros((4, 4), np.float32),
}
GOOD_POSES = {
    "as it is": POSE,
    "half precision": POSE.astype(np.float16).astype(np.float32),
    "a scale of 0.02 %": scaled(1.0002),
    "far away": with_entry(0, 3, 1e5),
}


def test_a_pose_is_rigid_under_jit_where_it_is_on_the_host():
    poses = {**BAD_POSES, **GOOD_POSES}
    found = jax.jit(jax.vmap(is_rigid))(np.stack(list(poses.values())))
    assert dict(zip(poses, found.tolist(), strict=True)) == {
        name: name in GOOD_POSES for name in poses
    }
    assert {name for name, pose in poses.items() if rigid_error(pose) is None} == set(GOOD_POSES)


def test_half_precision_never_makes_a_pose_less_than_rigid():
    quats = np.random.default_rng(0).normal(size=(4000, 4))
    w, x, y, z = (quats / np.linalg.norm(quats, axis=1, keepdims=True)).T
    R = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    poses = np.tile(np.eye(4, dtype=np.float32), (4000, 1, 1))
    poses[:, :3, :3] = np.moveaxis(R, 2, 0).astype(np.float16)
    assert [p for p in poses if rigid_error(p) is not None] == []


VERBS = {
    "renderability": lambda T: r3jax.renderability(MAP, CAMERA, T),
    "renderability_image": lambda T: r3jax.renderability_image(MAP, CAMERA, T),
    "view_utility": lambda T: r3jax.view_utility(MAP, GRID, CAMERA, T),
    "explain_view": lambda T: r3jax.explain_view(MAP, GRID, CAMERA, T),
    "render": lambda T: r3jax.render(SCENE, CAMERA, T),
    "integrate": lambda T: r3jax.integrate(MAP, r3jax.Frame(FRAME.rgb, FRAME.depth, T, CAMERA)),
    "next_views": lambda T: r3jax.next_views(MAP, GRID, CAMERA, 1, poses=T[None]),
}


@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("pose", ["a NaN", "a scale of 1 %", "mirrored"])
def test_a_pose_that_is_not_rigid_is_refused(verb, pose):
    with pytest.raises(ValueError, match=r"not finite|not rigid|mirrors"):
        VERBS[verb](BAD_POSES[pose])


def scores(T):
    """Every number that a pose takes part in, of maps that it gives too."""
    frame = r3jax.Frame(FRAME.rgb, FRAME.depth, T, CAMERA)
    state, grid = r3jax.integrate(MAP, frame), r3jax.integrate_depth(GRID, frame)
    return {
        "renderability": r3jax.renderability(MAP, CAMERA, T),
        "renderability_image": r3jax.renderability_image(MAP, CAMERA, T),
        "view_utility": r3jax.view_utility(MAP, GRID, CAMERA, T),
        "explain_view": r3jax.explain_view(MAP, GRID, CAMERA, T).totals,
        "map": r3jax.renderability(state, CAMERA, POSE),
        "grid": r3jax.view_utility(MAP, grid, CAMERA, POSE),
    }


@pytest.mark.full
def test_under_jit_a_pose_that_is_not_rigid_gives_nan_and_any_other_a_number():
    poses = {**BAD_POSES, **GOOD_POSES}
    found = jax.jit(jax.vmap(scores))(np.stack(list(poses.values())))
    for leaf in jax.tree.leaves(found):
        is_nan = np.isnan(np.asarray(leaf).reshape(len(poses), -1))
        assert is_nan[: len(BAD_POSES)].all()
        assert not is_nan[len(BAD_POSES) :].any()


def test_under_jit_what_is_not_finite_gives_nan():
    panorama = jax.jit(lambda p: r3jax.panorama(MAP, GRID, CAMERA, p).best_score)
    row = jax.jit(lambda p, f: r3jax.voxel_renderability(MAP, p, f).value)
    assert np.isnan(panorama(np.array([0.0, np.nan, 0.0], np.float32)))
    assert np.isnan(row(np.array([0.0, np.inf, 0.0], np.float32), 500.0)).all()
    assert np.isnan(row(np.zeros(3, np.float32), -1.0)).all()
    with pytest.raises(ValueError, match="position"):
        r3jax.panorama(MAP, GRID, CAMERA, np.array([0.0, np.nan, 0.0]))
    with pytest.raises(ValueError, match="focal"):
        r3jax.voxel_renderability(MAP, np.zeros(3), focal=-1.0)
