"""Hypothesis strategies of the geometry and the map.

Map strategies use voxels of 1/16 m and coordinates that are multiples of 1/256 m: float32 holds
them, and their sums, exactly, so that no rounding decides which voxel a point is in.
"""

from typing import NamedTuple

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from r3jax.geometry.voxels import INDEX_LIMIT

NUM_TRIPLES = 8
"""Voxel indices drawn at once."""

VOXEL_SIZE = 0.0625
"""Edge of a voxel in map strategies [m]."""

NUM_POINTS = 24
"""Points of a sighting."""


def index_triples() -> st.SearchStrategy[np.ndarray]:
    """Voxel indices over the whole signed range, [3, NUM_TRIPLES] int32."""
    limits = st.integers(-INDEX_LIMIT, INDEX_LIMIT - 1)
    return hnp.arrays(np.int32, (3, NUM_TRIPLES), elements=limits)


def points() -> st.SearchStrategy[np.ndarray]:
    """Positions within 50 m of the origin, [3] float64 [m]."""
    return hnp.arrays(np.float64, 3, elements=st.floats(-50, 50, width=32))


def directions() -> st.SearchStrategy[np.ndarray]:
    """Directions of length 0.1 to 2, [3] float64; axes and level ones are frequent."""
    component = st.one_of(st.sampled_from([-1.0, 0.0, 1.0]), st.floats(-1, 1, width=32))
    vectors = hnp.arrays(np.float64, 3, elements=component)
    return vectors.filter(lambda vector: np.linalg.norm(vector) > 0.1)


class Sighting(NamedTuple):
    """Points that one camera sees: what `integrate_points` takes."""

    points: np.ndarray
    """[NUM_POINTS, 3] float32 [m]."""

    rgb: np.ndarray
    """[NUM_POINTS, 3] float32 in [0, 1]."""

    position: np.ndarray
    """Camera center, [3] float32 [m]."""

    focal: float
    """Focal length [px]."""


@st.composite
def sightings(draw: st.DrawFn, reach: int = 2) -> Sighting:
    """Sightings whose points crowd the voxels -reach..reach-1 along each axis."""
    index = draw(hnp.arrays(np.int8, (NUM_POINTS, 3), elements=st.integers(-reach, reach - 1)))
    inside = draw(hnp.arrays(np.int8, (NUM_POINTS, 3), elements=st.integers(0, 15)))
    color = draw(hnp.arrays(np.uint8, (NUM_POINTS, 3)))
    position = draw(hnp.arrays(np.int16, 3, elements=st.integers(-512, 512)))
    return Sighting(
        points=((index.astype(np.float64) + inside / 16) * VOXEL_SIZE).astype(np.float32),
        rgb=(color / 255).astype(np.float32),
        position=((position + 0.25) / 256).astype(np.float32),
        focal=draw(st.sampled_from([1.0, 64.0, 300.0])),
    )
