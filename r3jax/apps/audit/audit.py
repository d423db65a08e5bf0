"""Audits a capture: maps it, diagnoses every surface, evaluates its frames and suggests views.

Shape symbols: n frames of the evaluated path.
"""

import dataclasses
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np

from r3jax.apps.audit.diagnosis import (
    NOT_KNOWN,
    Diagnosis,
    Pictures,
    Region,
    ViewScore,
    bad_regions,
    blank_points,
    blank_regions,
    demand_of,
    known_rows,
    unseen_edges,
    unseen_regions,
    view_score,
)
from r3jax.apps.audit.settings import AuditSettings
from r3jax.apps.audit.suggest import SuggestedViews, Task, suggest
from r3jax.captures.camera_paths import CameraPath
from r3jax.captures.capture_maps import (
    OnFrame,
    Seen,
    cut_grid,
    eyes_of,
    in_fitting_voxels,
    neighborhoods_of,
    see,
    united,
    window_of,
)
from r3jax.captures.faults.faults import Faults, find_faults, stray_finding
from r3jax.captures.neighborhoods import Neighborhood, neighborhoods
from r3jax.captures.source import Source, thinned
from r3jax.captures.standpoints import Places, as_dense, inward_center, places_of
from r3jax.captures.surfaces import with_surfaces
from r3jax.captures.survey import RANGE, Survey, survey_of
from r3jax.errors import InputError
from r3jax.formats.lenses import Lens
from r3jax.geometry.cameras import Camera
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.planning.robot.explorable import mask_unexplorable
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.utility import visible_unexplored

_UNSEEN_WEIGHT = 0.05
"""Weight of a cell at the edge of known space, as a share of the voxels that it may hide. It is
below 1 because an audit first improves what was captured, and only then extends it."""

SATURATED = 0.9
"""Mean renderability above which R no longer ranks the frames. In a capture of a kitchen with 250
pictures, each held out once, the mean was 0.96 and the rank correlation of R with PSNR -0.00."""

_MAX_FAILED_LOOKS = 3
"""A cell still unexplored after this many images that should show it is given up."""


@dataclass(frozen=True)
class EvaluatedFrame:
    """One frame of the evaluated path."""

    index: int
    """Index of the image in the capture, or of the pose in the path."""

    label: str
    """Name of the frame in reports."""

    pose: np.ndarray
    """`T_world_camera`, [4, 4] float64 [audit units]."""

    score: ViewScore
    """Predicted render quality."""


@dataclass(frozen=True)
class Audit:
    """Result of an audit. Lengths and poses are in audit coordinates; see `survey.alignment`."""

    source: Source
    survey: Survey
    seen: Seen
    config: ScoringConfig
    """Settings of all scores."""

    lens: Lens
    """Lens of the suggested views: the most common lens of the capture."""

    places: Places
    """Positions that were searched for views."""

    is_object: bool
    """True if the cameras look inward: the places then form a dome of cameras around an object."""

    frames: tuple[EvaluatedFrame, ...]
    """Frames of the evaluated path."""

    is_own_path: bool
    """True if the path is the capture's own, whose frames are evaluated without their fold."""

    regions: tuple[Region, ...]
    """Surfaces that render badly, the worst first."""

    unseen: tuple[Region, ...]
    """Unseen places at the edge of the capture that could be seen; empty without depth images."""

    blank: tuple[Region, ...]
    """Places that pictures show but where no surface is known; empty with a depth camera."""

    unseen_area: float
    """Total area of unseen places [square audit units]."""

    plan: SuggestedViews
    """Suggested views and their expected gain."""

    faults: Faults
    """Faults of single frames: blur, light, poses, repetition."""

    @property
    def standpoints(self) -> np.ndarray:
        """Positions from which surfaces were evaluated, [q, 3] [audit units]."""
        return self.places.standpoints

    @property
    def diagnosis(self) -> Diagnosis:
        """Diagnosis of every voxel in the capture's current state."""
        return self.plan.before

    @property
    def camera(self) -> Camera:
        """Camera of the suggested views, subsampled like the images of the map."""
        return thinned(self.lens.camera, self.source.stride)

    @property
    def is_saturated(self) -> bool:
        """True if the frames' mean R is so high that R no longer ranks them."""
        return self.mean_renderability >= SATURATED

    @property
    def all_regions(self) -> tuple[Region, ...]:
        """All regions, in the order of their letters."""
        return (*self.regions, *self.blank, *self.unseen)

    @property
    def unknown(self) -> str:
        """Cause reported for pixels of pictures without any known surface."""
        return "unseen" if self.source.is_complete else NOT_KNOWN

    @property
    def shares(self) -> dict[str, float]:
        """Share of the frames' pixels with each cause, and of those that are unseen or not known.

        They sum to 1. The capture's own pictures without depth are included, as unseen.
        """
        blank = len(self.faults.without_depth) if self.is_own_path else 0
        total = len(self.frames) + blank
        names = self.frames[0].score.shares
        shares = {name: sum(f.score.shares[name] for f in self.frames) / total for name in names}
        return shares | {self.unknown: shares[self.unknown] + blank / total}

    @property
    def renderability(self) -> np.ndarray:
        """Renderability of every frame of the path, [n]; NaN for frames without a known surface."""
        return np.array([frame.score.renderability for frame in self.frames])

    @property
    def mean_renderability(self) -> float:
        """Mean over the frames; without a depth camera, over all their known pixels."""
        value = self.renderability
        weight = np.array([frame.score.judged for frame in self.frames])
        return float(np.nansum(value * weight) / max(weight.sum(), 1e-9))


Progress = Callable[[str, int], None]
"""Progress callback: called with the name of a stage and its number of steps when the stage begins,
and with an empty name after each step."""


def audit(
    source: Source,
    settings: AuditSettings | None = None,
    path: CameraPath | None = None,
    on_progress: Progress = lambda stage, steps: None,
) -> Audit:
    """Audits a capture.

    Args:
        source: the capture.
        settings: the user's settings.
        path: poses to evaluate, in the capture's coordinates; None for the capture's own.
        on_progress: progress callback.

    Raises:
        ValueError: a setting is invalid; depth images contradict the poses; or fewer than two
            images have known depth.
        FormatError: fewer than two images can be read, or there is no source of depth.
        RunError: a file of a run is missing or broken.
    """
    settings = AuditSettings() if settings is None else settings
    step = lambda: on_progress("", 1)
    source, survey, faults = _survey(source, settings, step, on_progress)

    def mapped(survey: Survey, on_frame: OnFrame) -> Seen:
        on_progress("mapping", 2 * len(survey.chosen))
        return see(source, survey, settings.folds, on_frame)

    survey, seen = in_fitting_voxels(survey, settings, mapped, step)
    unit = _UNSEEN_WEIGHT * (survey.cell_size / survey.voxel_size) ** 2
    config = ScoringConfig(lambda1=unit, max_range=RANGE)
    lens = Counter(source.lenses).most_common(1)[0][0]
    camera = thinned(lens.camera, source.stride)
    cameras = eyes_of(source, survey)
    surfaces = np.asarray(seen.state.center, np.float64).T[np.asarray(seen.state.present)]
    center = inward_center(survey.alignment.poses(source.poses[survey.chosen]), surfaces)
    places = places_of(
        seen.state,
        seen.grid,
        cameras,
        as_dense(settings.num_places, cameras),
        is_dense=source.is_dense,
        meter=survey.alignment.scale if source.is_metric else None,
        center=center,
        with_cameras=True,
        num_standpoints=settings.num_standpoints,
    )
    on_progress("evaluating frames", len(survey.chosen if path is None else path.poses))
    if path is None:
        frames = _evaluated_frames(source, survey, seen, config, step)
    else:
        frames = _evaluated_path(source, survey, seen, config, path, step)
    open_grid = _open_grid(source, survey, seen, cameras, config)
    on_progress("choosing views", settings.views)
    known = known_rows(seen.state, source.is_complete)
    task = Task(camera, demand_of(seen.state, places.standpoints, config, known), config)
    plan = suggest(
        seen.state,
        open_grid,
        task,
        places,
        settings.views,
        start=cameras[-1],
        most_places=settings.num_places,
        seed=settings.seed,
        on_view=step,
    )
    edges = np.asarray(open_grid.unexplored)
    return Audit(
        source=source,
        survey=survey,
        seen=seen,
        config=config,
        lens=lens,
        places=places,
        is_object=center is not None,
        frames=tuple(frames),
        is_own_path=path is None,
        regions=tuple(bad_regions(seen.state, plan.before)),
        unseen=tuple(unseen_regions(seen.grid, edges)),
        blank=() if source.is_complete else _blank_regions(source, survey, seen, config),
        unseen_area=float(edges.sum()) * survey.cell_size**2,
        plan=plan,
        faults=faults,
    )


def _survey(
    source: Source,
    settings: AuditSettings,
    step: Callable[[], None],
    on_progress: Progress,
) -> tuple[Source, Survey, Faults]:
    """Finds surfaces and faults of the pictures, and leaves out those that cannot be mapped."""
    if settings.depth_scale != 1.0 or settings.depth_along_ray:
        source = source.with_depth(settings.depth_scale, is_along_ray=settings.depth_along_ray)
    source = with_surfaces(source, settings.surfaces, settings.model, on_progress)
    on_progress("looking at the capture", 0)
    survey = survey_of(source, settings)
    on_progress("comparing pictures", len(survey.chosen))
    faults = find_faults(source, survey.chosen, step, fits=survey.doubt is None)
    if survey.strays:
        stray = stray_finding(source, survey.strays, survey.chosen)
        faults = dataclasses.replace(faults, findings=(stray, *faults.findings))
    unknown = np.array([*faults.left_out, *faults.without_depth], dtype=np.int64)
    survey = dataclasses.replace(survey, chosen=np.setdiff1d(survey.chosen, unknown))
    if len(survey.chosen) < 2:
        raise InputError(
            f"{source.name}: {len(survey.chosen)} of its {len(source)} pictures shows a surface "
            "of known depth: an audit judges each picture by the others, so it needs at least two"
        )
    return source, survey, faults


def _evaluated_path(
    source: Source,
    survey: Survey,
    seen: Seen,
    config: ScoringConfig,
    path: CameraPath,
    step: Callable[[], None],
) -> list[EvaluatedFrame]:
    """Evaluates the frames of a camera path on the map of all pictures."""
    poses = survey.alignment.poses(path.poses)
    cameras = [thinned(lens.camera, source.stride) for lens in path.lenses]
    found: dict[int, EvaluatedFrame] = {}
    every = np.arange(len(survey.chosen))
    for near in neighborhoods(seen.state, poses[:, :3, 3], cameras, RANGE, for_lookups=False):
        shown = _pictures(source, survey, near, every)
        for index in near.numbers.tolist():
            score = view_score(near.state, cameras[index], poses[index], config, shown)
            found[index] = EvaluatedFrame(index, f"frame {index + 1}", poses[index], score)
            step()
    return [found[index] for index in sorted(found)]


def _evaluated_frames(
    source: Source, survey: Survey, seen: Seen, config: ScoringConfig, step: Callable[[], None]
) -> list[EvaluatedFrame]:
    """Evaluates the capture's own frames, each on the map without its fold."""
    poses = survey.alignment.poses(source.poses[survey.chosen])
    found: dict[int, EvaluatedFrame] = {}
    for near in neighborhoods_of(seen.state, source, survey, for_lookups=False):
        parts = [near.part_of(part) for part in seen.folds]
        for fold in np.unique(seen.fold_of[near.numbers]).tolist():
            others = united([part for i, part in enumerate(parts) if i != fold])
            shown = _pictures(source, survey, near, np.flatnonzero(seen.fold_of != fold))
            for place in near.numbers[seen.fold_of[near.numbers] == fold].tolist():
                index = int(survey.chosen[place])
                depth = None if shown is None else survey.alignment.scale * source.read(index)[1]
                camera = source.camera(index)
                score = view_score(others, camera, poses[place], config, shown, depth)
                found[place] = EvaluatedFrame(index, source.labels[index], poses[place], score)
                step()
    return [found[place] for place in sorted(found)]


def _pictures(
    source: Source, survey: Survey, near: Neighborhood, numbers: np.ndarray
) -> Pictures | None:
    """Lists some pictures of a map in which surfaces may be unknown; None if all are known."""
    if source.is_complete:
        return None
    known = known_rows(near.state, is_complete=False)
    chosen = survey.chosen[numbers]
    poses = survey.alignment.poses(source.poses[chosen])
    return Pictures(known, [source.camera(index) for index in chosen.tolist()], poses)


def _blank_regions(
    source: Source, survey: Survey, seen: Seen, config: ScoringConfig
) -> tuple[Region, ...]:
    poses = survey.alignment.poses(source.poses[survey.chosen])
    points: dict[int, np.ndarray] = {}
    for near in neighborhoods_of(seen.state, source, survey, for_lookups=False):
        known = known_rows(near.state, is_complete=False)
        for i in near.numbers.tolist():
            camera = source.camera(int(survey.chosen[i]))
            points[i] = blank_points(near.state, known, camera, poses[i], config)
    return tuple(blank_regions(seen.state, list(points.values())))


def _open_grid(
    source: Source, survey: Survey, seen: Seen, cameras: np.ndarray, config: ScoringConfig
) -> OccupancyGrid:
    """Returns the grid in which only the edges of the seen space are unexplored.

    An edge is a cell beside free space that could have been seen but was not.
    """
    grid = seen.grid
    if not source.is_complete:  # cells beside free space may have been in view without a depth
        return grid.ignoring(grid.unexplored)
    cells = np.floor((cameras - np.asarray(grid.origin)) / float(grid.cell_size)).astype(np.int64)
    cells = cells.clip(0, np.array(grid.log_odds.shape) - 1)
    reached = np.zeros(grid.log_odds.shape, dtype=bool)
    reached[tuple(cells.T)] = True
    looks = np.zeros(grid.log_odds.shape, dtype=np.int32)
    poses = survey.alignment.poses(source.poses[survey.chosen])
    for near in neighborhoods_of(seen.state, source, survey, for_lookups=False):
        for i in near.numbers.tolist():
            camera, T = source.camera(int(survey.chosen[i])), jnp.asarray(poses[i], jnp.float32)
            start, size = window_of(grid, poses[i, :3, 3])
            part = visible_unexplored(near.state, cut_grid(grid, start, size), camera, T, config)
            at = tuple(slice(a, a + n) for a, n in zip(start.tolist(), size, strict=True))
            looks[at] += np.asarray(part)
    explorable = np.asarray(mask_unexplorable(grid, reached, looks >= _MAX_FAILED_LOOKS).unexplored)
    edges = unseen_edges(grid, explorable)
    return grid.ignoring(~edges)
