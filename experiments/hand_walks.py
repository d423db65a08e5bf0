"""Writes a walk of a hand-held camera through an embedded scene: jitter, blur, exposure, noise.

    python -m experiments.hand_walks flat --out runs/walks/flat

The walk visits the free space at eye level. The hand turns while the shutter is open, so that a
frame is the mean of renderings along that turn; the exposure drifts by a quarter to either side;
noise has a standard deviation of 0.01. Depth and poses are exact. Every eighth frame, beginning
with the first, is to judge others: it is sharp and evenly exposed, and as noisy as the others.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro
from PIL import Image
from scipy import ndimage

from r3jax.files import make_folder
from r3jax.geometry.cameras import Camera, pose_along
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.scenes.registry import open_scene

_SPACING, _MARGIN = 0.4, 0.35
"""Between places of the walk, and of the walk from surfaces [m]."""

_JITTER = 0.02
"""Of the camera's position, standard deviation [m]."""

_TURN, _TURN_SPREAD = 2.0, 0.8
"""Median turn while the shutter is open [pixels of 320 of 70 degrees], and the standard deviation
of its logarithm: a tenth of the frames turns by 5.6 pixels and more."""

_SUBFRAMES = 5
"""Renderings that a frame is the mean of."""

_DRIFT = 0.25
"""Of the exposure."""

_NOISE = 0.01


@dataclass(frozen=True)
class Options:
    """A walk through a scene."""

    scene: Annotated[str, tyro.conf.Positional]

    out: Path = Path("runs/walks/walk")
    """Folder of the recording."""

    frames: int = 140

    width: int = 320
    """Of the images, which are 4 : 3 [px]."""

    hold_out: int = 8
    """One of this number of frames is sharp and evenly exposed."""

    seed: int = 0


def places(truth: GroundTruth, start: np.ndarray) -> np.ndarray:
    """Visits the free places at the height of the start, each time the nearest, [p, 3]."""
    free = truth.free_positions((_SPACING,) * 3, _MARGIN)
    level = free[np.argmin(np.abs(free[:, 2] - start[2])), 2]
    left = free[np.abs(free[:, 2] - level) < 1e-3]
    order: list[np.ndarray] = []
    here = start
    while len(left):
        nearest = int(np.argmin(np.linalg.norm(left - here, axis=1)))
        here = left[nearest]
        order.append(here)
        left = np.delete(left, nearest, axis=0)
    return ndimage.gaussian_filter1d(np.array(order), 1.0, axis=0)


def directions(turns: np.ndarray) -> np.ndarray:
    """Converts yaw and pitch, [n, 2] [rad], to directions, [n, 3]."""
    yaw, pitch = turns.T
    return np.stack([np.cos(yaw) * np.cos(pitch), np.sin(yaw) * np.cos(pitch), np.sin(pitch)], 1)


def write_walk(options: Options) -> None:
    """Writes the recording."""
    camera = Camera.from_fov(options.width, options.width * 3 // 4, 70.0)
    world = open_scene(options.scene, camera=camera)
    rng, count = np.random.default_rng(options.seed), options.frames
    smooth = lambda width: ndimage.gaussian_filter1d(rng.normal(0.0, 1.0, count), width)
    path = places(GroundTruth(world), np.asarray(world.start_pose)[:3, 3])
    at = np.linspace(0, len(path) - 1, count)
    position = np.stack([np.interp(at, np.arange(len(path)), path[:, k]) for k in range(3)], 1)
    position += _JITTER * rng.normal(0.0, 1.0, (count, 3))
    yaw = np.cumsum(smooth(15)) * 0.25 * np.sqrt(1000 / count)
    turns = np.stack([yaw, -0.15 + 0.75 * smooth(10)], axis=1)
    turn = np.radians(70.0 / 320.0 * _TURN) * np.exp(_TURN_SPREAD * rng.normal(0.0, 1.0, count))
    tilt = rng.normal(0.0, 0.6, count)
    while_open = turn[:, None] * np.stack([np.cos(tilt), np.sin(tilt)], axis=1)
    exposure = 1.0 + _DRIFT * np.sin(np.linspace(0.0, 12.0, count) + rng.uniform(0.0, 2.0 * np.pi))
    judges = np.arange(count) % options.hold_out == 0
    while_open[judges], exposure[judges] = 0.0, 1.0
    for name in ("images", "depth"):
        make_folder(options.out / name)
    poses: list[np.ndarray] = []
    for i in range(count):
        shutter = np.linspace(-0.5, 0.5, 1 if judges[i] else _SUBFRAMES)
        looks = directions(turns[i] + shutter[:, None] * while_open[i])
        seen = [world.render(np.asarray(pose_along(position[i], look))) for look in looks]
        middle = seen[len(seen) // 2]
        rgb = exposure[i] * np.mean([np.asarray(frame.rgb) for frame in seen], axis=0)
        rgb = np.clip(rgb + _NOISE * rng.normal(0.0, 1.0, rgb.shape), 0.0, 1.0)
        depth = np.asarray(middle.depth)
        depth = np.rint(1000.0 * np.where(np.isfinite(depth), depth, 0.0)).astype(np.uint16)
        name = f"{i:05d}.png"
        Image.fromarray(np.rint(255.0 * rgb).astype(np.uint8)).save(options.out / "images" / name)
        Image.fromarray(depth).save(options.out / "depth" / name)
        poses.append(np.asarray(middle.T_world_camera, np.float64))
    fx, fy, cx, cy = (float(v) for v in (camera.fx, camera.fy, camera.cx, camera.cy))
    # In this format the center of the first pixel is at 0.
    K = np.array([[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5], [0.0, 0.0, 1.0]])
    np.savetxt(options.out / "K.txt", K)
    np.savetxt(options.out / "poses.txt", np.reshape(poses, (count, 16)), fmt="%.9g")


if __name__ == "__main__":
    write_walk(tyro.cli(Options, description=__doc__))
