"""Rebuilds the map and the grid from the recorded frames of runs, and explains their views.

An explanation uses the planner's state before a view: the map, the grid, and the unexplored cells
that it had given up. So runs of any policy can be explained by the predicted utility of the chosen
views, even if the policy has no utility.

Shape symbols: m voxels that a view sees; k cells.
"""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import jax
import jax.numpy as jnp
import numpy as np

from r3jax.exploration.captures import scoring_on_the_way
from r3jax.mapping.occupancy import OccupancyGrid, centers_on_host
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.tile_files import Voxels
from r3jax.mapping.tiles import page
from r3jax.planning.decide import PlannerState, explain_path, initial_state
from r3jax.planning.far import Far
from r3jax.planning.planner import Planner, start, take_in
from r3jax.planning.registry import make_policy
from r3jax.planning.turning import count_look
from r3jax.runs.header import RunError
from r3jax.runs.reader import Run, read_run
from r3jax.runs.settings import config_of, planner_config_of
from r3jax.runs.stored_states import known_of
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


@dataclass(frozen=True)
class Difference:
    """An array of a stored state that differs from the rebuilt one."""

    name: str
    """Its name, such as `map.visited`."""

    num_different: int
    """Number of different elements; -1 if the shapes differ."""

    largest: float
    """The largest difference of two elements."""


def rebuild(
    runs: Sequence[Run], views: int | None = None, on_frame: Callable[[], None] = lambda: None
) -> Planner:
    """Rebuilds the map and the grid from the frames of all runs, one run after the other.

    Args:
        runs: of one scene: the same box, cells, voxels and range.
        views: number of first views of each run; None: all.
        on_frame: called after every frame that has entered the map.

    Raises:
        RunError: the runs do not fit together, or a frame is missing or broken.
    """
    return _last(runs, ((run, row.step) for run in runs for row in run.rows[:views]), on_frame)


def rebuild_team(runs: Sequence[Run]) -> Planner:
    """Rebuilds a team's map and grid after its last meeting, all frames in the clock's order.

    Raises:
        RunError: the runs do not fit together, or a frame is missing or broken.
    """
    # The order in which the team shared them, ties by number: another order changes the last bits.
    steps = sorted((row.seconds, n, row.step) for n, run in enumerate(runs) for row in run.rows)
    return _last(runs, ((runs[number], step) for _, number, step in steps))


def states_of(run: Run) -> Iterator[Planner]:
    """Rebuilds the map and the grid after each view of a run, in order, lazily.

    Raises:
        RunError: no view, invalid settings, or a frame that is missing or broken.
    """
    return _states(first_planner([run]), ((run, row.step) for row in run.rows))


def _last(
    runs: Sequence[Run],
    frames: Iterable[tuple[Run, int]],
    on_frame: Callable[[], None] = lambda: None,
) -> Planner:
    """Rebuilds the map and the grid after all frames, each given by its run and number."""
    # Before the first frame: mapping takes minutes, and mismatches are reported immediately.
    for run in runs[1:]:
        check_alike(runs[0], run)
    planner = first_planner(runs)
    for after in _states(planner, frames):
        planner = after
        on_frame()
    return planner


def _states(planner: Planner, frames: Iterable[tuple[Run, int]]) -> Iterator[Planner]:
    """Yields the map and the grid after each frame."""
    for run, step in frames:
        planner = take_in(planner, run.frame(step))
        yield planner


def team_of(run: Run) -> list[Run]:
    """Reads the runs of all members of a run's team, in order.

    Raises:
        RunError: it has no team; a member is missing, or was interrupted before the last meeting.
    """
    names = (run.header.parent or {}).get("team")
    if not names:
        raise RunError(run.path, "it is not part of a team")
    team = [read_run(run.path.parent / name) for name in names]
    for member in team:
        # Stored maps only contain all frames after the last meeting.
        if member.end is None:
            raise RunError(
                member.path,
                "the team was interrupted before its last meeting: resume it with "
                f"`r3jax team --resume {run.path.parent}`",
            )
    return team


def first_planner(runs: Sequence[Run]) -> Planner:
    """Makes the map and the grid before the first view of runs in one scene.

    Of whatever policy they are: the planner maps and decides nothing.

    Raises:
        RunError: a run without a view, or invalid settings.
    """
    bounds = np.asarray(runs[0].header.bounds, dtype=np.float64)
    # All starts before any frame: the space around each start is free, but in no image.
    starts = [pose for run in runs for pose in starts_of(run)]
    config = config_of(runs[0])
    policy = make_policy("r3", scoring=scoring_on_the_way(config))
    try:
        return start(runs[0].camera, bounds, policy, starts=starts, config=config)
    except ValueError as error:
        raise RunError(runs[0].path / "run.json", str(error)) from None


def stored_planner(run: Run) -> tuple[int, Planner]:
    """Reads the newest stored map and grid, and the view after which they were stored.

    Raises:
        RunError: there is none, or it cannot be read.
    """
    steps = run.checkpoint_steps()
    if not steps:
        raise RunError(run.path / "checkpoints", "the run has no checkpoint")
    tables = run.load_checkpoint(steps[-1])
    try:
        return steps[-1], known_of(tables, first_planner([run]))
    except ValueError as error:
        path = run.path / "checkpoints" / f"{steps[-1]:06d}"
        raise RunError(path, f"the checkpoint cannot be read ({error})") from None


def check_decided_alone(run: Run) -> None:
    """Refuses a run whose views were not decided on the map of its own frames.

    Raises:
        RunError: it was merged, or is part of a team.
    """
    if run.header.is_merged:
        raise RunError(run.path, "it was merged from runs with separate maps")
    if run.header.is_of_team:
        raise RunError(
            run.path, "it is part of a team, and its views were also decided on frames of others"
        )


def is_decided_apart(run: Run) -> bool:
    """Returns True for a fork with views that were decided on another map than its frames'."""
    return bool((run.header.parent or {}).get("decided_apart", False))


def differences(
    run: Run, on_frame: Callable[[], None] = lambda: None
) -> tuple[int, list[Difference]]:
    """Finds the differences between the newest stored map and grid and those rebuilt from frames.

    For a run of a team, the frames of all members are used.

    Args:
        run: with a stored map.
        on_frame: called after every mapped frame, if the run is not part of a team.

    Returns:
        The number of compared views, and all arrays that differ.

    Raises:
        RunError: no checkpoint, an unreadable checkpoint or frame, an interrupted team.
    """
    # It may be older than the last row: checkpoints are skipped while one is being written.
    step, stored_map, stored_grid = run.checkpoint()
    team = [run]
    if run.header.is_of_team:
        team = team_of(run)
        planner = rebuild_team(team)
    else:
        planner = rebuild([run], step + 1, on_frame)
    map_state, grid = planner.whole_map, planner.whole_grid
    if planner.far is not None:
        # Where a row lies in a table depends on when its tile came to hand.
        stored_map, map_state = sorted_rows(stored_map), sorted_rows(map_state)
    found: list[Difference | None] = []
    for table, stored, rebuilt in (("map", stored_map, map_state), ("grid", stored_grid, grid)):
        for name, array in vars(stored).items():
            if isinstance(array, jax.Array):
                found.append(_compare(f"{table}.{name}", array, getattr(rebuilt, name)))
    views = step + 1 if team == [run] else sum(len(member.rows) for member in team)
    return views, [difference for difference in found if difference is not None]


def sorted_rows(state: MapState) -> MapState:
    """Returns the rows of voxels in the order of their keys; nothing can be looked up in them."""
    present = np.flatnonzero(np.asarray(state.present))
    order = present[np.lexsort(np.asarray(state.key)[:, present])]
    return state.take(jnp.asarray(order), jnp.ones(len(order), bool))


def _compare(name: str, stored: jax.Array, rebuilt: jax.Array) -> Difference | None:
    a, b = np.asarray(stored), np.asarray(rebuilt)
    if a.shape != b.shape:
        return Difference(name, -1, float("inf"))
    # No tolerance: frames are mapped in their stored form, so that a rebuilt map is bit-identical.
    different = a != b
    if not different.any():
        return None
    # As float64: unsigned integers would wrap around, and Booleans cannot be subtracted.
    gap = np.abs(a.astype(np.float64) - b.astype(np.float64))
    return Difference(name, int(different.sum()), float(gap.max()))


def parts_of(run: Run) -> list[int]:
    """Returns the number of views of each part of a merged run, or of the whole run."""
    return (run.header.parent or {}).get("merged_views", [len(run.rows)])


def starts_of(run: Run) -> list[np.ndarray]:
    """Returns the initial poses of a run; a merged run has several."""
    if not run.rows:
        raise RunError(run.path, "the run has no view")
    # No part follows the last one: its sum would be one past the last row.
    begins = itertools.accumulate(parts_of(run)[:-1], initial=0)
    return [np.asarray(run.rows[step].pose, dtype=np.float64) for step in begins]


def check_alike(first: Run, other: Run) -> None:
    """Refuses runs that did not map the same scene with the same settings."""
    a, b = first.header, other.header
    terms = [
        ("the scene", a.scene.get("hash"), b.scene.get("hash")),
        ("the box", a.bounds, b.bounds),
    ]
    # Settings that affect mapping; speed, budget and clock do not.
    for name in ("voxel_size", "num_bins", "cell_size", "max_range", "drop_edges"):
        terms.append((name, a.config.get(name), b.config.get(name)))
    for name, mine, others in terms:
        if mine != others:
            raise RunError(
                other.path, f"{name} is not that of {first.path}: {others} instead of {mine}"
            )


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


def explain_run(run: Run, states: Iterable[Planner] | None = None) -> Iterator[Reason | None]:
    """Explains why each view of a run was chosen, in order; takes as long as mapping.

    Args:
        run: not a merged run, whose parts decided on separate maps.
        states: the map and the grid after each view, in order; by default rebuilt from the frames.

    Yields:
        The reason of each view; None for the first, which was not chosen, and with tiles for a way
        back to what is not at hand. If frames were captured while moving, it belongs to the first
        row of the path, like the choice.

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
    memory: _Memory | None = None
    before: tuple[np.ndarray, Planner] | None = None
    for row in run.rows:
        if row.choice is None or before is None or memory is None:
            yield None
        else:
            pose, planner = before
            choice = row.choice
            # The memory is passed from view to view: cells that were given up do not count later.
            state, explanation = explain_path(
                memory.state, planner.map_state, planner.grid, pose, choice.pose,
                choice.waypoints, config,
            )  # fmt: skip
            if planner.far is None or planner.far.is_at_hand(choice.pose[:3, 3]):
                memory = replace(memory, state=state)
                yield reason_of(explanation, planner.grid)
            else:
                memory = replace(memory, state=replace(state, trail=memory.state.trail))
                yield None
        if row is not run.rows[-1]:  # no decision was made on the last map
            planner = next(after_views)
            before = np.asarray(row.pose, dtype=np.float64), planner
            if memory is None:
                memory = _Memory(initial_state(run.camera, planner.grid, motion=config.motion))
            memory = memory.beside(planner)
            if row.captured:
                known, view = (planner.map_state, planner.grid), (run.camera, jnp.asarray(row.pose))
                state = count_look(memory.state, *known, *view, scoring)
                memory = replace(memory, state=state)


@dataclass(frozen=True)
class _Memory:
    """A policy's memory along a run."""

    state: PlannerState

    far: Far | None = None
    """With tiles: its cells that are not at hand."""

    def beside(self, planner: Planner) -> "_Memory":
        """Returns the memory of the cells that a planner has at hand."""
        if planner.far is None:
            return self
        tiles = planner.far.tiles
        if self.far is None:
            empty = replace(tiles, voxels=Voxels(), cells={})
            trails = planner.far.trails[:0]
            return replace(self, far=replace(planner.far, tiles=empty, trails=trails))
        lattice, far = tiles.lattice, self.far.with_trail(self.state.trail)
        center = lattice.corner(tiles.middle) + 0.5 * lattice.size
        layers = {"looks": self.state.looks}
        _, layers, kept = page(empty_map(2), layers, far.tiles, center)
        far = replace(far, tiles=kept)
        return _Memory(replace(self.state, looks=layers["looks"], trail=far.trail), far)
