"""EWA projection of 3D Gaussians to the image (Zwicker et al. 2001, Kerbl et al. 2023), and colors.

Structure of arrays, the long axis last: XLA's CPU loops run along it. The real spherical harmonics,
up to degree 3, have the order and the signs of 3DGS files.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r3jax.geometry.cameras import Camera, invert_pose
from r3jax.kernels.constants import (
    ALPHA_MIN,
    DILATION,
    FRUSTUM_MARGIN,
    NEAR_PLANE,
    SH0,
    SH1,
    SH2,
    SH3,
)
from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene


class ProjectedGaussians(eqx.Module):
    """The projection of each Gaussian for one camera."""

    center: Float[Array, "2 n"]
    """Column and row [px]."""

    conic: Float[Array, "3 n"]
    """Inverse of the projected covariance: xx, xy, yy [1/px^2]."""

    depth: Float[Array, " n"]
    """z-depth of the center [m]."""

    opacity: Float[Array, " n"]
    """In [0, 1]."""

    color: Float[Array, "3 n"]
    """RGB, at least 0."""

    reach: Float[Array, "2 n"]
    """Half width and half height [px] of the box outside which alpha < 1/255; -1 where the
    Gaussian is not drawn. Carries no gradient."""

    @property
    def is_drawn(self) -> Bool[Array, " n"]:
        """True where the Gaussian may touch a pixel."""
        return self.reach[0] >= 0.0


def project_gaussians(
    scene: GaussianScene,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    center_offsets: Float[Array, "n 2"],
) -> ProjectedGaussians:
    """Projects every Gaussian and evaluates its color.

    Args:
        scene: the Gaussians.
        camera: intrinsics.
        T_world_camera: camera-to-world pose.
        center_offsets: added to the projected centers [px]; zeros, to differentiate by.

    Returns:
        All Gaussians; those outside the image, nearer than 0.01 m or with a parameter that is
        not a number are marked as not drawn.
    """
    scene = without_nans(scene)
    T_camera_world = invert_pose(T_world_camera)
    x, y, z = _in_camera(scene.means, T_camera_world)
    z_safe = jnp.where(z > NEAR_PLANE, z, 1.0)
    cov = _image_covariance(scene, camera, T_camera_world[:3, :3], x, y, z_safe)
    a, b, c = cov
    determinant = a * c - b * b
    determinant_safe = jnp.where(determinant > 0.0, determinant, 1.0)
    conic = jnp.stack([c, -b, a]) / determinant_safe[None, :]
    center = jnp.stack(
        [
            camera.fx * x / z_safe + camera.cx + center_offsets[:, 0],
            camera.fy * y / z_safe + camera.cy + center_offsets[:, 1],
        ]
    )
    opacity = jax.nn.sigmoid(scene.opacity_logits)
    color = view_colors(scene.sh, scene.means, T_world_camera[:3, 3])
    has_color = jnp.isfinite(color).all(axis=0)
    valid = (z > NEAR_PLANE) & (determinant > 0.0) & has_color
    return ProjectedGaussians(
        center=center,
        conic=conic,
        depth=z,
        opacity=opacity,
        color=jnp.where(has_color[None, :], color, 0.0),
        reach=jax.lax.stop_gradient(_reach(camera, center, a, c, opacity, valid)),
    )


def without_nans(scene: GaussianScene) -> GaussianScene:
    """Moves Gaussians with NaN shape, position or opacity out of view.

    Not drawing them is not enough: 0 x NaN would make the gradient of the pose NaN.
    """
    valid = ~jnp.isnan(scene.opacity_logits)
    for x in (scene.means, scene.quats, scene.log_scales):
        valid &= jnp.isfinite(x).all(axis=1)
    return GaussianScene(
        means=jnp.where(valid[:, None], scene.means, 0.0),
        quats=jnp.where(valid[:, None], scene.quats, 1.0),
        log_scales=jnp.where(valid[:, None], scene.log_scales, 0.0),
        opacity_logits=jnp.where(valid, scene.opacity_logits, DEAD_LOGIT),
        sh=scene.sh,
    )


def _in_camera(means: Float[Array, "n 3"], T: Float[Array, "4 4"]) -> tuple[Array, Array, Array]:
    """Computes coordinates in the camera's frame [m], one array each."""
    mx, my, mz = means[:, 0], means[:, 1], means[:, 2]
    x, y, z = (T[i, 0] * mx + T[i, 1] * my + T[i, 2] * mz + T[i, 3] for i in range(3))
    return x, y, z


def _image_covariance(
    scene: GaussianScene, camera: Camera, R: Float[Array, "3 3"], x: Array, y: Array, z: Array
) -> tuple[Array, Array, Array]:
    """Computes J W S W^T J^T + 0.3 I as (xx, xy, yy) [px^2], with J the Jacobian of the projection.

    J is taken at a point at most 30 % of half the image outside the image: further out the
    linearization means nothing and would smear Gaussians over the whole image.
    """
    rotation = rotation_rows(scene.quats)
    scales = [jnp.exp(scene.log_scales[:, i]) for i in range(3)]
    margin_x = FRUSTUM_MARGIN * 0.5 * camera.width / camera.fx
    margin_y = FRUSTUM_MARGIN * 0.5 * camera.height / camera.fy
    right, lower = (camera.width - camera.cx) / camera.fx, (camera.height - camera.cy) / camera.fy
    u = jnp.clip(x / z, -camera.cx / camera.fx - margin_x, right + margin_x)
    v = jnp.clip(y / z, -camera.cy / camera.fy - margin_y, lower + margin_y)
    fx_z, fy_z = camera.fx / z, camera.fy / z
    # Rows of J R (2x3), then their products with the Gaussian's scaled axes.
    row_x = [fx_z * (R[0, i] - u * R[2, i]) for i in range(3)]
    row_y = [fy_z * (R[1, i] - v * R[2, i]) for i in range(3)]
    along_x = [scales[j] * sum(row_x[i] * rotation[i][j] for i in range(3)) for j in range(3)]
    along_y = [scales[j] * sum(row_y[i] * rotation[i][j] for i in range(3)) for j in range(3)]
    xx = sum(p * p for p in along_x) + DILATION
    xy = sum(p * q for p, q in zip(along_x, along_y, strict=True))
    yy = sum(q * q for q in along_y) + DILATION
    return jnp.asarray(xx), jnp.asarray(xy), jnp.asarray(yy)


def rotation_rows(quats: Float[Array, "n 4"]) -> list[list[Array]]:
    """Computes rotation matrices of quaternions wxyz of any length, as 3x3 lists of [n] arrays."""
    squared = sum(quats[:, i] * quats[:, i] for i in range(4))
    inverse = 1.0 / jnp.sqrt(jnp.where(squared > 0.0, squared, 1.0))
    w, x, y, z = (quats[:, i] * inverse for i in range(4))
    return [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]


def _reach(
    camera: Camera, center: Array, xx: Array, yy: Array, opacity: Array, valid: Array
) -> Float[Array, "2 n"]:
    """Computes the exact box of the ellipse on which alpha = 1/255.

    There o exp(-s) = 1/255, with s = d^T conic d / 2.

    The largest |dx| on the ellipse s = s_max is sqrt(2 s_max cov_xx).
    """
    s_max = jnp.log(jnp.maximum(opacity, ALPHA_MIN) / ALPHA_MIN)
    # Slightly larger, so that rounding never cuts off a pixel.
    reach = 1e-3 + jnp.sqrt(2.002 * s_max[None, :] * jnp.stack([xx, yy]))
    size = jnp.array([[camera.width], [camera.height]], dtype=jnp.float32)
    inside = ((center + reach > 0.0) & (center - reach < size)).all(axis=0)
    drawn = valid & inside & (opacity >= ALPHA_MIN)
    return jnp.where(drawn[None, :], reach, -1.0)


def harmonics(
    x: Float[Array, " n"], y: Float[Array, " n"], z: Float[Array, " n"], degree: int
) -> list[Float[Array, " n"]]:
    """Computes the (degree + 1)^2 basis functions at unit directions (x, y, z)."""
    basis = [jnp.full_like(x, SH0)]
    if degree >= 1:
        basis += [-SH1 * y, SH1 * z, -SH1 * x]
    if degree >= 2:
        xx, yy, zz = x * x, y * y, z * z
        basis += [
            SH2[0] * x * y,
            -SH2[0] * y * z,
            SH2[1] * (2.0 * zz - xx - yy),
            -SH2[0] * x * z,
            SH2[2] * (xx - yy),
        ]
        if degree >= 3:
            basis += [
                -SH3[0] * y * (3.0 * xx - yy),
                SH3[1] * x * y * z,
                -SH3[2] * y * (4.0 * zz - xx - yy),
                SH3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
                -SH3[2] * x * (4.0 * zz - xx - yy),
                SH3[4] * z * (xx - yy),
                -SH3[0] * x * (xx - 3.0 * yy),
            ]
    return basis


def view_colors(
    sh: Float[Array, "n k 3"], means: Float[Array, "n 3"], camera_center: Float[Array, " 3"]
) -> Float[Array, "3 n"]:
    """Computes colors of Gaussians for a camera: max(SH(direction) + 0.5, 0).

    Args:
        sh: coefficients, k = (degree + 1)^2.
        means: centers in the world [m].
        camera_center: in the world [m].

    Returns:
        RGB, one row per channel; it may exceed 1.
    """
    x, y, z = (means[:, i] - camera_center[i] for i in range(3))
    squared = x * x + y * y + z * z
    squared_safe = jnp.where(squared > 0.0, squared, 1.0)
    inverse = jnp.where(squared > 0.0, 1.0 / jnp.sqrt(squared_safe), 0.0)
    return jnp.maximum(_sum_harmonics(sh, x * inverse, y * inverse, z * inverse) + 0.5, 0.0)


@jax.custom_vjp
def _sum_harmonics(
    sh: Float[Array, "n k 3"], x: Float[Array, " n"], y: Float[Array, " n"], z: Float[Array, " n"]
) -> Float[Array, "3 n"]:
    """Sums coefficient x basis at unit directions, for each channel."""
    basis = harmonics(x, y, z, _degree(sh))
    return jnp.stack([sum(b * sh[:, i, c] for i, b in enumerate(basis)) for c in range(3)])


def _sum_harmonics_fwd(
    sh: Array, x: Array, y: Array, z: Array
) -> tuple[Array, tuple[Array, Array, Array, Array]]:
    return _sum_harmonics(sh, x, y, z), (sh, x, y, z)


def _sum_harmonics_bwd(
    residuals: tuple[Array, Array, Array, Array], cotangent: Float[Array, "3 n"]
) -> tuple[Array, Array, Array, Array]:
    # Written out, for autodiff pads each of 48 columns to a whole array and adds them up, which
    # takes seven times as long.
    sh, x, y, z = residuals
    basis, pull_back = jax.vjp(lambda x, y, z: harmonics(x, y, z, _degree(sh)), x, y, z)
    by_sh = jnp.stack(basis, axis=-1)[:, :, None] * cotangent.T[:, None, :]
    # Where nothing depends on the color, the coefficients may be NaN: they are masked.
    rows = jnp.where((cotangent != 0.0).any(axis=0)[:, None, None], sh, 0.0)
    by_basis = [sum(cotangent[c] * rows[:, i, c] for c in range(3)) for i in range(len(basis))]
    return by_sh, *pull_back(by_basis)


_sum_harmonics.defvjp(_sum_harmonics_fwd, _sum_harmonics_bwd)


def _degree(sh: Float[Array, "n k 3"]) -> int:
    return {1: 0, 4: 1, 9: 2, 16: 3}[sh.shape[1]]
