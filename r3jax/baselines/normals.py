"""Surface normals of a depth image: planes are linear in inverse depth.

A point (x, y, z) = z (u, v, 1) of the plane n . p = h has 1 / z = (n / h) . (u, v, 1): the
gradient of the inverse depth gives the normal without a bias at any slope. It is fitted to pairs
of pixels on both sides, up to one degree away: neighbors alone would tell nothing (noise of 1 %
is 3 cm at 3 m, where the pixels of a 512-pixel row are 7 mm apart).

Shape symbols: H W image size; P = H W pixels.
"""

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from r3jax.geometry.cameras import Camera

_PIXELS_PER_DEGREE = 64
"""The widest pair reaches 1 / 64 of a row to either side: a degree, with 60 degrees of view."""

_NOISE = 0.06
"""Noise of 1 % bends a pair by up to so much of its inverse depth (2.5 sigma)."""


def pixel_normals(
    camera: Camera, depth: Float[Array, "H W"], valid: Bool[Array, "H W"], step: Float[Array, ""]
) -> Float[Array, "3 P"]:
    """Estimates normals towards the camera in its frame, scaled so that sums stay unbiased.

    A pixel's vector m is n / |n . p| times its depth: m . (u, v, 1) = -1 on its own ray, so that
    it never faces away. A pair that is bent (one side lies on another surface, by more than
    `step` and what noise explains) or incomplete (a hole, the border) does not count. Along an
    axis without any pair the depth is taken to be constant.

    Args:
        camera: of the image.
        depth: z-depth [m]; its value matters where `valid` only.
        valid: pixels with a measurement.
        step: a step of depth up to this is no edge [m].
    """
    height, width = depth.shape
    # Holes get a finite depth: NaN or infinity would survive the products below.
    depth = jnp.where(valid, depth, 1.0)
    inverse = jnp.where(valid, 1.0 / depth, 0.0)
    # In inverse depth a step of fixed size shrinks with the square of the distance.
    limit = _NOISE * inverse + step * inverse * inverse
    along_u = camera.fx * _slope(inverse, limit, width, axis=1)
    along_v = camera.fy * _slope(inverse, limit, width, axis=0)
    # Rays run through the middles of pixels, which lie at halves.
    u = (jnp.arange(width, dtype=jnp.float32) + 0.5 - camera.cx) / camera.fx
    v = (jnp.arange(height, dtype=jnp.float32) + 0.5 - camera.cy) / camera.fy
    along_axis = inverse - along_u * u[None, :] - along_v * v[:, None]
    return jnp.stack([-(depth * part).reshape(-1) for part in (along_u, along_v, along_axis)])


def _slope(
    inverse: Float[Array, "H W"], limit: Float[Array, "H W"], width: int, *, axis: int
) -> Float[Array, "H W"]:
    """Fits the change of the inverse depth per pixel along an axis; 0 without any pair."""
    rise, run = jnp.zeros_like(inverse), jnp.zeros_like(inverse)
    reach = 1
    while reach <= max(1, width // _PIXELS_PER_DEGREE):
        before, after = _shifted(inverse, -reach, axis), _shifted(inverse, reach, axis)
        is_straight = jnp.abs(before + after - 2.0 * inverse) <= limit
        is_pair = (before > 0.0) & (after > 0.0) & is_straight
        # Least squares: the same noise over a wider pair says more about the slope.
        weight = jnp.where(is_pair, float(reach), 0.0)
        rise, run = rise + weight * (after - before), run + 2.0 * reach * weight
        # Powers of two: a few pairs tell nearly as much as all of them.
        reach *= 2
    return rise / jnp.where(run > 0.0, run, 1.0)


def _shifted(image: Float[Array, "H W"], by: int, axis: int) -> Float[Array, "H W"]:
    """Shifts an image by `by` pixels along an axis; 0 beyond the border."""
    size = image.shape[axis]
    if abs(by) >= size:
        return jnp.zeros_like(image)
    padding = [(0, 0), (0, 0)]
    padding[axis] = (max(0, -by), max(0, by))
    padded = jnp.pad(image, padding)
    start = [0, 0]
    start[axis] = max(0, by)
    return padded[start[0] : start[0] + image.shape[0], start[1] : start[1] + image.shape[1]]
