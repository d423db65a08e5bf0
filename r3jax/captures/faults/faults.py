"""Reports faults of single frames as findings: the frames, the fault, and what to do next time.

Every frame is read once and stored as blocks. It is compared with a few neighbors, so time and
memory grow linearly with the number of frames (an audit uses at most `max_frames`). Each threshold
documents how it was chosen; `tests/captures/faults` checks them on a rendered walk, damaged on
purpose, and on a real recording.

Shape symbols: n frames.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from r3jax.captures.faults.appearance import (
    FAST,
    Light,
    Sharpness,
    image_motion,
    light,
    repeats,
    sharpness,
)
from r3jax.captures.faults.blocks import BlockImage, block_image, overlaps
from r3jax.captures.faults.offsets import Offsets, Systematic, offsets
from r3jax.captures.source import Source
from r3jax.formats.errors import FormatError
from r3jax.frame import read_ahead
from r3jax.validation.files import printable

BLURRED = 0.45
"""Less of its neighbors' detail than this, and a frame is blurred: a motion of 3 pixels at the
working resolution leaves 0.35, and sharp frames of a rendered walk 0.8 and more. In a recording by
HoloLens visibly blurred frames have 0.26 to 0.48, and visibly sharp ones 0.45 and more."""

_SMEARED = 0.6
"""Detail kept along one direction over that along another, below which a blur has a direction:
0.2 to 0.35 after a motion of 3 to 9 pixels, 0.8 to 1 in sharp frames."""

_NEAR = 0.25
"""Minimum focus distance of phones [m]."""

LIGHT = 0.05
"""Change of brightness or tint that a splat cannot explain: 5 % of a mid gray alone limits PSNR to
32 dB. Frames of a rendered walk, with their highlights, differ by up to 1 %."""

_LITTLE = 0.01
"""Maximum difference between pairs with the same exposure."""

_PAIRS_OF_CHANCE = 2
"""Number of largest differences between two frames that a mirror may cause; ignored."""

_OFF = 0.01
"""Poses that are off by less, as a share of the median depth, are as good as depth cameras are."""

_OFF_TYPICAL = 6.0
"""Ignored, too: offsets below this multiple of the spread of surfaces. Both let
5 cm in a room be found; of the recording by HoloLens (2.6 mm) no frame is off by 3 cm."""

_MISFIT = 0.08
"""Where cameras and depth are off by more, blocks that seem to show one surface do not."""

_NAMED = 5
"""Maximum number of pictures named in a sentence."""

Kind = Literal[
    "blur", "focus", "brightness", "tint", "pose", "scale", "ray", "camera", "repeat", "stray"
]


@dataclass(frozen=True)
class Finding:
    """One fault and the frames that show it."""

    kind: Kind
    """Kind of the fault."""

    what: str
    """Description of the fault in a sentence, with numbers."""

    todo: str
    """What to do next time, a sentence."""

    frames: tuple[int, ...]
    """Indices of images that show it, the worst first; empty if all of them do."""

    captions: tuple[str, ...]
    """Caption of each of these frames."""

    value: float
    """Size of the worst fault; see `what` for its meaning."""


@dataclass(frozen=True)
class Faults:
    """Faults of single frames."""

    findings: tuple[Finding, ...]

    compared: int
    """Number of frames whose surfaces at least one other frame shows."""

    looked_at: int
    """Number of frames that were checked."""

    record: dict[str, Any]
    """Measurements of every frame, by name; None if not known."""

    left_out: Mapping[int, str] = field(default_factory=dict[int, str])
    """Reasons for unreadable images, by their indices in the capture."""

    without_depth: tuple[int, ...] = ()
    """Indices of images without known depth, whose surfaces are not known."""

    fits: bool = True
    """False if depth and cameras contradict each other: then pictures of the same surface cannot be
    matched, and blur, exposure and white balance are not known."""


def find_faults(
    source: Source,
    chosen: np.ndarray,
    on_frame: Callable[[], None] = lambda: None,
    *,
    fits: bool = True,
) -> Faults:
    """Finds blur, changing light, depth that contradicts the poses, and repetition.

    Args:
        source: the capture.
        chosen: indices of the images to check.
        on_frame: called after each image.
        fits: False if depth and poses are known to contradict each other.

    Raises:
        FormatError: fewer than two images can be read.
        RunError: a file of a run is missing or broken.
    """
    images: list[BlockImage] = []
    failed: dict[int, FormatError] = {}
    without_depth: list[int] = []
    indices = chosen.tolist()
    for index, picture in zip(indices, read_ahead(map(source.try_read, indices)), strict=True):
        if isinstance(picture, FormatError):
            failed[index] = picture
        else:
            rgb, depth = picture
            images.append(block_image(rgb, depth, source.camera(index), source.poses[index]))
            if not (depth > 0.0).any():
                without_depth.append(index)
        on_frame()
    if len(images) < 2 and failed:
        raise next(iter(failed.values()))
    kept = np.setdiff1d(chosen, list(failed))
    found = faults_of(
        images, kept, source.labels, source.is_metric, source.has_images,
        is_measured=source.is_complete, fits=fits,
    )  # fmt: skip
    left_out = {
        index: f"{printable(error.path.name)}: {error.reason}" for index, error in failed.items()
    }
    return dataclasses.replace(found, left_out=left_out, without_depth=tuple(without_depth))


def stray_finding(source: Source, strays: Sequence[int], chosen: np.ndarray) -> Finding:
    """Reports the images that are left out because their poses have diverged.

    Args:
        source: the capture.
        strays: these images, one or more.
        chosen: the others.
    """
    middle = np.median(source.poses[chosen, :3, 3], axis=0)
    distances = np.linalg.norm(source.poses[list(strays), :3, 3] - middle, axis=1)
    order = np.argsort(-distances)
    frames = tuple(int(strays[i]) for i in order)
    unit = "m" if source.is_metric else "u"
    captions = tuple(f"{distances[i]:.3g} {unit} from the others" for i in order)
    named = [source.labels[index] for index in frames[:_NAMED]]
    named += [f"{len(frames) - _NAMED} more"] if frames[_NAMED:] else []
    count = len(frames)
    what = (
        f"{_pictures(frames)} left out, as the {'pose has' if count == 1 else 'poses have'} "
        f"diverged: {', '.join(named)}, up to {distances.max():.3g} {unit} from the others, "
        "with nothing in common."
    )
    todo = "Align these pictures again, or delete them from the capture."
    return Finding("stray", what, todo, frames, captions, float(distances.max()))


def faults_of(
    images: Sequence[BlockImage],
    chosen: np.ndarray,
    labels: Sequence[str],
    is_metric: bool = True,
    has_colors: bool = True,
    *,
    is_measured: bool = True,
    fits: bool = True,
) -> Faults:
    """Finds faults as `find_faults` does, from block images.

    Args:
        images: the block image of each chosen frame.
        chosen: their indices in the capture, [n].
        labels: names of all images of the capture.
        is_metric: True if a unit is a meter.
        has_colors: False if there are no real colors.
        is_measured: True if depth is a depth camera's. Computed from the photos at these very poses
            and lenses it has their errors, and says nothing about them.
        fits: False if depth and poses are known to contradict each other.
    """
    pairs = overlaps(images)
    poses = offsets(images, pairs)
    names = _Names(chosen, labels, "m" if is_metric else "u")
    shared = poses.systematic if is_measured else None
    fits = fits and (shared is None or abs(shared.size) < _MISFIT)
    findings = [_systematic(shared), _pose(poses, images, names) if fits else None]
    record: dict[str, Any] = {"pictures": chosen.tolist(), "pose_off_by": _numbers(poses.distance)}
    if has_colors and fits:
        sharp, lit = sharpness(images, pairs), light(images, pairs)
        findings = [
            *_blur(sharp, images, names),
            _brightness(lit, names),
            _tint(lit, names),
            *findings,
        ]
        record["detail"] = _numbers(sharp.share)
        record["brightness"] = _numbers(np.exp(lit.change(lit.brightness)))
    if has_colors:
        findings.append(_repeat(images, names))
    compared = {i for pair in pairs for i in (pair.first, pair.second)}
    found = tuple(finding for finding in findings if finding is not None)
    return Faults(found, len(compared), len(images), record, fits=fits)


@dataclass(frozen=True)
class _Names:
    """Names of the checked frames."""

    chosen: np.ndarray
    labels: Sequence[str]
    unit: str

    def label(self, number: int) -> str:
        """Returns the label of a frame by its number among the checked frames."""
        return self.labels[int(self.chosen[number])]

    def finding(
        self,
        kind: Kind,
        what: str,
        todo: str,
        numbers: Sequence[int],
        captions: Sequence[str],
        value: float,
    ) -> Finding:
        """Creates a finding about some of the checked frames."""
        frames = tuple(int(self.chosen[number]) for number in numbers)
        return Finding(kind, what, todo, frames, tuple(captions), value)


def _blur(sharp: Sharpness, images: Sequence[BlockImage], names: _Names) -> list[Finding | None]:
    """Finds blurred frames, by their likely cause."""
    motion = image_motion(images)
    is_blurred = np.nan_to_num(sharp.share, nan=1.0) < BLURRED
    moved = is_blurred & ((sharp.lost_along < _SMEARED) | (motion > FAST))
    out: list[Finding | None] = []
    for kind, mask in (("blur", moved), ("focus", is_blurred & ~moved)):
        numbers = [int(i) for i in np.argsort(sharp.share) if mask[i]]
        if not numbers:
            continue
        near = [images[i].median_depth < _NEAR for i in numbers]
        details = [
            f"{100 * sharp.share[i]:.0f} % of the detail"
            + (
                f"; the picture moved by {100 * motion[i]:.0f} % of its width"
                if kind == "blur" and motion[i] > FAST
                else "; smeared along one direction"
                if kind == "blur"
                else "; nearer than 25 cm"
                if images[i].median_depth < _NEAR and names.unit == "m"
                else ""
            )
            for i in numbers
        ]
        share = float(sharp.share[numbers[0]])
        what = (
            f"{_pictures(numbers)} blurred by motion: as little as {100 * share:.0f} % of the "
            "fine detail that neighbors show of the same surface."
            if kind == "blur"
            else f"{_pictures(numbers)} out of focus, or shaken: as little as {100 * share:.0f} % "
            "of the fine detail that neighbors show of the same surface, in all directions."
        )
        todo = (
            "Turn and walk more slowly, and turn on the light: a dark room makes the exposure "
            "long. Leave these pictures out of the training."
            if kind == "blur"
            else "Stay farther away than 25 cm, and wait until the focus has settled. Leave these "
            "pictures out of the training."
            if any(near)
            else "Wait until the focus has settled, or lock it. Leave these pictures out of the "
            "training."
        )
        out.append(names.finding("blur" if kind == "blur" else "focus", what, todo, numbers,
                                 details, share))  # fmt: skip
    return out


def _pictures(numbers: Sequence[int]) -> str:
    return "1 picture is" if len(numbers) == 1 else f"{len(numbers)} pictures are"


def _largest(lit: Light, values: np.ndarray) -> float:
    """Returns the largest credible difference [log] between two frames, leaving out outliers."""
    if not len(lit.pairs):
        return 0.0
    differences = np.sort(np.abs(np.subtract(*values[lit.pairs.T])))[::-1]
    # Of few pairs enough are kept that the largest is not below the median.
    return float(differences[min(_PAIRS_OF_CHANCE, (len(differences) - 1) // 2)])


def _brightness(lit: Light, names: _Names) -> Finding | None:
    largest = _largest(lit, lit.brightness)
    if largest < np.log1p(LIGHT):
        return None
    typical = float(np.median(np.abs(np.subtract(*lit.brightness[lit.pairs.T]))))
    change = lit.change(lit.brightness)
    numbers, captions = _beside(lit, lit.brightness, change, names)
    many = (
        f"half of the pairs differ by more than {100 * np.expm1(typical):.0f} %"
        if typical >= np.log1p(_LITTLE)
        else "most pairs hardly differ, so it changed only occasionally"
    )
    what = (
        f"Brightness changes by up to {100 * np.expm1(largest):.0f} % between pictures of the same "
        f"surface ({many})."
    )
    todo = (
        "Lock the exposure before you start (iPhone: hold a finger on the picture until AE/AF LOCK "
        "appears; many scanning apps have a switch). For pictures that exist, train with a "
        "correction of exposure for each picture."
    )
    return names.finding("brightness", what, todo, numbers, captions, float(np.expm1(largest)))


def _beside(
    lit: Light, values: np.ndarray, change: np.ndarray, names: _Names
) -> tuple[list[int], list[str]]:
    """Lists the frames that differ most, each beside a neighbor that shows the difference."""
    order = [int(i) for i in np.argsort(-np.abs(np.nan_to_num(change)))]
    numbers: list[int] = []
    captions: list[str] = []
    both = np.concatenate([lit.pairs, lit.pairs[:, ::-1]])
    # A large difference is seen where much of the pictures is the same.
    shown = np.tile(np.sqrt(lit.shared), 2) * np.abs(values[both[:, 0]] - values[both[:, 1]])
    for i in order:
        if i in numbers or not abs(np.nan_to_num(change[i])) >= np.log1p(LIGHT):
            continue
        own = both[:, 0] == i
        other = int(both[own, 1][np.argmax(shown[own])])
        ratio = np.exp(values[i] - values[other])
        numbers += [i, other] if other not in numbers else [i]
        captions += [f"{ratio:.2f} x as bright as {names.label(other)}"]
        if len(captions) < len(numbers):
            captions.append(f"{1 / ratio:.2f} x as bright as {names.label(i)}")
    if not numbers:  # a step: on both of its sides most neighbors are alike
        i, other = (int(number) for number in both[np.argmax(shown)])
        ratio = np.exp(values[i] - values[other])
        numbers = [i, other]
        captions = [f"{ratio:.2f} x as bright as {names.label(other)}",
                    f"{1 / ratio:.2f} x as bright as {names.label(i)}"]  # fmt: skip
    return numbers, captions


def _tint(lit: Light, names: _Names) -> Finding | None:
    largest = max(_largest(lit, values) for values in lit.tint.T)
    if largest < np.log1p(LIGHT):
        return None
    changes = np.stack([lit.change(values) for values in lit.tint.T], axis=1)
    worst = np.abs(np.nan_to_num(changes)).max(axis=1)
    numbers = [int(i) for i in np.argsort(-worst) if worst[i] >= np.log1p(LIGHT)]
    captions = [
        f"red {100 * np.expm1(changes[i, 0]):+.0f} %, blue {100 * np.expm1(changes[i, 1]):+.0f} % "
        "against green"
        for i in numbers
    ]
    what = (
        f"White balance drifts: the same surfaces are up to {100 * np.expm1(largest):.0f} % redder "
        "or bluer from one picture to another."
    )
    todo = "Lock the white balance, and do not mix daylight with lamps of another color."
    return names.finding("tint", what, todo, numbers, captions, float(np.expm1(largest)))


def _pose(poses: Offsets, images: Sequence[BlockImage], names: _Names) -> Finding | None:
    depth = np.array([image.median_depth for image in images])
    least = np.fmax(_OFF * depth, _OFF_TYPICAL * poses.typical)
    off = np.nan_to_num(poses.distance / least)
    is_off = poses.is_explained & (off > 1.0)
    numbers = [int(i) for i in np.argsort(-off) if is_off[i]]
    if not numbers:
        return None
    length = lambda value: f"{100 * value:.1f} cm" if names.unit == "m" else f"{value:.3g} u"
    worst = float(poses.distance[numbers[0]])
    what = (
        f"{len(numbers)} {'pose contradicts' if len(numbers) == 1 else 'poses contradict'} the "
        f"depth: surfaces lie up to {length(worst)} from where the neighbors show them (elsewhere "
        f"they agree to {length(poses.typical)})."
    )
    todo = (
        "Move slowly past plain walls and close the loop, so that tracking does not slip; run the "
        "app's own refinement of poses, or leave these pictures out."
    )
    captions = [f"off by {length(float(poses.distance[i]))}" for i in numbers]
    return names.finding("pose", what, todo, numbers, captions, worst)


def _systematic(found: Systematic | None) -> Finding | None:
    if found is None:
        return None
    value = found.value
    if found.kind == "scale":
        what = (
            f"All depths are {100 * abs(1.0 / value - 1.0):.0f} % too "
            f"{'short' if value > 1.0 else 'long'} for the poses: they fit best if multiplied by "
            f"{value:.3f}."
        )
        todo = (
            f"Check the unit of the depth images and the calibration of the depth camera; "
            f"--depth-scale {value:.3f} multiplies (in a transforms.json: depth_unit_scale_factor)."
        )
        return Finding("scale", what, todo, (), (), value)
    if found.kind == "ray":
        what = "All depths fit the poses best as distances along the rays of the pixels, not as z."
        return Finding("ray", what, "Use --depth-along-ray, which converts them.", (), (), value)
    if found.kind == "focal":
        what = (
            f"All focal lengths are {100 * abs(1.0 / value - 1.0):.0f} % too "
            f"{'short' if value > 1.0 else 'long'} for depth and poses: they fit best if "
            f"multiplied by {value:.3f}."
        )
    else:
        aside = {"across": ("right", "left"), "down": ("down", "up")}[found.kind]
        what = (
            f"All principal points fit depth and poses best if moved {aside[value < 0.0]} by "
            f"{100 * abs(value):.0f} % of the focal length."
        )
    todo = (
        "Calibrate the camera, or check that the intrinsics are those of these images (in a "
        "transforms.json: fl_x, fl_y, cx, cy)."
    )
    return Finding("camera", what, todo, (), (), value)


def _repeat(images: Sequence[BlockImage], names: _Names) -> Finding | None:
    groups = repeats(images)
    spare = sum(len(group) - 1 for group in groups)
    if not spare:
        return None
    shown = [(i, group[0]) for group in groups for i in group]
    captions = [
        f"repeats {names.label(first)}" if i != first else "is repeated" for i, first in shown
    ]
    what = (
        f"{spare} picture{' repeats' if spare == 1 else 's repeat'} another one: nearly the same "
        "pose and the same pixels. They add nothing."
    )
    todo = "Take the next picture after a step to the side, or a turn by 10 degrees or more."
    return names.finding("repeat", what, todo, [i for i, _ in shown], captions, float(spare))


def _numbers(values: np.ndarray) -> list[float | None]:
    """Rounds numbers for JSON, which has no NaN."""
    return [round(float(v), 4) if np.isfinite(v) else None for v in values]
