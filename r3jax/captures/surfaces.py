"""Finds the surfaces of a capture without a depth camera, from the best available source.

    stereo    COLMAP's depth maps, if they lie beside the images
    sweep     a plane sweep at the poses (`captures.sweep`), by default
    model     depth rendered from a trained splat
    points    the sparse points alone

Each gives less than a depth camera; surfaces that it does not give are not known.

Shape symbols: n images; h, w size of an image; k points.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from r3jax.captures.alignment import evenly_spaced
from r3jax.captures.settings import Surfaces
from r3jax.captures.source import NO_SURFACES, Picture, Source, lens_of, projected
from r3jax.captures.sweep import Photo, agreed_depth, choose_sources, sweep
from r3jax.errors import InputError
from r3jax.formats.errors import FormatError
from r3jax.splatting.ply import read_scene
from r3jax.splatting.render import render

_COARSE = 4
"""Without points, photos this many times smaller are swept first, over all depths."""

_DEPTHS = 24
"""Depths that are assumed then."""

_SWEPT_SIDE = 384
"""Photos are subsampled to at most this many pixels on the longer side; voxels are no finer."""

_FEWEST_PHOTOS = 3
"""Minimum number of photos: depth needs an image and two others that agree."""

_LEAST_KEPT = 0.1
"""Minimum share of pixels that a successful sweep keeps; below it poses or lens are wrong."""

_CONTRADICTED = 0.1
"""Maximum median deviation of a successful sweep from the points, as a share of their depth."""

Progress = Callable[[str, int], None]
"""Progress callback, as in `apps.audit`: a stage and its steps, then an empty name per step."""


def with_surfaces(
    source: Source,
    wanted: Surfaces = "auto",
    model: Path | None = None,
    on_progress: Progress = lambda stage, steps: None,
) -> Source:
    """Adds surfaces to a capture, from the best available source or the requested one.

    Args:
        source: the opened capture.
        wanted: `auto` sweeps if there is no depth, and keeps the points if that fails.
        model: a trained splat in the capture's coordinates, whose depth is used instead.
        on_progress: progress callback.

    Raises:
        InputError: the requested source is not available.
        FormatError: an image is missing or broken.
        SceneFileError: the splat cannot be read.
    """
    if model is not None:
        return modeled(source, model, on_progress)
    if wanted == "depth" and not source.is_dense:
        raise InputError(
            f"{source.name}: there are no depth images: --surfaces sweep computes depth from photos"
        )
    if wanted == "points" and source.kind == "photos":
        raise InputError(f"{source.name}: there are no points: drop --surfaces, or give a --model")
    if wanted == "points" and source.is_dense:
        raise InputError(f"{source.name}: depth images are better than points: drop --surfaces")
    if wanted in ("depth", "points") or (wanted == "auto" and source.is_dense):
        return source
    why = _why_not_swept(source)
    if why is None:
        found = swept(source, on_progress)
        why = _failed(source, found)
        if why is None:
            return found
    if source.kind == "photos":
        raise InputError(
            f"{source.name}: {NO_SURFACES}; no depth can be computed from the photos: {why}"
        )
    if wanted == "sweep":
        raise InputError(f"{source.name}: no depth can be computed from its photos: {why}")
    return source if source.reconstruction is None else _remarked(source, why)


def _remarked(source: Source, why: str) -> Source:
    said = f"No depth could be computed from the photos ({why}): only points are evaluated."
    return dataclasses.replace(source, remark=f"{source.remark} {said}" if source.remark else said)


def _why_not_swept(source: Source) -> str | None:
    if source.photograph is None:
        return "the pictures are missing"
    if source.is_dense:
        return (
            "it already has depth images, which go first: audit a copy without them (of COLMAP's "
            "stereo: without stereo/depth_maps)"
        )
    if len(source) < _FEWEST_PHOTOS:
        return f"at least {_FEWEST_PHOTOS} pictures are needed, found {len(source)}"
    return None


_OPAQUE = 0.8
"""Minimum opacity for a pixel of a rendered splat to have a depth."""

_COVERED = 0.3
"""Minimum mean coverage of the pictures by a splat; below it, its place or scale differs."""

_MISFIT = 0.25
"""Maximum median deviation of a splat's depth from the points, as a share."""

_ALIKE = 0.3
"""Minimum median correlation between a splat's renderings and the pictures."""

_COMPARED = 12
"""Number of pictures that a splat is compared with."""


def modeled(
    source: Source, path: Path, on_progress: Progress = lambda stage, steps: None
) -> Source:
    """Adds depth rendered from a trained splat to a capture.

    Opacity serves as confidence; pixels whose depth two other images contradict become holes.

    Args:
        source: the images.
        path: the splat, in the capture's coordinates.
        on_progress: for a progress bar.

    Raises:
        InputError: place or scale of the splat do not match the cameras; says by how much.
        SceneFileError: the splat cannot be read.
    """
    scene = read_scene(path)
    side = max(max(lens.width, lens.height) for lens in source.lenses)
    stride = max(1, -(-side // _SWEPT_SIDE))
    thin = dataclasses.replace(source, stride=stride)
    on_progress("rendering the splat", len(source))
    photos: list[Photo] = []
    colors: list[np.ndarray] = []
    depths: list[np.ndarray] = []
    alike: list[float] = []
    for index in range(len(source)):
        camera = thin.camera(index)
        drawn = render(scene, camera, jnp.asarray(source.poses[index], dtype=jnp.float32))
        rgb = np.clip(np.asarray(drawn.rgb), 0.0, 1.0)
        gray = rgb.mean(axis=-1).astype(np.float32)
        is_solid = np.asarray(drawn.alpha) >= _OPAQUE
        depths.append(np.where(is_solid, np.asarray(drawn.depth), 0.0).astype(np.float32))
        if source.photograph is not None:
            photo, own = source.photograph(index, stride)
            alike.append(_correlation(own[is_solid], gray[is_solid]))
        else:
            photo = np.rint(255.0 * rgb).astype(np.uint8)
        colors.append(photo)
        photos.append(Photo(gray, lens_of(camera), source.poses[index]))
        on_progress("", 1)
    _check_model(source, thin, path, depths, alike)
    shown = [_some_points(depth, photo) for depth, photo in zip(depths, photos, strict=True)]
    others = choose_sources(photos, shown.__getitem__)
    kept = [agreed_depth(own, depths, photos, chosen) for own, chosen in enumerate(others)]
    read: Callable[[int], Picture] = lambda index: (colors[index], kept[index])
    return dataclasses.replace(source, kind="model", stride=stride, read=read)


def _correlation(a: np.ndarray, b: np.ndarray) -> float:
    if len(a) < 2 or a.std() < 1e-6 or b.std() < 1e-6:
        return 0.0
    return float(np.corrcoef(a, b)[0, 1])


def _some_points(depth: np.ndarray, photo: Photo, step: int = 16) -> np.ndarray:
    """Samples the points of some pixels, [k, 3] in the world."""
    row, column = np.nonzero(depth[::step, ::step] > 0.0)
    row, column = step * row, step * column
    z = depth[row, column].astype(np.float64)
    fx, fy, cx, cy = photo.lens
    local = z * np.stack([(column + 0.5 - cx) / fx, (row + 0.5 - cy) / fy, np.ones_like(z)])
    return local.T @ photo.pose[:3, :3].T + photo.pose[:3, 3]


def _check_model(
    source: Source, thin: Source, path: Path, depths: list[np.ndarray], alike: list[float]
) -> None:
    """Refuses a splat whose place or scale does not match the cameras."""
    what = f"{path}: the splat does not match the place or scale of {source.name}: "
    todo = "; give the splat that was trained on this capture, in its coordinates"
    covered = float(np.mean([(depth > 0.0).mean() for depth in depths]))
    if covered < _COVERED:
        raise InputError(f"{what}it covers {100 * covered:.0f} % of its pictures{todo}")
    off: list[np.ndarray] = []
    for index in evenly_spaced(len(source), _COMPARED).tolist():
        off.append(_off(depths[index], thin, index, points_shown(source, index)))
    ratio = 1.0 + np.concatenate(off)
    if len(ratio) and np.median(np.abs(ratio - 1.0)) > _MISFIT:
        than = "the depth images say" if source.is_dense else "the points"
        raise InputError(
            f"{what}its surfaces are {np.median(ratio):.2g} times as far as {than}{todo}"
        )
    if alike and np.median(alike) < _ALIKE:
        raise InputError(
            f"{what}its renderings correlate with the pictures by only {np.median(alike):.2f}{todo}"
        )


def swept(source: Source, on_progress: Progress = lambda stage, steps: None) -> Source:
    """Adds depth swept from its photos to a capture, at most `_SWEPT_SIDE` pixels wide.

    Args:
        source: images, whose points tell at which depths surfaces lie. Without points, a sweep of
            small photos over all depths does.
        on_progress: for a progress bar.
    """
    side = max(max(lens.width, lens.height) for lens in source.lenses)
    stride = max(1, -(-side // _SWEPT_SIDE))
    on_progress("reading photos", len(source))
    colors: list[np.ndarray | FormatError] = []
    photos: list[Photo] = []
    for index in range(len(source)):
        rgb, photo = _photo(source, index, stride)
        colors.append(rgb)
        photos.append(photo)
        on_progress("", 1)
    if all(isinstance(rgb, FormatError) for rgb in colors):
        raise next(rgb for rgb in colors if isinstance(rgb, FormatError))
    if source.kind == "photos":
        points = _points_without(photos, on_progress)
    else:
        points = [
            np.zeros((0, 3)) if isinstance(rgb, FormatError) else points_shown(source, index)
            for index, rgb in enumerate(colors)
        ]
    on_progress("sweeping depth from photos", len(source))
    found = sweep(photos, points.__getitem__, lambda: on_progress("", 1))
    # Masked pixels have no brightness.
    depths = [depth * (photo.gray > 0.0) for depth, photo in zip(found, photos, strict=True)]

    def read(index: int) -> Picture:
        rgb = colors[index]
        if isinstance(rgb, FormatError):
            raise rgb
        return rgb, depths[index]

    return dataclasses.replace(source, kind="sweep", stride=stride, read=read)


def _photo(source: Source, index: int, stride: int) -> tuple[np.ndarray | FormatError, Photo]:
    """Reads a thinned photo: its colors, and its brightness with lens and pose.

    A photo that is missing or broken is all masked, and its colors are why.
    """
    assert source.photograph is not None
    camera = dataclasses.replace(source, stride=stride).camera(index)
    rgb: np.ndarray | FormatError
    try:
        rgb, gray = source.photograph(index, stride)
    except FormatError as error:
        rgb, gray = error, np.zeros((camera.height, camera.width), np.float32)
    return rgb, Photo(gray, lens_of(camera), source.poses[index])


def _points_without(photos: list[Photo], on_progress: Progress) -> list[np.ndarray]:
    """Finds points that each image shows, [k, 3] in the world, where a capture has none.

    By a sweep of small photos over all depths that the places of the cameras leave open.
    """
    on_progress("sweeping small photos", len(photos))
    small = [_smaller(photo) for photo in photos]
    depths = sweep(small, _assumed_points(small).__getitem__, lambda: on_progress("", 1))
    return [_some_points(depth, photo, 2) for depth, photo in zip(depths, small, strict=True)]


def _smaller(photo: Photo) -> Photo:
    """Averages blocks of `_COARSE` by `_COARSE` pixels; one with a masked pixel is masked."""
    height, width = (n // _COARSE for n in photo.gray.shape)
    blocks = photo.gray[: height * _COARSE, : width * _COARSE]
    blocks = blocks.reshape(height, _COARSE, width, _COARSE)
    gray = np.where(blocks.min(axis=(1, 3)) > 0.0, blocks.mean(axis=(1, 3)), np.float32(0.0))
    return Photo(gray, photo.lens / _COARSE, photo.pose)


def _assumed_points(photos: list[Photo]) -> list[np.ndarray]:
    """Spreads points over the pixels of each image and over all plausible depths, [k, 3] each."""
    centers = np.stack([photo.pose[:3, 3] for photo in photos])
    extent = float(np.linalg.norm(np.ptp(centers, axis=0)))
    few = min(10, len(photos) - 1)
    apart = np.linalg.norm(centers[:, None] - centers[None], axis=-1)
    around = float(np.median(np.sort(apart, axis=1)[:, few]))
    points: list[np.ndarray] = []
    for photo in photos:
        step = max(1, min(photo.gray.shape) // 6)
        every = [
            _some_points(np.full(photo.gray.shape, depth, np.float32), photo, step)
            for depth in np.geomspace(min(0.1 * extent, 0.3 * around), 20.0 * extent, _DEPTHS)
        ]
        points.append(np.concatenate(every))
    return points


def points_shown(source: Source, index: int) -> np.ndarray:
    """Lists the points visible in an image, [k, 3] in the capture's coordinates."""
    _, depth = source.read(index)
    camera, pose = source.camera(index), source.poses[index]
    row, column = np.nonzero((depth > 0.0) & np.isfinite(depth))
    z = depth[row, column].astype(np.float64)
    x = (column + 0.5 - float(camera.cx)) / float(camera.fx)
    y = (row + 0.5 - float(camera.cy)) / float(camera.fy)
    return (z * np.stack([x, y, np.ones_like(x)])).T @ pose[:3, :3].T + pose[:3, 3]


def _failed(source: Source, found: Source) -> str | None:
    """Returns the reason why swept depth is not credible, or None if it is."""
    kept: list[float] = []
    off: list[np.ndarray] = []
    for index in range(len(source)):
        picture = found.try_read(index)
        if isinstance(picture, FormatError):
            continue
        depth = picture[1]
        kept.append(float((depth > 0.0).mean()))
        off.append(_off(depth, found, index, points_shown(source, index)))
    share = np.mean(kept) / _unmasked(found)
    if share < _LEAST_KEPT:
        return (
            f"the photos agree on only {100 * share:.1f} % of their pixels, so surfaces are plain, "
            "or poses and focal lengths do not fit them"
        )
    ratio = np.concatenate(off)
    median = float(np.median(np.abs(ratio))) if len(ratio) else 0.0
    if median > _CONTRADICTED:
        return f"it is {100 * median:.0f} % off the points, so lens or poses are likely wrong"
    return None


def _unmasked(source: Source) -> float:
    """Computes the share of the pixels that no mask hides, of some photos; at least a thousandth.

    Where masks cut out an object, nothing else can have a depth.
    """
    assert source.photograph is not None
    some = evenly_spaced(len(source), _COMPARED).tolist()
    shown = [(_photo(source, index, source.stride)[1].gray > 0.0).mean() for index in some]
    return max(float(np.mean(shown)), 1e-3)


def _off(depth: np.ndarray, found: Source, index: int, points: np.ndarray) -> np.ndarray:
    """Computes the relative deviation of an image's depth from its points, [k]."""
    place = projected(found.camera(index), found.poses[index], points)
    row, column = place.row[place.is_in].astype(int), place.column[place.is_in].astype(int)
    said, z = depth[row, column], place.z[place.is_in]
    return (said / z - 1.0)[said > 0.0]
