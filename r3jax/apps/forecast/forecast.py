"""Predicts the image quality throughout a scene, from the map alone; a goal ends a run.

During exploration the free space is only partly known, and a forecast over known free space would
be satisfied with the first room. So the forecast uses views in all space that is free or
unexplored, connected to known free space, and at a distance from everything occupied. While much is
unexplored this space is too large and the forecast too low; it converges as the scene becomes
known. Views are like those of the benchmark's test sets: in six directions along the axes.

Along a recorded run, forecasts estimate the number of further views for one decibel.

Shape symbols: V views; X Y Z cells.
"""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy import ndimage
from scipy.stats import qmc

from r3jax.apps.forecast.psnr import Calibration, default_calibration, parse_goal, statistic
from r3jax.errors import InputError
from r3jax.exploration.config import ExplorationConfig
from r3jax.exploration.state import LoopState
from r3jax.geometry.cameras import LOOKS, Camera, poses_at
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.planning.far import known_round
from r3jax.planning.planner import Planner
from r3jax.planning.robot.travel import safe_cells
from r3jax.runs.reader import Run
from r3jax.runs.settings import config_of
from r3jax.scoring.batch import score_views
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.renderability import term_images

MARGIN = 0.3
"""Minimum distance of the views to occupied cells [m], as in the benchmark's test sets."""

_NUM_DRAWN = 1 << 14
"""Number of positions drawn in the scene's box; most of them are in walls or outside."""

_FACES = ndimage.generate_binary_structure(3, 1)


def possible_cells(grid: OccupancyGrid, margin: float = MARGIN) -> np.ndarray:
    """Returns a mask of the cells that a camera may stand in, [X, Y, Z] bool.

    None of them comes nearer than `margin` [m] to an occupied cell or to the end of the grid, and
    each connects over others of them to one that is known to be free.
    """
    open_cells = safe_cells(~np.asarray(grid.occupied), float(grid.cell_size), margin)
    labels = np.zeros(open_cells.shape, dtype=np.int32)
    ndimage.label(open_cells, _FACES, output=labels)
    reached = np.unique(labels[np.asarray(grid.free) & open_cells])
    return np.isin(labels, reached[reached > 0])


def free_space_views(grid: OccupancyGrid, num: int) -> np.ndarray:
    """Selects the first `num` views of a fixed sequence over the grid that stand in possible cells.

    Args:
        grid: free, occupied and unexplored space.
        num: views at most; there are fewer where hardly anything is open.

    Returns:
        `T_world_camera`, [V, 4, 4] float32, without roll.
    """
    origin, size = np.asarray(grid.origin, np.float64), float(grid.cell_size)
    shape = np.asarray(grid.log_odds.shape)
    unit = _sequence()
    cells = np.minimum(unit[:, :3] * shape, shape - 1).astype(int)
    chosen = np.flatnonzero(possible_cells(grid)[tuple(cells.T)])[:num]
    positions = origin + unit[chosen, :3] * shape * size
    looks = np.asarray(LOOKS)[(len(LOOKS) * unit[chosen, 3]).astype(int)]
    return poses_at(positions, looks).astype(np.float32)


@functools.cache
def _sequence() -> np.ndarray:
    """Returns positions and directions in the unit cube, evenly spread, [n, 4].

    They are the same for every run.
    """
    return qmc.Sobol(d=4, scramble=False).random(_NUM_DRAWN)


NUM_VIEWS = 96
"""Number of views of a forecast; enough for a percentile to within a few hundredths."""

_LEAST_SHOWN = 0.5
"""A view that shows less than this share of surface and nothing unexplored looks into the void
(out of a window, up where a scan has no ceiling): the benchmark leaves such views out."""


@dataclasses.dataclass(frozen=True)
class Forecast:
    """What images of a place would be like, if a model were trained on the views so far."""

    mixture: np.ndarray
    """Equally likely values of the PSNR of a free-space view [dB]; empty: no such view."""

    calibration: Calibration

    def value(self, name: str) -> float:
        """Returns the forecast of a statistic, `mean` or `p10` [dB]; -inf if there is no view."""
        return statistic(self.mixture, name) if self.mixture.size else -np.inf

    def interval(self, name: str, level: float = 0.8) -> tuple[float, float]:
        """Returns the interval of probability `level` [dB], from the errors in unknown scenes."""
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
    """Predicts the PSNR of views throughout the scene. Not to be called under jit.

    Args:
        state: the map.
        grid: the coarse grid; says where views may stand.
        camera: that took the views.
        max_range: of its depth sensor [m].
        calibration: what to believe; by default the one that comes with the package, of the
            benchmark's small size (`python -m experiments.forecast`).
    """
    poses = free_space_views(grid, NUM_VIEWS)
    config = ScoringConfig(max_range=max_range)
    shown = [_shown(state, grid, camera, poses, config)] if len(poses) else []
    return _forecast_of(shown, calibration or default_calibration())


_MOST_JOINED = 4_000_000
"""Voxels in tiles up to which a forecast joins them in one table: block by block takes longer."""


def forecast_planner(
    planner: Planner,
    camera: Camera,
    *,
    max_range: float = 5.0,
    calibration: Calibration | None = None,
) -> Forecast:
    """Predicts the PSNR as `forecast_map` does, also of a map in tiles of any size.

    Args:
        planner: holds the map and the grid.
        camera: as in `forecast_map`; so are the others.
        max_range: [m].
        calibration: what to believe.

    Raises:
        ValueError: tiles of more cells than a grid may have.
    """
    far, grid = planner.far, planner.whole_grid
    num = 0 if far is None else far.tiles.num_voxels + int(planner.map_state.num_present)
    if far is None or num <= _MOST_JOINED:
        return forecast_map(
            planner.whole_map, grid, camera, max_range=max_range, calibration=calibration
        )
    poses = free_space_views(grid, NUM_VIEWS)
    config = ScoringConfig(max_range=max_range)
    tile = far.tiles.lattice.tiles_of(poses[:, :3, 3].T.astype(np.float64))
    order, cuts = np.lexsort(tile), np.zeros(0, int)
    if len(poses):
        cuts = np.flatnonzero(np.any(np.diff(tile[:, order], axis=1) != 0, axis=0)) + 1
    shown: list[tuple[np.ndarray, np.ndarray]] = []
    for which in np.split(order, cuts):
        for some in np.array_split(which, -(-len(which) // _AT_ONCE)) if len(which) else []:
            state, near = known_round(planner.map_state, planner.grid, far, poses[some[0], :3, 3])
            shown.append(_shown(state, near, camera, poses[some], config, _AT_ONCE))
    return _forecast_of(shown, calibration or default_calibration())


_AT_ONCE = 8
"""Views of one block that are scored together."""


def _shown(
    state: MapState,
    grid: OccupancyGrid,
    camera: Camera,
    poses: np.ndarray,
    config: ScoringConfig,
    num: int = NUM_VIEWS,
) -> tuple[np.ndarray, np.ndarray]:
    """Computes coverage and renderability of the views that do not look into the void."""
    # Padded to one length, so that one compilation serves the whole run.
    padded = jnp.asarray(poses[np.arange(num) % len(poses)])
    coverage, renderability = view_features(state, camera, padded, config)
    unexplored = np.asarray(score_views(state, grid, camera, padded, config).exploration)
    shows = ((coverage >= _LEAST_SHOWN) | (unexplored > 0.0))[: len(poses)]
    return coverage[: len(poses)][shows], renderability[: len(poses)][shows]


def _forecast_of(
    shown: Sequence[tuple[np.ndarray, np.ndarray]], calibration: Calibration
) -> Forecast:
    """Mixes the forecasts of views."""
    if not shown:
        return Forecast(np.zeros(0), calibration)
    parts = (np.concatenate(part) for part in zip(*shown, strict=True))
    return Forecast(np.sort(calibration.model.mixture(*parts), axis=None), calibration)


def view_features(
    state: MapState, camera: Camera, poses: Float[Array, "V 4 4"], config: ScoringConfig
) -> tuple[np.ndarray, np.ndarray]:
    """Computes the coverage and renderability of views, [V] float64 each."""
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


def stopping_rule(
    config: ExplorationConfig, camera: Camera
) -> Callable[[LoopState], str | None] | None:
    """Makes the `is_enough` of `explore` from `config.until`.

    Args:
        config: of the loop.
        camera: of the views whose PSNR is forecast.

    Returns:
        Says why no further view is needed, or None; None for a config without a goal.

    Raises:
        ValueError: a goal that is not understood.
    """
    if config.until is None:
        return None
    goal = parse_goal(config.until)

    def is_enough(state: LoopState) -> str | None:
        forecast = forecast_planner(state.planner, camera, max_range=config.max_range)
        if not goal.reached(forecast):
            return None
        low, high = forecast.interval(goal.statistic)
        return (
            f"{state.counts}: the forecast of the PSNR of free-space views "
            f"({goal.statistic}) is {forecast.value(goal.statistic):.1f} dB, "
            f"{low:.1f} to {high:.1f} in four of five places; the goal is {goal}"
        )

    return is_enough


def is_done(planner: Planner, goal: str, camera: Camera | None = None) -> bool:
    """Judges whether a planner has seen enough, by the rule of `explore --until`.

    Do not call it at every decision: it takes as long as scoring a hundred views.

    Args:
        planner: map and grid.
        goal: such as `psnr:25`, the mean of views throughout the place [dB], or `psnr:20@p10`, all
            but the worst tenth of them.
        camera: of those views; None: the planner's.

    Raises:
        ValueError: a goal that is not understood; or a policy that does not say which camera it
            plans for; or tiles of more cells than a grid may have.
    """
    lens = getattr(planner.policy_state, "camera", None) if camera is None else camera
    if not isinstance(lens, Camera):
        raise InputError(f"the policy {planner.policy.name!r} keeps no camera: give camera=")
    return parse_goal(goal).reached(
        forecast_planner(planner, lens, max_range=planner.config.max_range)
    )


_LEAST_GAIN = 0.1
"""Least gain of a doubling of the views [dB]; less is no gain that one could count on."""


@dataclass
class Outlook:
    """Forecasts along a run; hand the run's states through `watch`."""

    run: Run
    num: int = 8
    """Forecasts along the run, the last view's included."""

    calibration: Calibration | None = None
    """What to believe; None: what comes with the package."""

    frames: list[int] = field(default_factory=list[int])
    """Frames taken before each forecast, those captured while moving included."""

    forecasts: list[Forecast] = field(default_factory=list[Forecast])

    @property
    def views(self) -> list[int]:
        """Views taken before each forecast."""
        counts = self._views_by_frame()
        return [int(counts[frames - 1]) for frames in self.frames]

    def _views_by_frame(self) -> np.ndarray:
        """Counts the views up to each frame of the run, that frame included."""
        return np.cumsum([not row.captured for row in self.run.rows])

    def watch(self, states: Iterable[Planner]) -> Iterator[Planner]:
        """Passes on the map and the grid after each frame, and takes a forecast of some of them."""
        counts = self._views_by_frame()
        total = max(counts, default=0)
        views = np.linspace(0, total, self.num + 1).round()[1:]
        # At the views; after the last one also what was captured behind it.
        wanted = {*(np.searchsorted(counts, views[views < total]) + 1), len(counts)}
        for frames, planner in enumerate(states, start=1):
            if frames in wanted:
                self.add(frames, planner)
            yield planner

    def add(self, frames: int, planner: Planner) -> None:
        """Makes the forecast after this number of frames, if there is none yet."""
        if frames not in self.frames:
            reach = config_of(self.run).max_range
            self.frames.append(frames)
            self.forecasts.append(
                forecast_planner(
                    planner,
                    self.run.camera,
                    max_range=reach,
                    calibration=self.calibration,
                )
            )

    def more_views(self, name: str, gain: float = 1.0) -> int | None:
        """Views beyond those taken for `gain` dB more, as things went in the run's second half.

        Args:
            name: of the statistic, `mean` or `p10`.
            gain: [dB].

        Returns:
            The number; None where the last views have brought next to nothing.
        """
        values = [forecast.value(name) for forecast in self.forecasts]
        return more_views(np.asarray(self.views), np.asarray(values), gain)


def more_views(views: np.ndarray, psnr: np.ndarray, gain: float = 1.0) -> int | None:
    """Views to add for `gain` dB, where every doubling of the views adds as much as the last one.

    Args:
        views: taken, increasing, [n].
        psnr: the forecast after each, [n] [dB]; not finite where there is none.
        gain: [dB].

    Returns:
        The number; None if a doubling adds less than 0.1 dB, or if fewer than two forecasts lie
        in the second half of the views.
    """
    late = np.isfinite(psnr) & (2 * views >= views[-1]) if len(views) else np.zeros(0, bool)
    if late.sum() < 2:
        return None
    per_doubling = float(np.polyfit(np.log2(views[late]), psnr[late], 1)[0])
    if per_doubling < _LEAST_GAIN:
        return None
    return int(np.ceil(views[-1] * (2.0 ** (gain / per_doubling) - 1.0)))
