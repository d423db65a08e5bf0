"""Explains why each view of a recorded run was chosen, by the map before it.

The planner's state is rebuilt from the frames: the map, the grid, and the unexplored cells that it
had given up. So runs of any policy can be explained by the predicted utility of the chosen views,
even if the policy has no utility.

Shape symbols: m voxels that a view sees; k cells.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from r3jax.exploration.captures import scoring_on_the_way
from r3jax.mapping.occupancy import OccupancyGrid, centers_on_host
from r3jax.mapping.state import MapState
from r3jax.planning.decide import explain_path, initial_state
from r3jax.planning.turning import count_look
from r3jax.runs.header import RunError
from r3jax.runs.reader import Run
from r3jax.runs.replay import check_decided_alone, is_decided_apart, states_of
from r3jax.runs.settings import config_of, planner_config_of
from r3jax.scoring.explain import Explanation


@dataclass(frozen=True)
class Reason:
    """The predicted utility of a chosen view: a compact `Explanation`."""

    totals: np.ndarray
    """Utility by cause, in the order of `scoring.explain.CAUSES`, [4] float64."""

    rows: np.ndarray
    """Rows of the earlier map in view, [m]."""

    shares: np.ndarray
    """1 - R of each of them, by cause: too oblique, inconsistent, too far, [3, m] float32."""

    cells: np.ndarray
    """Centers of the unexplored cells in view [m], [k, 3] float32."""

    @property
    def utility(self) -> float:
        """U = lambda1 U_G + U_R."""
        return float(self.totals.sum())


def reason_of(explanation: Explanation, grid: OccupancyGrid) -> Reason:
    """Reduces an explanation to the voxels and cells in view.

    Args:
        explanation: of one view.
        grid: whose cells it counts.
    """
    rows = np.flatnonzero(np.asarray(explanation.visible))
    centers = centers_on_host(grid, np.argwhere(np.asarray(explanation.cells)))
    return Reason(
        totals=np.asarray(explanation.totals, dtype=np.float64),
        rows=rows,
        shares=np.asarray(explanation.shares)[:, rows],
        cells=centers.astype(np.float32),
    )


def explain_run(
    run: Run, states: Iterable[tuple[MapState, OccupancyGrid]] | None = None
) -> Iterator[Reason | None]:
    """Explains why each view of a run was chosen, in order; takes as long as mapping.

    Args:
        run: not a merged run, whose parts decided on separate maps.
        states: the map and the grid after each view, in order; by default rebuilt from the frames.

    Yields:
        The reason of each view; None for the first, which was not chosen. If frames were captured
        while moving, it belongs to the first row of the path, like the choice.

    Raises:
        RunError: the run was merged, or is a fork of a merged run or a team's; a setting is
            unknown, a frame is missing or broken.
    """
    # First: rebuilding the map takes minutes, and no view was decided on the merged map.
    check_decided_alone(run)
    if is_decided_apart(run):
        raise RunError(
            run.path,
            "it took views over from a merged run or one of a team, and those were not decided on "
            "its own map",
        )
    config, scoring = planner_config_of(run), scoring_on_the_way(config_of(run))
    after_views = iter(states_of(run) if states is None else states)
    memory, before = None, None
    for row in run.rows:
        if row.choice is None or before is None:
            yield None
        else:
            pose, (map_state, grid) = before
            memory = memory or initial_state(run.camera, grid, motion=config.motion)
            choice = row.choice
            # The memory is passed from view to view: cells that were given up do not count later.
            memory, explanation = explain_path(
                memory, map_state, grid, pose, choice.pose, choice.waypoints, config
            )
            yield reason_of(explanation, grid)
        if row is not run.rows[-1]:  # no decision was made on the last map
            before = np.asarray(row.pose, dtype=np.float64), next(after_views)
            if row.captured:
                camera, pose = run.camera, jnp.asarray(row.pose)
                memory = count_look(memory, *before[1], camera, pose, scoring)
