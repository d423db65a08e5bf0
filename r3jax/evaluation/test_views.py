"""The test views of a scene: fixed, stored with a hash, the same for every method.

As in Replica-Dense: positions on a lattice of 1.0 x 1.0 x 0.75 m in the free space that a camera
can reach from the start, and at each of them six views without roll along +x, -x, +y, -y, +z, -z.
Views that show mostly void (out of a window, up where a scan has no ceiling) are left out.

A set is computed once for a scene and settings, and read after that. Its hash covers everything
in it, poses included, and poses are multiples of 0.1 mm: machines agree on it.

Shape symbols: P positions; V views.
"""

import functools
import hashlib
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np

from r3jax.errors import InputError
from r3jax.files import make_folder, write_atomic
from r3jax.frame import Frame
from r3jax.geometry.cameras import LOOKS, Camera, poses_at
from r3jax.validation.errors import ForeignFileError, VersionError, check_version
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import check_fields, parse_json

SPACING = (1.0, 1.0, 0.75)
"""Replica-Dense's lattice [m]."""

MARGIN = 0.3
"""The robot's radius [m]."""

_FORMAT = 1
_KINDS = {
    "scene": str,
    "scene_hash": str,
    "spacing": list[float],
    "margin": float,
    "max_views": int | None,
    "views": list[dict[str, Any]],
}
_MAX_BYTES = 64 << 20
_FARTHEST = 1e6
"""From the origin [m]; beyond that tenths of millimeters are no whole 64-bit numbers."""

_LEAST_SEEN = 0.5
"""A view with less surface than this share of the image is left out."""

_SEED = 0
"""Seed of the choice among positions where `max_views` is given."""


@runtime_checkable
class Truth(Protocol):
    """The protocol's interface to a world (`r3jax.simulators.free_space.GroundTruth`)."""

    @property
    def scene(self) -> str:
        """The scene's name."""
        ...

    @property
    def scene_hash(self) -> str:
        """SHA-256 of the scene's content."""
        ...

    def free_positions(self, spacing: Sequence[float | int], margin: float | int) -> np.ndarray:
        """Finds the reachable lattice points [P, 3] [m]."""
        ...

    def seen_share(self, poses: np.ndarray) -> np.ndarray:
        """Computes the share of each view that shows a surface, [V] in [0, 1]."""
        ...

    def frames(self, poses: np.ndarray, camera: Camera) -> Iterator[Frame]:
        """Renders frames without noise at poses [V, 4, 4]."""
        ...


@dataclass(frozen=True, eq=False)
class ViewSet:
    """Test views of one scene."""

    scene: str
    """The scene's name."""

    scene_hash: str
    """SHA-256 of the scene's content: the views are only valid in this scene."""

    spacing: tuple[float, float, float]
    """Spacing of the lattice [m]."""

    margin: float
    """Minimum distance to every surface [m]."""

    max_views: int | None
    """Maximum number of views; None: all of the lattice."""

    positions: np.ndarray
    """Camera center of each view [V, 3] [m] float64, multiples of 0.1 mm."""

    looks: tuple[str, ...]
    """Viewing direction of each view: "+x", "-x", ... [V]."""

    def __len__(self) -> int:
        return len(self.looks)

    @functools.cached_property
    def poses(self) -> np.ndarray:
        """`T_world_camera` of each view, [V, 4, 4] float64."""
        return poses_at(self.positions, self.looks)

    @functools.cached_property
    def hash(self) -> str:
        """SHA-256 over the scene, the settings and the poses."""
        digest = hashlib.sha256(json.dumps([self.scene, *_settings(self)]).encode())
        # Whole numbers: no machine's floats, and no -0.0, get in.
        digest.update(np.rint(self.poses * 1e4).astype("<i8").tobytes())
        return digest.hexdigest()


def compute_view_set(
    truth: Truth,
    *,
    spacing: Sequence[float | int] = SPACING,
    margin: float | int = MARGIN,
    max_views: int | None = None,
) -> ViewSet:
    """Finds the test views of a scene.

    Args:
        truth: the scene.
        spacing: of the lattice along x, y, z [m].
        margin: least distance to every surface [m].
        max_views: positions, with all of their views, are left out evenly until there are no
            more views than this; None: keep all.

    Raises:
        ValueError: settings out of range, fewer than six views requested, or none found.
    """
    if max_views is not None and max_views < len(LOOKS):
        raise InputError(
            f"max_views must be at least {len(LOOKS)}, the views of one position; got {max_views}"
        )
    positions = truth.free_positions(spacing, margin)
    if max_views is not None:
        positions = positions[_evenly(positions, spacing, max_views // len(LOOKS))]
    centers, looks = np.repeat(positions, len(LOOKS), axis=0), np.tile(LOOKS, len(positions))
    shows_something = np.zeros(0, dtype=bool)
    if len(looks):
        shows_something = truth.seen_share(poses_at(centers, looks)) >= _LEAST_SEEN
    if not shows_something.any():
        raise InputError(
            f"{truth.scene}: no test views: of a lattice of {tuple(spacing)} m, "
            f"{len(positions)} points keep {margin} m from every surface and can be reached from "
            "the start, and none of them sees a surface; try a finer lattice or "
            "a smaller margin"
        )
    x, y, z = (float(side) for side in spacing)
    return ViewSet(
        truth.scene,
        truth.scene_hash,
        (x, y, z),
        float(margin),
        max_views,
        centers[shows_something],
        tuple(looks[shows_something].tolist()),
    )


def load_view_set(
    folder: str | Path,
    truth: Truth,
    *,
    spacing: Sequence[float | int] = SPACING,
    margin: float | int = MARGIN,
    max_views: int | None = None,
) -> ViewSet:
    """Loads the test views of a scene; computes and stores them if they are not there yet.

    Several processes may call this at once: all get the same views.

    Args:
        folder: where sets are kept; created if it is missing.
        truth: the scene.
        spacing: see `compute_view_set`.
        margin: see `compute_view_set`.
        max_views: see `compute_view_set`.

    Raises:
        ValueError: the stored file is damaged, was changed, or belongs to another scene; or see
            `compute_view_set`.
        OSError: the folder cannot be written.
    """
    wanted = (tuple(float(side) for side in spacing), float(margin), max_views)
    settings = hashlib.sha256(json.dumps(wanted).encode()).hexdigest()
    path = Path(folder) / f"{truth.scene}-{truth.scene_hash[:12]}-{settings[:8]}.json"
    if not path.exists():
        view_set = compute_view_set(truth, spacing=spacing, margin=margin, max_views=max_views)
        _write(path, view_set)
    view_set = read_view_set(path)
    _check_scene(view_set, truth, str(path))
    if (view_set.spacing, view_set.margin, view_set.max_views) != wanted:
        raise InputError(f"{path} was stored for other settings than {wanted}: {_AGAIN}")
    return view_set


def render_view_set(
    truth: Truth, view_set: ViewSet, resolution: int, fov: float | int = 60.0
) -> Iterator[Frame]:
    """Renders the truth at every test view: exact depth without limit of range.

    Args:
        truth: the scene.
        view_set: its test views.
        resolution: width and height [px].
        fov: field of view [deg].

    Raises:
        ValueError: the views belong to another scene, or no such camera exists.
    """
    _check_scene(view_set, truth, "these test views")
    return truth.frames(view_set.poses, Camera.from_fov(resolution, resolution, fov))


def read_view_set(path: str | Path) -> ViewSet:
    """Reads a stored set.

    Raises:
        ValueError: it is damaged, or its content does not give its hash.
        OSError: it cannot be read.
    """
    path = Path(path)
    try:
        record = parse_json(read_bytes(path, _MAX_BYTES))
        check_version(record["format"], _FORMAT)
        view_set = _from_record(record)
        matches = view_set.hash == record["hash"]
    except VersionError as error:
        raise InputError(f"{path} has {error}, or {_AGAIN}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path} is not a set of test views ({error!r:.300}): {_AGAIN}") from error
    if not matches:
        raise InputError(f"{path} was changed: its content does not match its hash; {_AGAIN}")
    return view_set


_AGAIN = "delete the file and it is computed again"


def _evenly(positions: np.ndarray, spacing: Sequence[float | int], count: int) -> np.ndarray:
    """Chooses `count` of the positions [P, 3], evenly spaced along a Morton curve.

    Neighbors along the curve are neighbors in space, so that each region keeps its share. Returns
    their indices in order.
    """
    if count >= len(positions):
        return np.arange(len(positions))
    cells = np.rint((positions - positions.min(axis=0)) / np.asarray(spacing)).astype(np.int64)
    bits = range(int(cells.max()).bit_length())
    code = sum((cells[:, k] >> b & 1) << (3 * b + k) for b in bits for k in range(3))
    first = np.random.default_rng(_SEED).random()
    ranks = ((np.arange(count) + first) * len(positions) / count).astype(int)
    return np.sort(np.argsort(code, kind="stable")[ranks])


def _settings(view_set: ViewSet) -> list[Any]:
    """Returns everything but the views, in the form that JSON stores."""
    return [view_set.scene_hash, [*view_set.spacing], view_set.margin, view_set.max_views]


def _check_scene(view_set: ViewSet, truth: Truth, what: str) -> None:
    """Refuses views of another scene."""
    if view_set.scene_hash != truth.scene_hash:
        raise InputError(
            f"{what}: made for the scene {view_set.scene!r} with hash "
            f"{view_set.scene_hash[:12]}, but {truth.scene!r} has {truth.scene_hash[:12]}: the "
            "scene was changed, or these are another scene's views; compute them again"
        )


def _write(path: Path, view_set: ViewSet) -> None:
    """Stores a set; a reader sees all of it or nothing."""
    make_folder(path.parent)
    lines = [
        json.dumps({"position": [round(x, 4) for x in position.tolist()], "look": look})
        for position, look in zip(view_set.positions, view_set.looks, strict=True)
    ]
    head = {
        "format": _FORMAT,
        "scene": view_set.scene,
        "scene_hash": view_set.scene_hash,
        "spacing": view_set.spacing,
        "margin": view_set.margin,
        "max_views": view_set.max_views,
        "hash": view_set.hash,
    }
    text = json.dumps(head)[:-1] + ',\n"views": [\n' + ",\n".join(lines) + "\n]}\n"
    write_atomic(path, text.encode())


def _from_record(record: dict[str, Any]) -> ViewSet:
    """Makes the set that a stored record describes."""
    check_fields("set", record, _KINDS)
    x, y, z = (float(side) for side in record["spacing"])
    views = record["views"]
    positions = np.array([view["position"] for view in views], dtype=np.float64).reshape(-1, 3)
    odd = sorted({str(view["look"]) for view in views} - set(LOOKS))
    if odd or not views or not np.abs(positions).max() <= _FARTHEST:
        raise ForeignFileError(
            f"expected views along {', '.join(LOOKS)}, within {_FARTHEST:g} m, got "
            f"{len(views)}, some along {odd[:1] or 'them, but farther away'}"
        )
    return ViewSet(
        str(record["scene"]),
        str(record["scene_hash"]),
        (x, y, z),
        float(record["margin"]),
        record["max_views"],
        positions,
        tuple(str(view["look"]) for view in views),
    )
