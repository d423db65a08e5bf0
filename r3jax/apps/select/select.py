"""Selects the frames of a capture to keep, and explains why the others are dropped.

Shape symbols: n frames that can be read; T targets; k chosen.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike

from r3jax.apps.select.choose import Choice, choose, component_of, tie_ranks
from r3jax.apps.select.observations import Observed, observe
from r3jax.apps.select.quality import (
    Quality,
    exposures,
    fineness,
    quality_of,
    unknown_quality,
    with_quality,
)
from r3jax.apps.select.settings import FRAMES, STAND, SelectSettings
from r3jax.apps.select.targets import Targets, see_targets
from r3jax.captures.camera_paths import path_of
from r3jax.captures.capture_maps import (
    OnFrame,
    eyes_of,
    in_fitting_voxels,
    join_frame,
    join_on_rows,
    map_grid,
    map_of_all,
)
from r3jax.captures.faults.blocks import BlockImage, block_image
from r3jax.captures.neighborhoods import divided
from r3jax.captures.source import Picture, Source, thinned
from r3jax.captures.standpoints import as_dense, places_of
from r3jax.captures.surfaces import with_surfaces
from r3jax.captures.survey import RANGE, Survey, survey_of
from r3jax.errors import InputError
from r3jax.formats.errors import FormatError
from r3jax.frame import Frame, read_ahead
from r3jax.geometry.cameras import Camera, angle_between
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import poses_along

STANDPOINTS, _DIRECTIONS = 24, 8
"""Number of places with target views in a house, and of level directions at each."""

_OUTSIDE = 0.05
"""Minimum share of a target's pixels that show the map; below it the target is outside of the
capture."""

_TWIN = (0.1, 8.0)
"""A frame within this distance of a chosen one, in median depths, and this angle [deg] is its
near-duplicate ("twin")."""

_SEVERAL = 0.02
"""Minimum share of the frames for a scene to be reported as a scene."""

Progress = Callable[[str, int], None]
"""Progress callback: called with the name of a stage and its number of steps when the stage begins,
and with an empty name after each step."""


@dataclass(frozen=True)
class Selected:
    """Result of a selection. Poses are in the capture's coordinates."""

    source: Source
    survey: Survey
    settings: SelectSettings
    used: np.ndarray
    """Indices in the capture of the frames that were examined, [n]."""

    whole: MapState
    """Map of all these frames [audit units]."""

    quality: Quality
    choice: Choice
    """The selection; its frame indices refer to `used`."""

    targets: int
    """Number of targets T."""

    scenes: np.ndarray
    """Scene of each frame, [n]."""

    reasons: dict[int, str]
    """Short reasons for dropped frames, by their indices in the capture."""

    notes: tuple[str, ...] = field(default=())
    """Notes for the user, in sentences."""

    @property
    def kept(self) -> np.ndarray:
        """Indices in the capture of the frames kept, ascending."""
        return np.sort(self.used[self.choice.order])


def select(
    source: Source,
    settings: SelectSettings | None = None,
    *,
    capture: object = None,
    on_progress: Progress = lambda stage, steps: None,
    is_interrupted: Callable[[], bool] = lambda: False,
) -> Selected:
    """Chooses the frames of a capture to keep.

    Args:
        source: the capture.
        settings: number of frames and targets.
        capture: the opened capture, whose coordinates a camera path uses.
        on_progress: progress callback.
        is_interrupted: called after each choice; if True, the frames chosen so far are the result.

    Raises:
        ValueError: no two frames show the same surface; a name of a frame that does not exist; a
            camera path outside of the capture; nothing would be kept.
        FormatError: fewer than two frames can be read, or there is no source of depth.
        RunError: a file of a run is missing or broken.
        SceneFileError: the trained splat cannot be read.
    """
    settings = SelectSettings() if settings is None else settings
    if settings.depth_scale != 1.0 or settings.depth_along_ray:
        source = source.with_depth(settings.depth_scale, is_along_ray=settings.depth_along_ray)
    source = with_surfaces(source, settings.surfaces, settings.model, on_progress)
    step = lambda: on_progress("", 1)
    on_progress("examining the capture", 0)
    survey = survey_of(source, settings)

    def mapped(survey: Survey, on_frame: OnFrame) -> _Surfaces:
        on_progress("reading frames", len(survey.chosen))
        return _surfaces(source, survey, on_frame)

    survey, (whole, images, fine, unread) = in_fitting_voxels(survey, settings, mapped, step)
    used = np.setdiff1d(survey.chosen, list(unread))
    if len(used) < 2:
        raise next(iter(unread.values()), FormatError(Path(source.name), "fewer than two frames"))
    on_progress("finding what each frame shows", len(used))
    read = lambda number: source.frame(int(used[number]), survey.alignment)
    join = lambda part, whole, frame: join_frame(part, whole, source, frame)
    eyes = survey.alignment.points(source.poses[used, :3, 3])
    observed = observe(whole, read, eyes, map(source.camera, used.tolist()), join, step)
    scenes = component_of(observed)
    if scenes.max() + 1 == len(used):
        raise InputError(
            f"{source.name}: no two of its {len(used)} frames show the same surface, so frames "
            "cannot be compared: check the poses"
        )
    on_progress("comparing frames", 0)
    quality = quality_of(images, fine, observed) if source.has_images else unknown_quality(observed)
    observed = with_quality(observed, quality.blur, quality.exposure)
    keep = _named(source, used, settings.keep)
    allowed, reasons = _allowed(settings, quality, source, used, keep)
    on_progress("drawing targets", 0)
    targets = _targets(source, survey, settings, whole, observed, used, capture)
    num = settings.number(len(used)) if settings.chooses else int(allowed.sum())
    on_progress("choosing frames", num)
    choice = choose(
        observed,
        targets,
        max(num, len(keep)),
        gain=settings.wanted_gain if settings.chooses else None,
        keep=keep if settings.chooses else np.flatnonzero(allowed).tolist(),
        allowed=allowed,
        ranks=tie_ranks(-quality.blur, source.poses[used, :3, 3], [source.labels[i] for i in used]),
        is_exact=settings.exact,
        on_choice=lambda: is_interrupted() or bool(step()),
    )
    found = Selected(
        source, survey, settings, used, whole, quality, choice, len(targets), scenes, {}
    )
    reasons |= _reasons(found, reasons)
    reasons |= {index: f"cannot be read: {error.reason}" for index, error in unread.items()}
    reasons |= dict.fromkeys(survey.strays, "its pose has diverged")
    notes = _notes(found, targets, len(unread))
    return Selected(
        source, survey, settings, used, whole, quality, choice, len(targets), scenes, reasons,
        notes,
    )  # fmt: skip


_Surfaces = tuple[MapState, list[BlockImage], list[float], dict[int, FormatError]]


def _surfaces(source: Source, survey: Survey, on_frame: OnFrame) -> _Surfaces:
    """Maps all frames; also returns their block images, their fineness, and unreadable frames."""
    images: dict[int, tuple[BlockImage, float]] = {}
    unread: dict[int, FormatError] = {}
    groups = divided(eyes_of(source, survey), RANGE)
    order = np.concatenate(groups).tolist()

    def read(number: int) -> tuple[Picture, Frame] | FormatError:
        index = int(survey.chosen[number])
        picture = source.try_read(index)
        if isinstance(picture, FormatError):
            return picture
        return picture, source.framed(picture, index, survey.alignment)

    def frames() -> Iterator[Frame | None]:
        for number, found in zip(order, read_ahead(map(read, order)), strict=True):
            on_frame()
            index = int(survey.chosen[number])
            if isinstance(found, FormatError):
                unread[index] = found
                yield None
            else:
                picture, frame = found
                image = block_image(*picture, source.camera(index), source.poses[index])
                images[number] = image, fineness(picture[0])
                yield frame

    whole = map_of_all(frames(), groups, survey.voxel_size, drop_edges=source.is_dense)
    found = [images[number] for number in sorted(images)]
    return whole, [image for image, _ in found], [fine for _, fine in found], unread


def _named(source: Source, used: np.ndarray, names: Sequence[str]) -> list[int]:
    """Finds frames by name, with or without suffix, as indices into `used`."""
    found: list[int] = []
    for name in names:
        fits = [i for i, index in enumerate(used) if _is_named(source.labels[index], name)]
        if len(fits) != 1:
            how = "no frame" if not fits else f"{len(fits)} frames"
            raise InputError(
                f"--keep {name}: {how} of the capture {'has' if not fits else 'have'} that name, "
                f"such as {source.labels[used[0]]}"
            )
        found += [i for i in fits if i not in found]
    return found


def _is_named(label: str, name: str) -> bool:
    return name in (label, Path(label).name, Path(label).stem, label.rpartition(" ")[2])


def _allowed(
    settings: SelectSettings,
    quality: Quality,
    source: Source,
    used: np.ndarray,
    keep: Sequence[int],
) -> tuple[np.ndarray, dict[int, str]]:
    """Returns a mask of the frames that may be chosen, [n], and reasons why the others may not.

    Raises:
        ValueError: no frame may be chosen.
    """
    reasons: dict[int, str] = {}
    allowed = np.ones(len(used), dtype=bool)
    if settings.drop_duplicates:
        for i in np.flatnonzero(quality.twin_of >= 0).tolist():
            allowed[i] = False
            reasons[int(used[i])] = f"twin of {source.labels[used[quality.twin_of[i]]]}"
    if settings.drop_blurred:
        for i in np.flatnonzero(quality.is_blurred).tolist():
            allowed[i] = False
            reasons[int(used[i])] = f"blurred by {quality.blur[i]:.1f} px"
    allowed[list(keep)] = True
    for i in keep:
        reasons.pop(int(used[i]), None)
    if not allowed.any():
        raise InputError(
            f"{source.name}: all {len(used)} frames are blurred, so none would be kept: leave out "
            "--drop-blurred, or repeat the capture"
        )
    return allowed, reasons


def _targets(
    source: Source,
    survey: Survey,
    settings: SelectSettings,
    whole: MapState,
    observed: Observed,
    used: np.ndarray,
    capture: object,
) -> Targets:
    """Returns the views whose renderability counts.

    Raises:
        ValueError: a camera path that shows nothing of the capture.
        FormatError, RunError: a camera path that cannot be read.
    """
    if settings.targets == FRAMES:
        cameras = [source.camera(int(i)) for i in used]
        poses = survey.alignment.poses(source.poses[used])
    elif settings.targets == STAND:
        grid = map_grid(source, survey, used)
        stood = survey.alignment.points(source.poses[used, :3, 3])
        meter = survey.alignment.scale if source.is_metric else None
        places = places_of(
            whole,
            grid,
            stood,
            as_dense(STANDPOINTS, stood),
            is_dense=source.is_dense,
            meter=meter,
        ).standing
        angles = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
        level = np.stack([np.cos(angles), np.sin(angles), np.zeros(_DIRECTIONS)], axis=1)
        poses = poses_along(
            np.repeat(places, _DIRECTIONS, axis=0), np.tile(level, (len(places), 1))
        )
        cameras = [source.camera(int(used[0]))] * len(poses)
    else:
        path = path_of(Path(settings.targets), capture)
        poses = survey.alignment.poses(path.poses)
        cameras = [thinned(lens.camera, source.stride) for lens in path.lenses]
    targets = see_targets(whole, observed, cameras, poses, RANGE)
    if settings.targets != FRAMES and not (targets.coverage >= _OUTSIDE).any():
        raise InputError(
            f"--targets {settings.targets}: none of its {len(targets)} views shows the capture: "
            "give a path in the capture's coordinates"
        )
    return targets


def _reasons(found: Selected, known: dict[int, str]) -> dict[int, str]:
    """Explains why each frame was not chosen, by its index in the capture."""
    source, used, quality = found.source, found.used, found.quality
    order = found.choice.order
    total = max(float(found.choice.of_all.mean()), 1e-9)
    reasons: dict[int, str] = {}
    for i in np.setdiff1d(np.arange(len(used)), order).tolist():
        index, share = int(used[i]), float(found.choice.left[i]) / total
        if index in known:
            continue
        twin = _twin(found, i)
        if quality.is_blurred[i]:
            reasons[index] = f"blurred by {quality.blur[i]:.1f} px"
        elif twin is not None:
            reasons[index] = f"twin of {source.labels[used[twin]]}"
        else:
            reasons[index] = _adds(share, len(used))
    return reasons


_NOTHING = 0.02
"""A frame adds nothing if it adds less than this part of what a frame of the capture gives on
average. Of a share of the whole, each of 5,000 frames would add nothing."""


def _adds(share: float, num: int) -> str:
    """Says what one more frame would add, as a share of what all `num` frames give."""
    if share < _NOTHING / num:
        return "adds nothing"
    percent = 100.0 * share
    if percent < 0.1:
        return f"adds {np.format_float_positional(percent, 1, fractional=False, trim='-')} %"
    return f"adds {percent:.1f} %"


def _twin(found: Selected, frame: int) -> int | None:
    """Finds a chosen frame that shows nearly the same, or None."""
    poses = found.source.poses[found.used]
    order = found.choice.order
    near, turned = _TWIN
    apart = np.linalg.norm(poses[order, :3, 3] - poses[frame, :3, 3], axis=1)
    best = int(order[np.argmin(apart)])
    if apart.min() > near * found.survey.median_depth:
        return None
    is_alike = angle_between(poses[best], poses[frame]) < np.radians(turned)
    return best if is_alike else None


def _notes(found: Selected, targets: Targets, num_unread: int) -> tuple[str, ...]:
    """Writes notes for the user, one sentence each."""
    settings, used, notes = found.settings, found.used, list[str]()
    if settings.frames is not None and settings.frames > len(used):
        notes.append(
            f"{settings.frames} frames were requested, the capture has {len(used)}: all are kept."
        )
    if num_unread:
        notes.append(f"{num_unread} frames cannot be read and are left out.")
    looked = len(used) + num_unread + len(found.survey.strays)
    if looked < len(found.source):
        notes.append(
            f"{looked} of the capture's {len(found.source)} frames were looked at, evenly spaced: "
            f"--max-frames {len(found.source)} looks at all of them."
        )
    sizes = np.bincount(found.scenes)
    large = np.flatnonzero(sizes >= max(2, _SEVERAL * len(used)))
    if len(large) > 1:
        kept = np.bincount(found.scenes[found.choice.order], minlength=len(sizes))
        parts = ", ".join(f"{kept[i]} of {sizes[i]}" for i in large)
        notes.append(
            f"The capture holds {len(large)} scenes that share no surface: frames of each are kept "
            f"in proportion ({parts})."
        )
    if found.quality.is_soft:
        notes.append(
            "All frames are blurred or upscaled: hardly any of them has pixel-sized detail. The "
            "best of them are kept; only a new capture would be sharper."
        )
    blurred = int(found.quality.is_blurred[found.choice.order].sum())
    if blurred:
        notes.append(
            f"{blurred} of the frames kept {'is' if blurred == 1 else 'are'} blurred: each gained "
            "more than any sharp frame when it was chosen."
        )
    outside = int((targets.coverage < _OUTSIDE).sum())
    if outside and settings.targets != FRAMES:
        notes.append(
            f"{outside} of the {len(targets)} target views show almost nothing of the capture, "
            "regardless of the selection."
        )
    if not found.choice.is_complete:
        notes.append("The selection was interrupted: the frames chosen so far are kept.")
    if found.source.remark:
        notes.append(found.source.remark)
    return tuple(notes)


def select_frames(
    frames: Sequence[Frame],
    num: int | None = None,
    *,
    share: float | None = None,
    gain: float | None = None,
    targets: ArrayLike | None = None,
    camera: Camera | None = None,
    keep: Sequence[int] = (),
    blur: Sequence[float] | ArrayLike | None = None,
    voxel_size: float = 0.05,
    max_range: float = 5.0,
    exact: bool = False,
) -> Choice:
    """Chooses frames that suffice to render the target views well.

    It maximizes the mean renderability of the targets by lazy greedy selection. Ties go to the
    sharper frame, and then to the one nearer to the center, so that the order of the frames does
    not matter.

    Args:
        frames: posed images with depth; read three times, one by one.
        num: number of frames to choose.
        share: number of frames as a share of all frames.
        gain: choose enough frames to reach this share of the renderability with all frames. The
            default is 0.99 if none of the three is given.
        targets: `T_world_camera` of the target views, [T, 4, 4]; None: the frames' own.
        camera: camera of the targets; None: that of the first frame.
        keep: indices of frames that are chosen first.
        blur: width of each frame's blur, [n] [px], 1 for a sharp frame; None: all are sharp.
        voxel_size: edge of a voxel of the map [m].
        max_range: surfaces farther from a camera do not count [m].
        exact: evaluate every frame before each choice.

    Returns:
        The order, the gain of each frame, and the renderability of the targets after each.

    Raises:
        ValueError: no frames; settings that contradict each other; arrays that do not fit.
    """
    settings = SelectSettings(frames=num, share=share, gain=gain)
    count = len(frames)
    widths = np.ones(count) if blur is None else np.asarray(blur, np.float64)
    if not count:
        raise InputError("there are no frames to choose from")
    if widths.shape != (count,) or not (widths >= 1.0).all():
        raise InputError(f"blur must hold a width of at least 1 px for each of the {count} frames")
    if any(not 0 <= number < count for number in keep):
        raise InputError(f"keep must hold numbers of the {count} frames, got {list(keep)}")
    own = np.stack([np.asarray(frame.T_world_camera) for frame in frames])
    eyes, lenses = own[:, :3, 3], [frame.camera for frame in frames]
    groups = divided(eyes, max_range)
    read = frames.__getitem__
    every = map(read, np.concatenate(groups).tolist())
    whole = map_of_all(every, groups, voxel_size, max_range=max_range)
    reach, edges = jnp.float32(max_range), jnp.asarray(True)
    join = lambda part, whole, frame: join_on_rows(part, whole, frame, reach, edges, reach)
    observed = observe(whole, read, eyes, lenses, join, max_range=max_range)
    observed = with_quality(observed, widths, exposures(observed))
    poses = own if targets is None else np.asarray(targets, np.float64)
    if poses.ndim != 3 or poses.shape[1:] != (4, 4) or not len(poses):
        raise InputError(f"targets must have shape [T, 4, 4], got {poses.shape}")
    if targets is None and camera is None:
        cameras = lenses
    else:
        cameras = [frames[0].camera if camera is None else camera] * len(poses)
    seen = see_targets(whole, observed, cameras, poses, max_range)
    names = [f"{number:09d}" for number in range(count)]
    return choose(
        observed, seen, settings.number(count), gain=settings.wanted_gain, keep=list(keep),
        ranks=tie_ranks(-widths, eyes, names), is_exact=exact,
    )  # fmt: skip
