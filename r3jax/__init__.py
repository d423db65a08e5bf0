"""r3jax: where to look next, so that 3D Gaussian splatting of a place comes out well.

The first open implementation of R3-RECON (arXiv 2601.07484). A light voxel map keeps what was
seen, from where and how consistently; closed forms answer in milliseconds how well any view could
be rendered.

    m = r3jax.empty_map()
    m = r3jax.integrate(m, frame)
    s = r3jax.renderability(m, camera, T_world_camera)
"""

from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at, pose_along
from r3jax.mapping.join import grow, merge
from r3jax.mapping.lookup import lookup
from r3jax.mapping.occupancy import OccupancyGrid, empty_grid, integrate_depth
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate, integrate_points
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.panorama import Panorama, panorama
from r3jax.scoring.renderability import (
    Renderability,
    renderability,
    renderability_image,
    voxel_renderability,
)
from r3jax.scoring.utility import ViewUtility, view_utility

__version__ = "0.1.0"

__all__ = [
    "Camera",
    "Frame",
    "MapState",
    "OccupancyGrid",
    "Panorama",
    "Renderability",
    "ScoringConfig",
    "ViewUtility",
    "empty_grid",
    "empty_map",
    "grow",
    "integrate",
    "integrate_depth",
    "integrate_points",
    "look_at",
    "lookup",
    "merge",
    "panorama",
    "pose_along",
    "renderability",
    "renderability_image",
    "view_utility",
    "voxel_renderability",
]
