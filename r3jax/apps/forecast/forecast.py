"""A forecast of the image quality all over a place, from the map alone.

Shape symbols: V views.
"""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from r3jax.apps.forecast.calibration import default_calibration
from r3jax.apps.forecast.free_views import free_space_views
from r3jax.apps.forecast.psnr import Calibration, statistic
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.scoring.batch import score_views
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import term_images

NUM_VIEWS = 96
"""Views that a forecast looks at; a percentile of so many is known to a few hundredths of them."""

_LEAST_SHOWN = 0.5
"""A view that shows less than this share of surface and nothing unexplored looks into the void
(out of a window, up where a scan has no ceiling): the referee leaves such views out."""


@dataclasses.dataclass(frozen=True)
class Forecast:
    """What images of a place would be like, if a model were trained on the views so far."""

    mixture: np.ndarray
    """Equally likely values of the PSNR of a free-space view [dB]; empty: no such view."""

    calibration: Calibration

    def value(self, name: str) -> float:
        """The forecast of a statistic, `mean` or `p10` [dB]; -inf where there is no view."""
        return statistic(self.mixture, name) if self.mixture.size else -np.inf

    def interval(self, name: str, level: float = 0.8) -> tuple[float, float]:
        """Where the truth lies with that probability [dB], by the errors in unknown scenes."""
        value, width = self.value(name), self.calibration.half_width(name, level)
        return value - width, value + width


def forecast_map(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    *,
    max_range: float = 5.0,
    calibration: Calibration | None = None,
) -> Forecast:
    """Forecasts the PSNR of views all over the place. Not to be called under jit.

    Args:
        state: the map.
        grid: the coarse grid; says where views may stand.
        camera: that took the views.
        max_range: of its depth sensor [m].
        calibration: what to believe; by default the one that comes with the package, of the
            referee's small size (`python -m experiments.forecast`).
    """
    poses = free_space_views(grid, NUM_VIEWS)
    known = calibration or default_calibration()
    if len(poses) == 0:
        return Forecast(np.zeros(0), known)
    config = ScoringConfig(max_range=max_range)
    # Padded to one length, so that one compilation serves the whole run.
    padded = jnp.asarray(poses[np.arange(NUM_VIEWS) % len(poses)])
    coverage, renderability = view_features(state, camera, padded, config)
    unexplored = np.asarray(score_views(state, grid, camera, padded, config).exploration)
    shows = ((coverage >= _LEAST_SHOWN) | (unexplored > 0.0))[: len(poses)]
    parts = coverage[: len(poses)][shows], renderability[: len(poses)][shows]
    return Forecast(np.sort(known.model.mixture(*parts), axis=None), known)


def view_features(
    state: MapState, camera: Camera, poses: Float[Array, "V 4 4"], config: ScoringConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Coverage and renderability of views, [V] float64 each."""
    coverage, renderability = _features(state, camera, poses, config)
    return np.asarray(coverage, dtype=np.float64), np.asarray(renderability, dtype=np.float64)


@jax.jit
def _features(
    state: MapState, camera: Camera, poses: Float[Array, "V 4 4"], config: ScoringConfig
) -> tuple[Float[Array, " V"], Float[Array, " V"]]:
    def look(T_world_camera: Float[Array, "4 4"]) -> tuple[Array, Array]:
        images = term_images(state, camera, T_world_camera, config)
        shown = (images.row < state.capacity).astype(jnp.float32)
        return jnp.mean(shown), jnp.mean(images.value)

    return jax.lax.map(look, poses)
