"""Depth swept from photos: a plane sweep at the known poses, for captures without a depth camera.

For each image, planes parallel to it are tried, evenly spaced in inverse depth over the range of
the points. A plane takes each pixel to a place in every source, an image of about the same surface
from a little aside. Windows there are compared by their zero-mean normalized cross-correlation
(ZNCC); a pixel's score is the mean of the best three sources (Yang & Pollefeys 2003; the choice of
sources after MVSNet, Yao et al. 2018), which lets some of them be hidden. Scores are added up along
rows and columns, so that a plain wall has the depth of its texture and edges (semi-global matching,
Hirschmuller 2008). The best plane is refined by a parabola, and a pixel is kept where it stands out
among the planes and the depths of two other images agree.

What is plain, dark or glossy, or was never seen from two sides, finds no agreement: no depth.

Shape symbols: n images; s sources; h, w size of an image; p planes; k points.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.kernels import sweep as kernels
from r3jax.kernels.constants import LEAST_DEVIATION, NO_SCORE
from r3jax.kernels.constants import SWEEP_RADIUS as RADIUS

PLANES = 128
"""Planes at most."""

SOURCES = 5
"""Images that one is compared with."""

_BEST = 3
"""Sources whose scores count."""

_SMALL_STEP, _LARGE_STEP = 0.1, 0.6
"""What it costs if neighboring pixels lie on neighboring planes, or on others."""

_MIN_SCORE = 1.0
"""By how much the best plane's smoothed score must exceed the median plane's."""

_AGREE = 0.015
"""Depths agree within this share, or within `_AGREE_PX` of the image, whichever is more."""

_AGREE_PX = 1.0
"""See `_AGREE` [px]."""

_VIEWS = 2
"""Other images that must agree."""

_ANGLE, _NARROW, _WIDE = 8.0, 4.0, 12.0
"""Angle between the rays of two images at which they are compared best, and the deviations below
and above it [deg]."""


class Photo(NamedTuple):
    """An image to be compared with others."""

    gray: np.ndarray
    """Brightness in [0, 1], [h, w] float32."""

    lens: np.ndarray
    """fx, fy, cx, cy of its pinhole [px], [4]."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float64."""


@dataclass(frozen=True)
class Homographies:
    """Where planes of a reference take its pixels, (u, v, 1) A^T + inverse depth * b."""

    A: np.ndarray
    """[s, 3, 3] float32."""

    b: np.ndarray
    """[s, 3] float32."""


def homographies(reference: Photo, sources: Sequence[Photo]) -> Homographies:
    """Projects pixels of a reference at a depth to those of its sources."""

    def matrix(lens: np.ndarray) -> np.ndarray:
        fx, fy, cx, cy = lens
        return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])

    back = np.linalg.inv(matrix(reference.lens))
    A, b = [], []
    for source in sources:
        T = np.linalg.inv(source.pose) @ reference.pose
        K = matrix(source.lens)
        A.append(K @ T[:3, :3] @ back)
        b.append(K @ T[:3, 3])
    return Homographies(np.stack(A).astype(np.float32), np.stack(b).astype(np.float32))


@jax.jit
def plane_scores(
    reference: Float[Array, "h w"],
    sources: Float[Array, "s h w"],
    A: Float[Array, "s 3 3"],
    b: Float[Array, "s 3"],
    inverses: Float[Array, " p"],
) -> Float[Array, "h w p"]:
    """Computes what `kernels.sweep.plane_scores` does, of images of one size."""
    height, width = reference.shape
    side = 2 * RADIUS + 1
    margin = ((RADIUS, RADIUS), (RADIUS, RADIUS))

    def mean(image: Float[Array, "h w"]) -> Float[Array, "h w"]:
        padded = jnp.pad(image, margin, mode="edge")
        total = jax.lax.reduce_window(padded, 0.0, jax.lax.add, (side, side), (1, 1), "valid")
        return total / side**2

    own = mean(reference)
    variance = mean(reference**2) - own**2
    is_textured = variance > LEAST_DEVIATION**2
    along = (jnp.arange(length, dtype=jnp.float32) + 0.5 for length in (width, height))
    u, v = jnp.meshgrid(*along)
    pixel = jnp.stack([u, v, jnp.ones_like(u)])

    def compare(
        source: Float[Array, "h w"],
        A: Float[Array, "3 3"],
        b: Float[Array, " 3"],
        inverse: Float[Array, ""],
    ) -> Float[Array, "h w"]:
        x, y, z = jnp.einsum("ij,jhw->ihw", A, pixel) + (inverse * b)[:, None, None]
        safe = jnp.where(z > 1e-6, z, 1.0)
        x, y = x / safe - 0.5, y / safe - 0.5
        is_in = (z > 1e-6) & (x >= -0.5) & (x <= width - 0.5) & (y >= -0.5) & (y <= height - 0.5)
        x, y = jnp.clip(x, 0.0, width - 1.0), jnp.clip(y, 0.0, height - 1.0)
        left, top = x.astype(jnp.int32), y.astype(jnp.int32)
        right, bottom = jnp.minimum(left + 1, width - 1), jnp.minimum(top + 1, height - 1)
        part = x - left.astype(jnp.float32)
        upper = source[top, left] + part * (source[top, right] - source[top, left])
        lower = source[bottom, left] + part * (source[bottom, right] - source[bottom, left])
        sample = upper + (y - top.astype(jnp.float32)) * (lower - upper)
        of_sample = mean(sample)
        spread = mean(sample**2) - of_sample**2
        covariance = mean(sample * reference) - of_sample * own
        is_valid = is_in & (spread > LEAST_DEVIATION**2)
        both = jnp.where(is_valid & is_textured, spread * variance, 1.0)
        return jnp.where(is_valid, covariance / jnp.sqrt(both), NO_SCORE)

    def score(inverse: Float[Array, ""]) -> Float[Array, "h w"]:
        scores = jax.vmap(compare, in_axes=(0, 0, 0, None))(sources, A, b, inverse)
        count = jnp.sum(scores > NO_SCORE, axis=0)
        best = jax.lax.top_k(jnp.moveaxis(scores, 0, -1), min(_BEST, sources.shape[0]))[0]
        used = jnp.minimum(count, _BEST)
        place = jnp.arange(best.shape[-1])[None, None, :]
        total = jnp.sum(jnp.where(place < used[..., None], best, 0.0), axis=-1)
        is_valid = is_textured & (count >= 2)
        return jnp.where(is_valid, total / jnp.maximum(used, 1).astype(jnp.float32), NO_SCORE)

    return jnp.moveaxis(jax.lax.map(score, inverses), 0, -1)


@jax.jit
def smooth_scores(
    scores: Float[Array, "h w p"], small: Float[Array, ""], large: Float[Array, ""]
) -> Float[Array, "h w p"]:
    """Computes what `kernels.sweep.smooth_scores` does (semi-global matching, Hirschmuller 2008).

    Along a line of pixels, with `s` a pixel's scores and `m` the maximum of L before it:

        L(k) = s(k) + max(L'(k), L'(k - 1) - small, L'(k + 1) - small, m - large) - m
    """
    known = jnp.maximum(scores, 0.0)

    def step(
        before: Float[Array, "n p"], here: Float[Array, "n p"]
    ) -> tuple[Float[Array, "n p"], Float[Array, "n p"]]:
        top = jnp.max(before, axis=1, keepdims=True)
        none = jnp.full_like(top, -jnp.inf)
        lower = jnp.concatenate([none, before[:, :-1]], axis=1) - small
        upper = jnp.concatenate([before[:, 1:], none], axis=1) - small
        best = jnp.maximum(jnp.maximum(before, jnp.maximum(lower, upper)), top - large)
        after = here + best - top
        return after, after

    def along(lines: Float[Array, "l n p"], *, reverse: bool) -> Float[Array, "l n p"]:
        return jax.lax.scan(step, jnp.zeros_like(lines[0]), lines, reverse=reverse)[1]

    columns = jnp.swapaxes(known, 0, 1)
    down = along(known, reverse=False) + along(known, reverse=True)
    across = along(columns, reverse=False) + along(columns, reverse=True)
    return down + jnp.swapaxes(across, 0, 1)


_SAME_PLACE = 1e-6
"""Distance between cameras at the same place, as a share of the extent of all."""


def choose_sources(
    photos: Sequence[Photo], points_of: Callable[[int], np.ndarray], most: int = SOURCES
) -> list[np.ndarray]:
    """Chooses what each image is compared with: it shows the same points from a little aside.

    Args:
        photos: all images.
        points_of: points that an image shows, [k, 3] in the world.
        most: sources of each.

    Returns:
        Numbers of the sources of each image, the best first.
    """
    chosen: list[np.ndarray] = []
    centers = np.stack([photo.pose[:3, 3] for photo in photos])
    # Images from the same place (views of one 360 photo, or of a rig) have no parallax.
    closest = _SAME_PLACE * float(np.linalg.norm(np.ptp(centers, axis=0)))
    for own in range(len(photos)):
        points = points_of(own)
        apart = np.linalg.norm(centers - centers[own], axis=1)
        weight = np.zeros(len(photos))
        if len(points):
            rays = points - centers[own]
            rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-9)
            for other, photo in enumerate(photos):
                if apart[other] > closest:
                    weight[other] = _weight(photo, points, rays)
        order = np.argsort(-weight, kind="stable")[:most]
        chosen.append(order[weight[order] > 0.0])
    return chosen


def _weight(photo: Photo, points: np.ndarray, rays: np.ndarray) -> float:
    """Computes how much an image helps: points in it, by the angle that they are seen under."""
    local = (points - photo.pose[:3, 3]) @ photo.pose[:3, :3]
    z = np.where(local[:, 2] > 1e-6, local[:, 2], np.inf)
    fx, fy, cx, cy = photo.lens
    u, v = fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy
    height, width = photo.gray.shape
    is_in = np.isfinite(z) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
    toward = points - photo.pose[:3, 3]
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-9)
    angle = np.degrees(np.arccos(np.clip((toward * rays).sum(axis=1), -1.0, 1.0)))
    spread = np.where(angle < _ANGLE, _NARROW, _WIDE)
    return float((is_in * np.exp(-0.5 * ((angle - _ANGLE) / spread) ** 2)).sum())


def sweep_planes(depths: np.ndarray, reference: Photo, sources: Sequence[Photo]) -> np.ndarray:
    """Spaces planes evenly in inverse depth, over the range of some depths and beyond.

    No more than half a pixel of the widest source lies between two of them.

    Args:
        depths: of points that the reference shows, [k].
        reference: the image that is swept.
        sources: what it is compared with.
    """
    near, far = np.percentile(depths, [1.0, 99.0])
    low, high = 1.0 / (1.5 * far), 1.0 / (0.67 * near)
    baseline = max(
        float(np.linalg.norm(source.pose[:3, 3] - reference.pose[:3, 3])) for source in sources
    )
    pixels = baseline * float(reference.lens[0]) * (high - low)
    count = int(np.clip(2.0 * pixels, 24, PLANES))
    return np.linspace(low, high, count).astype(np.float32)


def swept_depth(reference: Photo, sources: Sequence[Photo], depths: np.ndarray) -> np.ndarray:
    """Computes the depth of an image, [h, w] float32; 0 where no plane stands out.

    Args:
        reference: the image.
        sources: what it is compared with, two or more.
        depths: of points that it shows, [k].
    """
    planes = sweep_planes(depths, reference, sources)
    where = homographies(reference, sources)
    sizes = np.array([source.gray.shape for source in sources], np.int64)
    stack = np.zeros((len(sources), *sizes.max(axis=0)), np.float32)
    for number, source in enumerate(sources):
        stack[number, : source.gray.shape[0], : source.gray.shape[1]] = source.gray
    scores = kernels.plane_scores(reference.gray, stack, sizes, where.A, where.b, planes)
    smooth = kernels.smooth_scores(scores, np.float32(_SMALL_STEP), np.float32(_LARGE_STEP))
    inverse, score = best_planes(smooth, planes)
    is_good = (score >= _MIN_SCORE) & (inverse > 0.0)
    return np.where(is_good, 1.0 / np.where(is_good, inverse, 1.0), 0.0).astype(np.float32)


def best_planes(scores: np.ndarray, planes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Picks the best inverse depth of each pixel, between planes by a parabola.

    Args:
        scores: [h, w, p].
        planes: inverse depths, evenly spaced, [p].

    Returns:
        Inverse depth [h, w], and by how much the best plane's score is above the median plane's.
    """
    at = np.argmax(scores, axis=2)
    inner = np.clip(at, 1, len(planes) - 2)
    pick = lambda by: np.take_along_axis(scores, (inner + by)[..., None], axis=2)[..., 0]
    left, middle, right = pick(-1), pick(0), pick(1)
    curve = left + right - 2.0 * middle
    is_peak = (curve < -1e-6) & (inner == at)
    offset = np.where(is_peak, 0.5 * (left - right) / np.where(is_peak, curve, 1.0), 0.0)
    best = np.take_along_axis(scores, at[..., None], axis=2)[..., 0]
    return planes[at] + offset * (planes[1] - planes[0]), best - np.median(scores[..., ::8], axis=2)


def agreed_depth(
    own: int, depths: Sequence[np.ndarray], photos: Sequence[Photo], others: np.ndarray
) -> np.ndarray:
    """Keeps the depth of an image where two others agree, [h, w] float32; 0 elsewhere.

    A pixel's point lies in another image where that one's depth puts it. What several say of it is
    averaged, in inverse depth along the pixel.

    Args:
        own: number of the image.
        depths: of all images, 0 where there is none.
        photos: all images.
        others: numbers of those that may agree.
    """
    depth, photo = depths[own], photos[own]
    row, column = np.nonzero(depth > 0.0)
    z = depth[row, column].astype(np.float64)
    fx, fy, cx, cy = photo.lens
    ray = np.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, np.ones(len(z))], axis=1)
    votes = np.zeros(len(z), np.int64)
    total = 1.0 / np.maximum(z, 1e-12)
    for other in others.tolist():
        T = np.linalg.inv(photos[other].pose) @ photo.pose
        said = _depth_by(depths[other], photos[other].lens, T, z, ray)
        baseline = max(float(np.linalg.norm(T[:3, 3])), 1e-9)
        allowed = np.maximum(_AGREE, _AGREE_PX * z / (fx * baseline))
        agrees = (said > 0.0) & (np.abs(said / z - 1.0) < np.minimum(allowed, 3.0 * _AGREE))
        votes += agrees
        total += np.where(agrees, 1.0 / np.where(agrees, said, 1.0), 0.0)
    kept = np.zeros_like(depth)
    is_kept = votes >= _VIEWS
    kept[row[is_kept], column[is_kept]] = ((1 + votes) / total)[is_kept]
    return kept


def _depth_by(
    depth: np.ndarray, lens: np.ndarray, T: np.ndarray, z: np.ndarray, ray: np.ndarray
) -> np.ndarray:
    """Computes the depth of pixels by another image's, [k]; 0 where that has none.

    Args:
        depth: of the other image, [h, w].
        lens: its pinhole, [4].
        T: from the pixels' camera to the other one, [4, 4].
        z: depths of the pixels, [k].
        ray: their rays (x, y, 1), [k, 3].
    """
    turned = ray @ T[:3, :3].T
    x, y, there = (z[:, None] * turned + T[:3, 3]).T
    safe = np.where(there > 1e-9, there, 1.0)
    fx, fy, cx, cy = lens
    column, row = np.floor(fx * x / safe + cx), np.floor(fy * y / safe + cy)
    height, width = depth.shape
    is_in = (there > 1e-9) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
    at = np.where(is_in, row, 0).astype(np.int64), np.where(is_in, column, 0).astype(np.int64)
    measured = np.where(is_in, depth[at], 0.0)
    # The own depth that has this depth there: z turned_z + t_z = measured.
    rise = np.where(np.abs(turned[:, 2]) > 1e-6, turned[:, 2], np.inf)
    return np.where(measured > 0.0, (measured - T[2, 3]) / rise, 0.0)


def sweep(
    photos: Sequence[Photo],
    points_of: Callable[[int], np.ndarray],
    on_image: Callable[[], None] = lambda: None,
) -> list[np.ndarray]:
    """Computes the depth of every image from all of them, [h, w] float32; 0: not known.

    Args:
        photos: the images.
        points_of: points that an image shows, [k, 3] in the world; none: it is not swept.
        on_image: called after each of them.
    """
    sources = choose_sources(photos, points_of)
    raw: list[np.ndarray] = []
    for own, (photo, chosen) in enumerate(zip(photos, sources, strict=True)):
        local = (points_of(own) - photo.pose[:3, 3]) @ photo.pose[:3, 2]
        ahead = local[local > 0.0]
        if len(chosen) < 2 or len(ahead) < 2:
            raw.append(np.zeros_like(photo.gray))
        else:
            raw.append(swept_depth(photo, [photos[i] for i in chosen.tolist()], ahead))
        on_image()
    return [agreed_depth(own, raw, photos, chosen) for own, chosen in enumerate(sources)]
