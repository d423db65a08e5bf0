"""The room of the audit's tests, filmed by phones: in memory, in the layout of each app."""

import io
import json
import struct
import tempfile
import zlib
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from r3jax.formats.lenses import Lens
from r3jax.formats.poses import quaternion_of
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


def record3d(size: bool = True, first: np.ndarray | None = None) -> dict[str, bytes]:
    """What an .r3d archive holds; `first` takes the world to another one."""
    import lzfse

    files: dict[str, bytes] = {}
    T_world_room = Y_UP_FROM_Z_UP if first is None else first
    poses, coeffs = [], []
    for i, room_pose in enumerate(room_poses()):
        lens = lens_of(i)
        arkit = T_world_room @ room_pose @ OPENGL
        w, x, y, z = quaternion_of(arkit[:3, :3])
        poses.append([x, y, z, w, *arkit[:3, 3].tolist()])
        coeffs.append(list(lens.params))
        depth = view(room_pose, smaller(lens))[1].astype("<f4")
        depth[0, 0] = np.nan
        files[f"rgbd/{i}.jpg"] = encoded(view(room_pose, lens)[0], "jpeg")
        files[f"rgbd/{i}.depth"] = lzfse.compress(depth.tobytes())
        files[f"rgbd/{i}.conf"] = lzfse.compress(levels(2).tobytes())
    fx, fy, cx, cy = LENS.params
    metadata = {"w": LENS.width, "h": LENS.height, "fps": 60, "K": [fx, 0, 0, 0, fy, 0, cx, cy, 1]}
    metadata |= {"poses": poses, "initPose": [0, 0, 0, 1, 0, 0, 0]}
    metadata |= {"perFrameIntrinsicCoeffs": coeffs, "frameTimestamps": [0.0, 0.1, 0.2, 0.3]}
    if size:
        metadata |= {"dw": LENS.width // FACTOR, "dh": LENS.height // FACTOR}
    return {"metadata": json.dumps(metadata).encode(), **files, "sound.m4a": b"", "icon": b""}


def record3d_export(top: str = "EXR_RGBD/", suffix: str = "jpg") -> dict[str, bytes]:
    """The app's export EXR + JPG of the same recording, which has no confidence."""
    r3d = record3d()
    files = {"metadata.json": r3d["metadata"], "sound.m4a": b""}
    for i, room_pose in enumerate(room_poses()):
        lens = lens_of(i)
        depth = view(room_pose, smaller(lens))[1].astype(np.float32)
        depth[0, 0] = np.nan
        files[f"rgb/{i}.{suffix}"] = encoded(view(room_pose, lens)[0], "jpeg")
        files[f"depth/{i}.exr"] = exr({"R": depth})
    return {top + name: data for name, data in files.items()}


def exr(channels: dict[str, np.ndarray]) -> bytes:
    """An EXR image with these channels."""
    import OpenEXR

    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/image.exr"
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        with OpenEXR.File(header, channels) as file:
            file.write(path)
        return Path(path).read_bytes()


VIDEO = Lens("PINHOLE", 192, 144, (132.0, 132.0, 102.0, 66.0))
"""Of a video: larger, as encoders want it."""


def video(images: list[np.ndarray]) -> bytes:
    """An MP4 with two key frames, so that jumping is tried; nearly without loss."""
    import av

    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        options = {"crf": "4", "preset": "ultrafast"}
        stream = container.add_stream("libx264", rate=60, options=options)
        stream.width, stream.height, stream.pix_fmt = VIDEO.width, VIDEO.height, "yuv420p"
        stream.codec_context.gop_size = max(2, len(images) // 2)
        for image in images:
            frame = av.VideoFrame.from_ndarray(image, format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p")))
        container.mux(stream.encode(None))
    return file.getvalue()


def stray_scanner(intrinsics: bool = True, center: bool = False) -> dict[str, bytes]:
    """A recording; with intrinsics of every frame as newer versions write it, and with empty
    columns for the center of distortion as those of 2026 do."""
    fx, fy, cx, cy = VIDEO.params
    names = ["timestamp", "frame", "x", "y", "z", "qx", "qy", "qz", "qw"]
    names += ["fx", "fy", "cx", "cy"] * intrinsics
    names += ["distortion_center_x", "distortion_center_y"] * center
    rows = [", ".join(names)]
    images, files = [], {}
    for i, room_pose in enumerate(room_poses()):
        lens = Lens("PINHOLE", 192, 144, (fx + 4 * i * intrinsics, fy + 4 * i * intrinsics, cx, cy))
        arkit = Y_UP_FROM_Z_UP @ room_pose  # the app has turned the camera's axes
        w, x, y, z = quaternion_of(arkit[:3, :3])
        numbers = [100 + i / 60, f"{i:06d}", *arkit[:3, 3], x, y, z, w]
        numbers += [*lens.params] * intrinsics + ["", ""] * center
        rows.append(", ".join(str(v) for v in numbers))
        images.append(view(room_pose, lens)[0])
        files[f"depth/{i:06d}.png"] = encoded(depth_steps(room_pose, smaller(lens)))
        files[f"confidence/{i:06d}.png"] = encoded(levels(2, smaller(lens)))
    files["odometry.csv"] = ("\n".join(rows) + "\n").encode()
    files["camera_matrix.csv"] = f"{fx}, 0.0, {cx}\n0.0, {fy}, {cy}\n0.0, 0.0, 1.0".encode()
    return files | {"rgb.mp4": video(images), "imu.csv": b"timestamp, a_x\n"}


Z_UP_FROM_ROOM = np.array(
    [[0.0, -1.0, 0.0, 3.0], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]]
)
"""Takes the room to a world that is z up as well, somewhere else."""


def arkit_scenes() -> dict[str, bytes]:
    """A video; poses have a clock of their own, the first image comes before them."""
    files: dict[str, bytes] = {}
    lines = []
    for i, room_pose in enumerate([room_poses()[0], *room_poses()]):
        lens, time = lens_of(i), 6791.528 + 0.1 * i
        name = f"40753679_{time:.3f}"
        T_camera_world = np.linalg.inv(Z_UP_FROM_ROOM @ room_pose)
        numbers = [time + 0.003, *axis_angle(T_camera_world[:3, :3]), *T_camera_world[:3, 3]]
        if i:
            lines.append(" ".join(f"{value:.9f}" for value in numbers))
        fx, fy, cx, cy = lens.params
        camera = f"{lens.width} {lens.height} {fx} {fy} {cx} {cy}".encode()
        files[f"lowres_wide/{name}.png"] = encoded(view(room_pose, lens)[0])
        files[f"lowres_depth/{name}.png"] = encoded(depth_steps(room_pose, smaller(lens)))
        files[f"confidence/{name}.png"] = encoded(levels(2))
        off = 0.001 * (i % 3 - 1)
        files[f"lowres_wide_intrinsics/40753679_{time + off:.3f}.pincam"] = camera
    return files | {"lowres_wide.traj": "\n".join(lines).encode()}


def axis_angle(R: np.ndarray) -> np.ndarray:
    """Axis times angle [3] of a rotation."""
    return Rotation.from_matrix(R).as_rotvec()


DEPTH_LENS = Lens("PINHOLE", 20, 14, (11.0, 11.0, 10.5, 6.5))
"""Of a depth camera that sees more than the colors, at the same place: their pixels coincide."""


def matrix(lens: Lens) -> np.ndarray:
    """ScanNet's 4x4 intrinsics; pixel centers lie at whole numbers."""
    fx, fy, cx, cy = lens.params
    K = np.eye(4)
    K[:2, :3] = [[fx, 0.0, cx - 0.5], [0.0, fy, cy - 0.5]]
    return K


def scannet_poses() -> list[np.ndarray]:
    """The second one was lost."""
    poses = [Z_UP_FROM_ROOM @ pose for pose in room_poses()]
    return [poses[0], np.full((4, 4), -np.inf), *poses[1:]]


def scannet() -> dict[str, bytes]:
    """An exported scene."""
    files: dict[str, bytes] = {}
    text = lambda M: "\n".join(" ".join(f"{x:.9f}" for x in row) for row in M).encode()
    for i, pose in enumerate(scannet_poses()):
        room_pose = room_poses()[max(0, i - 1)]
        files[f"color/{9 + i}.jpg"] = encoded(view(room_pose, LENS)[0], "jpeg")
        files[f"depth/{9 + i}.png"] = encoded(depth_steps(room_pose, DEPTH_LENS))
        files[f"pose/{9 + i}.txt"] = text(pose)
    for name, lens in (("color", LENS), ("depth", DEPTH_LENS)):
        files[f"intrinsic/intrinsic_{name}.txt"] = text(matrix(lens))
        files[f"intrinsic/extrinsic_{name}.txt"] = text(np.eye(4))
    return files


def sens(packed: bool = True) -> bytes:
    """The same scene as a .sens file."""
    name = b"StructureSensor"
    matrices = [matrix(LENS), np.eye(4), matrix(DEPTH_LENS), np.eye(4)]
    poses = scannet_poses()
    data = struct.pack("<IQ", 4, len(name)) + name
    data += np.stack(matrices).astype("<f4").tobytes()
    sizes = (LENS.width, LENS.height, DEPTH_LENS.width, DEPTH_LENS.height)
    data += struct.pack("<2i4IfQ", 2, int(packed), *sizes, 1000.0, len(poses))
    for i, pose in enumerate(poses):
        room_pose = room_poses()[max(0, i - 1)]
        color = encoded(view(room_pose, LENS)[0], "jpeg")
        depth = depth_steps(room_pose, DEPTH_LENS).astype("<u2").tobytes()
        depth = zlib.compress(depth) if packed else depth
        data += pose.astype("<f4").tobytes()
        data += struct.pack("<4Q", i, i, len(color), len(depth)) + color + depth
    return data + struct.pack("<Q", 0)  # no readings of the inertial sensor
