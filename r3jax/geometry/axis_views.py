"""Views along the world's axes: the six directions of the test views."""

from collections.abc import Sequence

import jax
import numpy as np

from r3jax.geometry.cameras import pose_along

LOOKS = ("+x", "-x", "+y", "-y", "+z", "-z")
"""Names of the directions."""

_pose_along = jax.jit(pose_along)


def poses_at(positions: np.ndarray, looks: Sequence[str] | np.ndarray) -> np.ndarray:
    """Makes poses without roll, [V, 4, 4] float64, at positions [V, 3] [m] along "+x", "-x", ..."""
    # Six poses, copied below: `pose_along` would dispatch to JAX once per view.
    axes: dict[str, np.ndarray] = {}
    for look in LOOKS:
        direction = np.zeros(3, np.float32)
        direction["xyz".index(look[1])] = 1.0 if look[0] == "+" else -1.0
        # Entries are 0 or 1 up to rounding; adding 0 turns -0.0 into 0.0.
        axes[look] = np.rint(_pose_along(np.zeros(3, np.float32), direction)) + 0.0
    poses = np.zeros((len(looks), 4, 4))
    for i, look in enumerate(looks):
        poses[i] = axes[str(look)]
    poses[:, :3, 3] = positions
    return poses
