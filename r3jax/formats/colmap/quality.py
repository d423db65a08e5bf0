"""The usual quality measures of a reconstruction, as far as a model contains them.

Shape symbols: m points; t track elements; n images.
"""

import numpy as np

from r3jax.formats.colmap.model import ColmapModel, pose_of
from r3jax.formats.posed_images import Reconstruction

_MOST_POINTS = 20_000
"""Points whose angle of triangulation is computed."""


def reconstruction_of(model: ColmapModel, unposed: int) -> Reconstruction:
    """Computes the numbers of a model.

    Args:
        model: cameras, images and points.
        unposed: pictures beside its own that it has no pose for.
    """
    points, posed = model.points, len(model.images)
    error = points.error[points.error >= 0.0]
    median, p95 = np.percentile(error, [50.0, 95.0]) if len(error) else (None, None)
    lengths = points.track_lengths[points.track_lengths > 0]
    return Reconstruction(
        posed=posed,
        pictures=posed + unposed,
        error_median=None if median is None else float(median),
        error_p95=None if p95 is None else float(p95),
        track_length=float(lengths.mean()) if len(lengths) else None,
        angle=_median_angle(model),
    )


def _median_angle(model: ColmapModel) -> float | None:
    points = model.points
    centers = {i.id: pose_of(i.quaternion, i.translation)[:3, 3] for i in model.images}
    ends = np.cumsum(points.track_lengths)
    step = max(1, len(points) // _MOST_POINTS)
    angles: list[float] = []
    for index in range(0, len(points), step):
        track = points.track_images[ends[index] - points.track_lengths[index] : ends[index]]
        seen = [centers[image] for image in track.tolist() if image in centers]
        if len(seen) < 2:
            continue
        rays = np.stack(seen) - points.xyz[index]
        rays /= np.maximum(np.linalg.norm(rays, axis=1, keepdims=True), 1e-12)
        angles.append(float(np.arccos(np.clip((rays @ rays.T).min(), -1.0, 1.0))))
    return float(np.degrees(np.median(angles))) if angles else None
