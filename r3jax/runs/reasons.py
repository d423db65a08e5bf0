"""Why each view of a recorded run was chosen, by what was known before it was taken.

What a planner knew is rebuilt from the frames: the map, the grid, and which unexplored cells it had
given up. So runs of any policy are explained, those without a utility of their own too: by
what the view that they chose promised.

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
    """What one view promised when it was chosen: an `Explanation`, as small as it can be."""

    totals: np.ndarray
    """Utility by cause, in the order of `scoring.explain.CAUSES`, [4] float64."""

    rows: np.ndarray
    """Rows of the map before the view that it was to see, [m]."""

    shares: np.ndarray
    """1 - R of each of them, by cause: too oblique, inconsistent, too far, [3, m] float32."""

    cells: np.ndarray
    """Centers of the unexplored cells that it was to see [m], [k, 3] float32."""

    @property
    def utility(self) -> float:
        """U = lambda1 U_G + U_R."""
        return float(self.totals.sum())


def reason_of(explanation: Explanation, grid: OccupancyGrid) -> Reason:
    """Summarizes an explanation for what the view sees.

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
    """Explains why each view of a run was chosen, in order; takes as long as mapping took.

    Args:
        run: not a merged one: each of its runs decided on a map of its own.
        states: the map and the grid after each view, in order; by default rebuilt from the frames.
            The state after a view is read with the reason of the next one.

    Yields:
        The reason of each view; None for the first, which was not chosen. Where frames were
        captured while moving, it stands in the first row of the path, as the choice does.

    Raises:
        RunError: the run was merged, or is a fork of one that was or that flew in a team; a
            setting of it is not known, a frame is missing or broken.
    """
    # First: rebuilding the map takes minutes, and would show a map on which no view was decided.
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
            # The memory goes from view to view: cells that were given up count for nothing later.
            memory, explanation = explain_path(
                memory, map_state, grid, pose, choice.pose, choice.waypoints, config
            )
            yield reason_of(explanation, grid)
        if row is not run.rows[-1]:  # nothing was decided on the last map
            before = np.asarray(row.pose, dtype=np.float64), next(after_views)
            if row.captured:
                camera, pose = run.camera, jnp.asarray(row.pose)
                memory = count_look(memory, *before[1], camera, pose, scoring)
