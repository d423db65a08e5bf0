"""Walks through an embedded scene with a 360 camera, and audits the photos against depth.

    python -m experiments.walk_360 flat --out runs/walk-360

At every place of the walk a camera at eye level renders the six faces of a cube, with depth. They
are resampled to one panorama of 2:1, with a person below who covers the cone that `--hide-below`
masks, and the poses have a level camera that turns as one walks. Pycolmap matches the panoramas
and triangulates at the poses (EQUIRECTANGULAR), as a structure from motion would. The capture is
audited from its panoramas alone, by points and by depth swept from the views that they are cut
into. The truth is the audit of the rendered faces with their depth. Regions are compared as in
`experiments.without_depth`.
"""

import json
import shutil
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro
from PIL import Image

from experiments.hand_walks import places
from experiments.without_depth import compare, triangulate
from r3jax.apps.audit.audit import audit
from r3jax.apps.audit.settings import AuditSettings
from r3jax.captures.settings import Surfaces
from r3jax.captures.source import source_of
from r3jax.captures.survey import RANGE
from r3jax.errors import InputError
from r3jax.formats.captures import open_capture
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.cut import Cut
from r3jax.formats.cut_views import FACES
from r3jax.formats.lenses import Lens
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.scenes.registry import open_scene

_FEATURES = 8000
"""SIFT features of a panorama at most."""

_PERSON = 24.0
"""Half the cone below the camera that the person covers [deg]."""

_NOISE = 2.0
"""Of the colors, standard deviation [of 255]."""


@dataclass(frozen=True)
class Options:
    """A walk with a 360 camera."""

    scene: Annotated[str, tyro.conf.Positional]

    out: Path = Path("runs/walk-360")
    """Folder of the walk and of results.json."""

    photos: int = 40

    width: int = 2048
    """Of a panorama [px]."""

    overlaps: tuple[float, ...] = (0.0, 10.0)
    """Overlaps of the views that are tried [deg]."""

    surfaces: tuple[Surfaces, ...] = ("points", "sweep")


def render(options: Options) -> None:
    """Writes the panoramas, and a recording of the faces with depth in `faces`."""
    side = round(options.width / np.pi)
    camera = Camera(side, side, 0.5 * side, 0.5 * side, 0.5 * side, 0.5 * side)
    world = open_scene(options.scene, camera=camera, max_range=None)
    truth = GroundTruth(world)
    path = places(truth, world.start_pose[:3, 3])
    eyes = path[np.linspace(0, len(path) - 1, options.photos).round().astype(int)]
    rng = np.random.default_rng(0)
    table = _panorama_table(options.width, side)
    for name in ("images", "faces/images", "faces/depth"):
        (options.out / name).mkdir(parents=True)
    poses: list[np.ndarray] = []
    of_faces: list[np.ndarray] = []
    for number, eye in enumerate(eyes):
        heading = 0.7 * number
        ahead = np.array([np.cos(heading), np.sin(heading), 0.0])
        pose = np.asarray(pose_along(eye, ahead), np.float64)
        colors = np.zeros((len(FACES), side, side, 3))
        for i, (face, R) in enumerate(FACES.items()):
            turned = pose.copy()
            turned[:3, :3] = pose[:3, :3] @ R
            frame = world.render(turned)
            colors[i] = 255.0 * np.asarray(frame.rgb)
            name = f"{number:03d}_{face}.png"
            _save(options.out / "faces" / "images" / name, colors[i])
            depth = np.asarray(frame.depth)
            depth = np.where(np.isfinite(depth), depth, 0.0)
            steps = np.rint(1000.0 * depth).clip(0, 65535).astype(np.uint16)
            Image.fromarray(steps).save(options.out / "faces" / "depth" / name)
            of_faces.append(turned)
        panorama = colors.reshape(-1, 3)[table]
        panorama[_person(options.width)] = 60.0, 50.0, 90.0
        noise = rng.normal(0.0, _NOISE, panorama.shape)
        _save(options.out / "images" / f"{number:03d}.png", panorama + noise)
        poses.append(pose)
    K = np.array([[0.5 * side, 0, 0.5 * side - 0.5], [0, 0.5 * side, 0.5 * side - 0.5], [0, 0, 1]])
    np.savetxt(options.out / "faces" / "K.txt", K)
    # The recording takes its images in the order of their names.
    names = [f"{n:03d}_{face}" for n in range(len(poses)) for face in FACES]
    order = np.argsort(names)
    stacked = np.stack(of_faces)[order].reshape(-1, 16)
    np.savetxt(options.out / "faces" / "poses.txt", stacked, fmt="%.17g")
    np.save(options.out / "poses.npy", np.stack(poses))


def _save(path: Path, colors: np.ndarray) -> None:
    Image.fromarray(np.rint(colors).clip(0, 255).astype(np.uint8)).save(path)


def _rays(width: int) -> np.ndarray:
    """Rays of a panorama's pixels, by its formula, [h, w, 3]."""
    theta = 2.0 * np.pi * ((np.arange(width) + 0.5) / width - 0.5)
    phi = np.pi * ((np.arange(width // 2) + 0.5) / (width // 2) - 0.5)
    theta, phi = np.meshgrid(theta, phi)
    return np.stack([np.cos(phi) * np.sin(theta), np.sin(phi), np.cos(phi) * np.cos(theta)], -1)


def _panorama_table(width: int, side: int) -> np.ndarray:
    """Which pixel of which face a panorama's pixel takes, [h, w]."""
    rays = _rays(width)
    table = np.zeros(rays.shape[:2], np.int64)
    for number, R in enumerate(FACES.values()):
        x, y, z = np.moveaxis(rays @ R, -1, 0)
        is_face = (z > 0.0) & (np.maximum(np.abs(x), np.abs(y)) <= z * (1.0 + 1e-9))
        safe = np.where(is_face, z, 1.0)
        column = np.floor(0.5 * side * (x / safe + 1.0)).clip(0, side - 1).astype(int)
        row = np.floor(0.5 * side * (y / safe + 1.0)).clip(0, side - 1).astype(int)
        table[is_face] = ((number * side + row) * side + column)[is_face]
    return table


def _person(width: int) -> np.ndarray:
    """Pixels of the panorama that the person below covers, [h, w]."""
    return _rays(width)[..., 1] > np.cos(np.radians(_PERSON))


def triangulate_panoramas(folder: Path, width: int) -> None:
    """Matches the panoramas and triangulates at their poses: a COLMAP model in `sparse/0`."""
    poses = np.load(folder / "poses.npy")
    names = [f"{index:03d}.png" for index in range(len(poses))]
    lens = Lens("EQUIRECTANGULAR", width, width // 2, (float(width), float(width // 2)))
    for name in ("known", "sparse/0"):
        (folder / name).mkdir(parents=True)
    triangulate(folder, names, lens, poses, _FEATURES)
    shutil.rmtree(folder / "known")


def main(options: Options) -> None:
    """Renders what is missing, audits, and writes results.json."""
    if not (options.out / "poses.npy").exists():
        if options.out.exists() and any(options.out.iterdir()):
            raise InputError(f"{options.out} holds no walk: give another --out, or remove it")
        render(options)
    if not (options.out / "sparse" / "0" / "points3D.bin").exists():
        triangulate_panoramas(options.out, options.width)
    faces = source_of(open_capture(options.out / "faces", "z").source, "faces")
    up = "0,0,1"
    truth = audit(faces, AuditSettings(views=0, up=up))
    rows: list[dict[str, Any]] = []
    for overlap in options.overlaps:
        capture = open_capture(options.out, "z", cut=Cut(overlap))
        for surfaces in options.surfaces:
            settings = AuditSettings(
                views=0,
                up=up,
                surfaces=surfaces,
                max_range=RANGE * truth.survey.length(1.0),
                voxel_size=0.1 if surfaces == "points" else None,
            )
            begun = time.perf_counter()
            found = audit(source_of(capture.source, options.scene), settings)
            row = {
                "scene": options.scene,
                "photos": options.photos,
                "views": len(found.source),
                "overlap": overlap,
                "surfaces": surfaces,
                "points": len(read_colmap(options.out).points or ()),
                **compare(truth, found),
                "seconds": time.perf_counter() - begun,
            }
            print(json.dumps(row, indent=1), flush=True)
            rows.append(row)
    (options.out / "results.json").write_text(json.dumps(rows, indent=1) + "\n")


if __name__ == "__main__":
    main(tyro.cli(Options))
