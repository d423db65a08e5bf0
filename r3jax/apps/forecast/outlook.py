"""How the forecast of a recorded run came along, and how many more views a decibel would take."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from r3jax.apps.forecast.forecast import Forecast, forecast_map
from r3jax.apps.forecast.psnr import Calibration
from r3jax.exploration.replay import config_of
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState
from r3jax.trace.reader import Run

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
    """Frames taken before each forecast, those on the way included."""

    forecasts: list[Forecast] = field(default_factory=list[Forecast])

    @property
    def views(self) -> list[int]:
        """Views taken before each forecast."""
        counts = self._views_by_frame()
        return [int(counts[frames - 1]) for frames in self.frames]

    def _views_by_frame(self) -> np.ndarray:
        """Views up to each frame of the run, that frame included."""
        return np.cumsum([not row.captured for row in self.run.rows])

    def watch(
        self, states: Iterable[tuple[MapState, OccupancyGrid]]
    ) -> Iterator[tuple[MapState, OccupancyGrid]]:
        """Passes on the map and the grid after each frame, and takes a forecast of some of them."""
        counts = self._views_by_frame()
        total = max(counts, default=0)
        views = np.linspace(0, total, self.num + 1).round()[1:]
        # At the views; after the last one also what was captured behind it.
        wanted = {*(np.searchsorted(counts, views[views < total]) + 1), len(counts)}
        for frames, (map_state, grid) in enumerate(states, start=1):
            if frames in wanted:
                self.add(frames, map_state, grid)
            yield map_state, grid

    def add(self, frames: int, map_state: MapState, grid: OccupancyGrid) -> None:
        """The forecast after so many frames, if there is none yet."""
        if frames not in self.frames:
            reach = config_of(self.run).max_range
            self.frames.append(frames)
            self.forecasts.append(
                forecast_map(
                    map_state,
                    grid,
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
