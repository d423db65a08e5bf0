"""A room whose pictures follow from a formula, and captures of it in every format."""

import json
from pathlib import Path

import numpy as np
from PIL import Image

from r3jax.formats.colmap.binary import write_binary
from r3jax.formats.colmap.model import ColmapImage, ColmapModel, ColmapPoints, colmap_pose
from r3jax.formats.lenses import Lens
from r3jax.formats.nerfstudio import OPENGL_FROM_OPENCV
from r3jax.formats.points import write_points
from r3jax.geometry.cameras import look_at

SIZE = np.array([4.0, 3.0, 2.4])
"""The room spans from the origin to here [m]; z is up."""

WIDTH, HEIGHT, FOCAL = 48, 36, 30.0
LENS = Lens("PINHOLE", WIDTH, HEIGHT, (FOCAL, FOCAL, WIDTH / 2, HEIGHT / 2))


def pose_at(eye, target) -> np.ndarray:
    """`T_world_camera` [4, 4] float64, exactly rigid."""
    pose = np.asarray(look_at(np.asarray(eye, float), np.asarray(target, float)), np.float64)
    u, _, vt = np.linalg.svd(pose[:3, :3])
    pose[:3, :3], pose[:3, 3] = u @ vt, eye
    return pose


def round_poses(num: int = 16) -> np.ndarray:
    """Cameras on a circle in the middle of the room, looking outwards, a little up and down."""
    poses = []
    for i in range(num):
        angle = 2 * np.pi * i / num
        ahead = np.array([np.cos(angle), np.sin(angle), 0.5 * np.sin(3 * angle)])
        eye = np.array([2.0, 1.5, 1.2]) - 0.5 * ahead * [1, 1, 0]
        poses.append(pose_at(eye, eye + ahead))
    return np.stack(poses)


def color_of(points: np.ndarray) -> np.ndarray:
    """RGB [..., 3] in [0, 1] of points on the walls: smooth, and different everywhere."""
    waves = points @ np.array([[1.3, 0.4, 0.9], [0.5, 1.7, 0.2], [0.8, 0.3, 1.1]])
    return 0.5 + 0.35 * np.sin(waves)


def picture(pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Colors [H, W, 3] uint8 and z-depth [H, W] [m] of the walls from inside."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    local = np.stack([(u - WIDTH / 2) / FOCAL, (v - HEIGHT / 2) / FOCAL, np.ones_like(u)], -1)
    rays = local @ pose[:3, :3].T
    eye = pose[:3, 3]
    with np.errstate(divide="ignore"):
        depth = np.where(rays > 0, (SIZE - eye) / rays, -eye / rays).min(axis=-1)
    points = eye + depth[..., None] * rays
    return np.rint(255 * color_of(points)).astype(np.uint8), depth


def write_pictures(folder: Path, poses: np.ndarray, depth_steps: float | None = 1000.0) -> None:
    """images/000.png and, with a scale, depth/000.png."""
    for name in ("images", "depth")[: 1 if depth_steps is None else 2]:
        (folder / name).mkdir(parents=True)
    for i, pose in enumerate(poses):
        rgb, depth = picture(pose)
        Image.fromarray(rgb).save(folder / "images" / f"{i:03d}.png")
        if depth_steps is not None:
            steps = np.rint(depth * depth_steps).astype(np.uint16)
            Image.fromarray(steps).save(folder / "depth" / f"{i:03d}.png")


def write_recording(folder: Path, poses: np.ndarray) -> Path:
    """The layout of `formats.recordings`, z up."""
    write_pictures(folder, poses)
    K = [[FOCAL, 0, WIDTH / 2 - 0.5], [0, FOCAL, HEIGHT / 2 - 0.5], [0, 0, 1]]
    np.savetxt(folder / "K.txt", K)
    np.savetxt(folder / "poses.txt", poses.reshape(-1, 16), fmt="%.17g")
    return folder


def write_far_recording(folder: Path, poses: np.ndarray, far: np.ndarray) -> Path:
    """The same capture in a world whose origin is far away."""
    write_recording(folder, poses)
    moved = poses.copy()
    moved[:, :3, 3] += far
    np.savetxt(folder / "poses.txt", moved.reshape(-1, 16), fmt="%.17g")
    return folder


def wall_points(num: int = 4000, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points strewn over the walls [num, 3], and their colors [num, 3] uint8."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(0.0, SIZE, (num, 3))
    axis = rng.integers(3, size=num)
    points[np.arange(num), axis] = np.where(rng.random(num) < 0.5, 0.0, SIZE[axis])
    return points, np.rint(255 * color_of(points)).astype(np.uint8)


def write_nerfstudio(folder: Path, poses: np.ndarray, *, depth: bool, scale: float = 1.0) -> Path:
    """transforms.json with depth, or with a cloud of points in other units."""
    write_pictures(folder, poses, 1000.0 if depth else None)
    moved = poses.copy()
    moved[:, :3, 3] *= scale
    frames = [
        {
            "file_path": f"images/{i:03d}.png",
            "transform_matrix": (pose @ OPENGL_FROM_OPENCV).tolist(),
            **({"depth_file_path": f"depth/{i:03d}.png"} if depth else {}),
        }
        for i, pose in enumerate(moved)
    ]
    content = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "frames": frames}
    if not depth:
        points, colors = wall_points()
        write_points(folder / "points.ply", points * scale, colors)
        content["ply_file_path"] = "points.ply"
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def write_colmap(folder: Path, poses: np.ndarray, *, lens: Lens = LENS, scale: float = 1.0) -> Path:
    """A binary model: every point on a wall in the track of every image that shows it."""
    write_pictures(folder, poses, None)
    points, colors = wall_points()
    tracks: list[list[int]] = [[] for _ in points]
    images = []
    for i, pose in enumerate(poses):
        local = (points - pose[:3, 3]) @ pose[:3, :3]
        z = np.where(local[:, 2] > 0.1, local[:, 2], np.inf)
        u, v = FOCAL * local[:, 0] / z + WIDTH / 2, FOCAL * local[:, 1] / z + HEIGHT / 2
        is_in = np.isfinite(z) & (u >= 0) & (u < WIDTH) & (v >= 0) & (v < HEIGHT)
        for point in np.flatnonzero(is_in).tolist():
            tracks[point].append(i + 1)
        moved = pose.copy()
        moved[:3, 3] *= scale
        none = np.zeros((0, 2)), np.zeros(0, np.int64)
        images.append(ColmapImage(i + 1, f"{i:03d}.png", 1, *colmap_pose(moved), *none))
    lengths = np.array([len(track) for track in tracks], np.int64)
    ids = np.arange(1, len(points) + 1, dtype=np.int64)
    model = ColmapModel(
        {1: lens},
        tuple(images),
        ColmapPoints(
            ids=ids, xyz=points * scale, rgb=colors, error=np.ones(len(points)),
            track_lengths=lengths,
            track_images=np.concatenate(tracks).astype(np.int64),
            track_keypoints=np.zeros(int(lengths.sum()), np.int64),
        ),
    )  # fmt: skip
    (folder / "sparse" / "0").mkdir(parents=True)
    write_binary(folder / "sparse" / "0", model)
    return folder
