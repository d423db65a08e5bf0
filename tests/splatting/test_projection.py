"""EWA projection against float64 matrices, and its symmetries."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from r3jax.geometry.cameras import Camera
from r3jax.splatting import projection
from r3jax.splatting.projection import project_gaussians
from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene
from tests.splatting.clouds import random_cloud, view

COUNT = 120
SIZE = (48, 34)


def run(scene: GaussianScene, camera: Camera, pose):
    """Projects with the given modules; numpy float64 out."""
    zeros = jnp.zeros((scene.capacity, 2))
    project = jax.jit(projection.project_gaussians)
    found = project(scene, camera, jnp.asarray(pose, dtype=jnp.float32), zeros)
    return jax.tree.map(lambda x: np.asarray(x, dtype=np.float64), found)


def expected_covariance(scene, camera, pose) -> np.ndarray:
    """J W S W^T J^T + 0.3 I in float64, [n, 2, 2]; J at the clamped point."""
    T = np.linalg.inv(np.asarray(pose, dtype=np.float64))
    means = np.asarray(scene.means, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]
    R = Rotation.from_quat(np.asarray(scene.quats, np.float64), scalar_first=True).as_matrix()
    S = np.exp(np.asarray(scene.log_scales, dtype=np.float64))
    sigma = np.einsum("nij,nj,nkj->nik", R, S**2, R)
    fx, fy, cx, cy = (float(getattr(camera, name)) for name in ("fx", "fy", "cx", "cy"))
    covariances = []
    for (x, y, z), s in zip(means, sigma, strict=True):
        u = np.clip(x / z, -cx / fx - 0.15 * camera.width / fx, (1.15 * camera.width - cx) / fx)
        v = np.clip(y / z, -cy / fy - 0.15 * camera.height / fy, (1.15 * camera.height - cy) / fy)
        J = np.array([[fx / z, 0.0, -fx * u / z], [0.0, fy / z, -fy * v / z]])
        covariances.append(J @ T[:3, :3] @ s @ T[:3, :3].T @ J.T + 0.3 * np.eye(2))
    return np.stack(covariances)


def test_equals_matrices() -> None:
    """Centers, conics and depths equal those by plain matrices."""
    scene, (camera, pose) = random_cloud(1, COUNT), view(*SIZE)
    found = run(scene, camera, pose)
    front = found.depth > 0.05
    assert front.sum() > 100
    T = np.linalg.inv(np.asarray(pose, dtype=np.float64))
    x, y, z = (np.asarray(scene.means, dtype=np.float64) @ T[:3, :3].T + T[:3, 3]).T
    np.testing.assert_allclose(found.depth, z, atol=1e-5)
    np.testing.assert_allclose(
        found.center[:, front],
        np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])[:, front],
        rtol=1e-4,
        atol=1e-3,
    )
    inverse = np.linalg.inv(expected_covariance(scene, camera, pose))[front]
    expected = np.stack([inverse[:, 0, 0], inverse[:, 0, 1], inverse[:, 1, 1]])
    np.testing.assert_allclose(found.conic[:, front], expected, rtol=2e-3, atol=1e-5)


def test_box_encloses_what_is_visible() -> None:
    """On the edge of the box alpha is below 1/255, but barely so where the ellipse touches it."""
    scene, (camera, pose) = random_cloud(2, COUNT), view(*SIZE)
    found = run(scene, camera, pose)
    drawn = found.reach[0] >= 0
    assert drawn.sum() > 30
    a, b, c = found.conic[:, drawn]
    for half, own, other in ((found.reach[0, drawn], a, c), (found.reach[1, drawn], c, a)):
        # The least s on the line |dx| = half is half^2 (xx - xy^2 / yy) / 2.
        s = 0.5 * half**2 * (own - b * b / other)
        alpha = found.opacity[drawn] * np.exp(-s)
        assert (alpha < 1.0 / 255.0).all()
        solid = found.opacity[drawn] > 0.05
        assert (alpha[solid] > 0.97 / 255.0).all()


def test_culls() -> None:
    """What is behind, beside or too faint is not drawn; what is in the middle is."""
    camera, pose = view(*SIZE)
    back, right, forward = (np.asarray(pose)[:3, i] for i in (3, 0, 2))
    means = np.stack(
        [back + 2 * forward, back - 2 * forward, back + 2 * forward + 9 * right, back + 2 * forward]
    )
    scene = GaussianScene(
        means=jnp.asarray(means, dtype=jnp.float32),
        quats=jnp.tile(jnp.asarray([1.0, 0.0, 0.0, 0.0]), (4, 1)),
        log_scales=jnp.full((4, 3), -4.0),
        opacity_logits=jnp.asarray([1.0, 1.0, 1.0, DEAD_LOGIT]),
        sh=jnp.zeros((4, 1, 3)),
    )
    drawn = run(scene, camera, pose).reach[0] >= 0
    assert drawn.tolist() == [True, False, False, False]


@given(turn=st.tuples(*[st.floats(-3, 3)] * 3), shift=st.tuples(*[st.floats(-5, 5)] * 3))
def test_moving_world_and_camera_together_changes_nothing(turn, shift):
    scene, (camera, pose) = random_cloud(3, COUNT, sh_degree=0), view(*SIZE)
    motion = np.eye(4)
    R = Rotation.from_rotvec(turn)
    motion[:3, :3], motion[:3, 3] = R.as_matrix(), shift
    own = Rotation.from_quat(np.asarray(scene.quats), scalar_first=True)
    moved = GaussianScene(
        means=jnp.asarray(R.apply(np.asarray(scene.means)) + shift, dtype=jnp.float32),
        quats=jnp.asarray((R * own).as_quat(scalar_first=True), dtype=jnp.float32),
        log_scales=scene.log_scales,
        opacity_logits=scene.opacity_logits,
        sh=scene.sh,
    )
    before, after = run(scene, camera, pose), run(moved, camera, motion @ pose)
    both = (before.depth > 0.3) & (before.reach[0] >= 0) & (after.reach[0] >= 0)
    np.testing.assert_allclose(after.depth, before.depth, atol=1e-4)
    np.testing.assert_allclose(after.center[:, both], before.center[:, both], atol=2e-2)
    np.testing.assert_allclose(after.conic[:, both], before.conic[:, both], rtol=1e-2, atol=1e-3)
    np.testing.assert_array_equal(after.color, before.color)


def test_gradients_are_finite_for_awkward_gaussians():
    """Zero quaternions, centers at and behind the camera, dead rows."""
    camera, pose = view(*SIZE)
    scene = random_cloud(4, COUNT)
    scene = GaussianScene(
        means=scene.means.at[0].set(pose[:3, 3]).at[1].set(pose[:3, 3] - pose[:3, 2]),
        quats=scene.quats.at[2].set(0.0),
        log_scales=scene.log_scales.at[3].set(-30.0),
        opacity_logits=scene.opacity_logits.at[4].set(DEAD_LOGIT),
        sh=scene.sh,
    )

    def total(scene, pose):
        found = project_gaussians(scene, camera, pose, jnp.zeros((COUNT, 2)))
        drawn = found.is_drawn[None, :]
        parts = (found.center, found.conic, found.depth[None], found.opacity[None], found.color)
        return sum(jnp.where(drawn, part, 0.0).sum() for part in parts)

    gradients = jax.jit(jax.grad(total, argnums=(0, 1)))(scene, pose)
    for leaf in jax.tree.leaves(gradients):
        assert np.isfinite(leaf).all()
