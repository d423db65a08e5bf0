from .frame import Frame
from .geometry.cameras import Camera, look_at, pose_along
from .mapping.join import grow, merge
from .mapping.lookup import lookup
from .mapping.occupancy import OccupancyGrid, empty_grid, integrate_depth
from .mapping.state import MapState, empty_map
from .mapping.update import integrate, integrate_points
from .scoring.config import ScoringConfig
from .scoring.panorama import Panorama, panorama
from .scoring.renderability import (
    Renderability,
    renderability,
    renderability_image,
    voxel_renderability,
)
from .scoring.utility import ViewUtility, view_utility

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
