from .frame import Frame
from .geometry.cameras import Camera, look_at, pose_along
from .mapping.join import grow, merge
from .mapping.lookup import lookup
from .mapping.occupancy import OccupancyGrid, empty_grid, integrate_depth
from .mapping.state import MapState, empty_map
from .mapping.update import integrate, integrate_points
from .planning.next_views import NextViews, next_views
from .scoring.config import ScoringConfig
from .scoring.explain import Explanation, explain_view
from .scoring.panorama import Panorama, panorama
from .scoring.renderability import (
    Renderability,
    renderability,
    renderability_image,
    voxel_renderability,
)
from .scoring.utility import ViewUtility, view_utility
from .splatting.config import RasterConfig
from .splatting.ply import read_scene, write_scene
from .splatting.render import Rendering, render
from .splatting.scene import GaussianScene
from .splatting.train import FitResult, fit
from .splatting.training_config import TrainConfig
from .splatting.views import Views, load_views

__version__: str

__all__ = [
    "Camera",
    "Explanation",
    "FitResult",
    "Frame",
    "GaussianScene",
    "MapState",
    "NextViews",
    "OccupancyGrid",
    "Panorama",
    "RasterConfig",
    "Renderability",
    "Rendering",
    "ScoringConfig",
    "TrainConfig",
    "ViewUtility",
    "Views",
    "empty_grid",
    "empty_map",
    "explain_view",
    "fit",
    "grow",
    "integrate",
    "integrate_depth",
    "integrate_points",
    "load_views",
    "look_at",
    "lookup",
    "merge",
    "next_views",
    "panorama",
    "pose_along",
    "read_scene",
    "render",
    "renderability",
    "renderability_image",
    "view_utility",
    "voxel_renderability",
    "write_scene",
]
