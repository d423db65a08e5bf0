"""The room of the audit's tests, filmed by phones: in memory, in the layout of each app."""

import json

import numpy as np

from r3jax.formats.lenses import Lens
from tests.apps.audit.room import SIZE, color_of, round_poses
from tests.formats.sequences import encoded

LENS = Lens("PINHOLE", 48, 36, (33.0, 33.0, 25.5, 16.5))
"""Of the colors; off center, so that a shift or a flip shows."""

FACTOR = 3
"""A depth image has so many times fewer rows and columns; odd, so that pixel centers coincide."""

NUM = 4

Y_UP_FROM_Z_UP = np.array(
    [[0.0, 1.0, 0.0, 5.0], [0.0, 0.0, 1.0, -1.0], [1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 0.0, 1.0]]
)
"""Takes the room to ARKit's world, somewhere else."""

OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def smaller(lens: Lens = LENS, factor: int = FACTOR) -> Lens:
    """The lens of the depth images."""
    params = tuple(value / factor for value in lens.params)
    return Lens("PINHOLE", lens.width // factor, lens.height // factor, params)


def room_poses(num: int = NUM) -> np.ndarray:
    """`T_room_camera`: upright, tilted, and one camera on its side as a phone is held."""
    poses = round_poses(num)
    quarter = np.array([[0.0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    poses[1] = poses[1] @ quarter
    return poses


def view(pose: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Colors [H, W, 3] uint8 and z-depth [H, W] [m] of the room's walls."""
    points, depth = walls(pose, lens)
    return np.rint(255 * color_of(points)).astype(np.uint8), depth


def walls(pose: np.ndarray, lens: Lens) -> tuple[np.ndarray, np.ndarray]:
    """Points on the walls [H, W, 3] and their z-depth [H, W]."""
    rays, eye = rays_of(lens) @ pose[:3, :3].T, pose[:3, 3]
    rays = np.where(np.abs(rays) < 1e-12, 1e-12, rays)
    depth = np.where(rays > 0, (SIZE - eye) / rays, -eye / rays).min(axis=-1)
    return eye + depth[..., None] * rays, depth


def rays_of(lens: Lens) -> np.ndarray:
    """Rays through the pixel centers, [H, W, 3], z is 1."""
    fx, fy, cx, cy = lens.intrinsics
    u, v = np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5)
    return np.stack([(u - cx) / fx, (v - cy) / fy, np.ones_like(u)], axis=-1)


def depth_steps(pose: np.ndarray, lens: Lens | None = None) -> np.ndarray:
    """Millimeters, [h, w] uint16; the first pixel has no measurement."""
    steps = np.rint(1000 * view(pose, lens or smaller())[1]).astype(np.uint16)
    steps[0, 0] = 0
    return steps


def levels(best: int, lens: Lens | None = None) -> np.ndarray:
    """Confidence [h, w] uint8: the last two columns are unsure."""
    lens = lens or smaller()
    found = np.full((lens.height, lens.width), best, np.uint8)
    found[:, -2:] = best // 2
    return found


def lens_of(index: int) -> Lens:
    """Focusing changes the focal length from frame to frame."""
    fx, fy, cx, cy = LENS.params
    return Lens("PINHOLE", LENS.width, LENS.height, (fx + index, fy + index, cx, cy))


def polycam(corrected: bool = True, top: str = "") -> dict[str, bytes]:
    """Raw data with a mesh, as the app exports it."""
    files: dict[str, bytes] = {"mesh_info.json": b"{}", "thumbnail.jpg": b"", "raw.glb": b"glTF"}
    for i, room_pose in enumerate(room_poses()):
        name, lens = str(1_600_000 + 700_000 * i), lens_of(i)
        rgb, _ = view(room_pose, lens)
        arkit = (Y_UP_FROM_Z_UP @ room_pose @ OPENGL)[:3]
        fx, fy, cx, cy = lens.params
        camera = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": lens.width}
        camera |= {"height": lens.height, "blur_score": 80.5, "timestamp": int(name)}
        camera |= {f"t_{r}{c}": arkit[r, c] for r in range(3) for c in range(4)}
        wrong = {**camera, "t_03": camera["t_03"] + 0.3}
        files[f"keyframes/images/{name}.jpg"] = encoded(rgb, "jpeg")
        files[f"keyframes/cameras/{name}.json"] = json.dumps(
            wrong if corrected else camera
        ).encode()
        files[f"keyframes/depth/{name}.png"] = encoded(depth_steps(room_pose, smaller(lens)))
        files[f"keyframes/confidence/{name}.png"] = encoded(levels(255))
        if corrected:
            files[f"keyframes/corrected_images/{name}.jpg"] = encoded(rgb, "jpeg")
            files[f"keyframes/corrected_cameras/{name}.json"] = json.dumps(camera).encode()
    return {top + name: data for name, data in files.items()}
