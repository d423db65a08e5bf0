"""What the rivals share: an online Gaussian map that is trained in `observe`, on the clock."""

from dataclasses import dataclass, field, replace
from typing import Any, ClassVar

import numpy as np
from jaxtyping import Array

from r3jax.baselines.online_map import BALLS, MapSettings, OnlineMap, add_frame, empty_online_map
from r3jax.errors import InputError
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import GreedyPolicy, PlannerState
from r3jax.splatting.views import fitted_size


@dataclass(frozen=True)
class OnlineConfig(PlannerConfig):
    """Settings of all policies that keep a map of their own."""

    score_width: int = 128
    """Longer side of the images that candidates are scored on [px]; never more than recorded."""

    train_width: int = 128
    """Longer side of the images that the map is trained on [px]; never more than recorded."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
        super().__post_init__()
        for name in ("score_width", "train_width"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")


@dataclass(frozen=True)
class OnlinePolicy(GreedyPolicy):
    """A policy whose memory is an online Gaussian map."""

    config: OnlineConfig = field(default_factory=OnlineConfig)

    Config: ClassVar[type[PlannerConfig]] = OnlineConfig

    settings: ClassVar[MapSettings] = BALLS
    """How the map is kept."""

    num_marks: ClassVar[int] = 0
    """Numbers that are kept per Gaussian."""

    @property
    def map_settings(self) -> MapSettings:
        """Settings of the map, at the requested size."""
        return replace(self.settings, image_width=self.config.train_width)

    def note(self, online: OnlineMap) -> OnlineMap:
        """Takes note of the latest frame, after the map was trained on it: nothing."""
        return online

    def init(self, camera: Camera, grid: OccupancyGrid, *, key: Array) -> PlannerState:
        """Returns the state before the first frame: an empty map."""
        state = super().init(camera, grid, key=key)
        online = empty_online_map(camera, self.map_settings, key, self.num_marks)
        return replace(state, memory=online)

    def observe(self, state: PlannerState, map_state: MapState, frame: Frame) -> PlannerState:
        """Trains the map on the frame, too."""
        del map_state
        reach = float(self.config.scoring.max_range)
        online = add_frame(state.memory, frame, reach, self.map_settings)
        return replace(state, memory=self.note(online))

    def weigh(self, utilities: dict[str, np.ndarray]) -> np.ndarray:
        """Computes the utility's share minus the path's; random scores if all utilities are 0."""
        is_reachable = np.isfinite(utilities["path"])
        # A map without Gaussians: the first candidate would be as good as any, but always the same.
        if not np.any(utilities["utility"][is_reachable]):
            return np.where(is_reachable, utilities["lot"], -np.inf)
        return super().weigh(utilities)

    def score_camera(self, camera: Camera) -> Camera:
        """Returns the camera that candidates are scored with.

        It has the same field of view and fewer pixels.
        """
        return camera.resized(*fitted_size(camera.width, camera.height, self.config.score_width))


def memory_of(situation: Any) -> OnlineMap:
    """Returns the map in a situation."""
    online = situation.memory
    assert isinstance(online, OnlineMap)
    return online
