from .apps.benchmark.record import read_records
from .apps.forecast.expected_error import (
    ErrorImages,
    ExpectedError,
    expected_error,
    expected_error_images,
    voxel_difficulty,
)
from .apps.forecast.forecast import is_done
from .apps.select.select import select_frames
from .evaluation.evaluate import Evaluation, evaluate
from .exploration.loop import Result, explore
from .frame import Frame
from .geometry.cameras import Camera, look_at, pose_along
from .mapping.config import MappingConfig
from .mapping.join import grow, merge
from .mapping.lookup import lookup
from .mapping.occupancy import OccupancyGrid, empty_grid, integrate_depth
from .mapping.state import MapState, empty_map
from .mapping.update import integrate, integrate_points
from .planning.decide import GreedyPolicy
from .planning.merge_planners import merge_planners
from .planning.next_views import NextViews, next_views
from .planning.planner import (
    Planner,
    decide,
    keep_out,
    observe,
    observe_points,
    refuse,
    start,
    with_costmap,
)
from .planning.policy import Decision, DecisionOutcome
from .planning.rebuild import rebuild
from .planning.registry import make_policy, register_policy
from .planning.robot.body import Body
from .runs.saved_planner import load, save
from .scoring.config import CellImportance, ScoringConfig
from .scoring.explain import Explanation, explain_view
from .scoring.panorama import Panorama, panorama
from .scoring.renderability import (
    Renderability,
    renderability,
    renderability_image,
    voxel_renderability,
)
from .scoring.soft_utility import SoftUtility, soft_utility
from .scoring.utility import ViewUtility, view_utility
from .simulators.scenes.registry import open_scene
from .splatting.backend import RasterConfig
from .splatting.ply import read_scene, write_scene
from .splatting.render import Rendering, render
from .splatting.scene import GaussianScene
from .splatting.training.config import TrainConfig
from .splatting.training.train import FitResult, fit
from .splatting.views import Views, load_views

__version__: str

__all__ = [
    "Body",
    "Camera",
    "CellImportance",
    "Decision",
    "DecisionOutcome",
    "ErrorImages",
    "Evaluation",
    "ExpectedError",
    "Explanation",
    "FitResult",
    "Frame",
    "GaussianScene",
    "GreedyPolicy",
    "MapState",
    "MappingConfig",
    "NextViews",
    "OccupancyGrid",
    "Panorama",
    "Planner",
    "RasterConfig",
    "Renderability",
    "Rendering",
    "Result",
    "ScoringConfig",
    "SoftUtility",
    "TrainConfig",
    "ViewUtility",
    "Views",
    "decide",
    "empty_grid",
    "empty_map",
    "evaluate",
    "expected_error",
    "expected_error_images",
    "explain_view",
    "explore",
    "fit",
    "grow",
    "integrate",
    "integrate_depth",
    "integrate_points",
    "is_done",
    "keep_out",
    "load",
    "load_views",
    "look_at",
    "lookup",
    "make_policy",
    "merge",
    "merge_planners",
    "next_views",
    "observe",
    "observe_points",
    "open_scene",
    "panorama",
    "pose_along",
    "read_records",
    "read_scene",
    "rebuild",
    "refuse",
    "register_policy",
    "render",
    "renderability",
    "renderability_image",
    "save",
    "select_frames",
    "soft_utility",
    "start",
    "view_utility",
    "voxel_difficulty",
    "voxel_renderability",
    "with_costmap",
    "write_scene",
]
