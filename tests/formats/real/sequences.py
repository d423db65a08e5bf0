"""Sequences of depth cameras as people hand them on."""

import io

import numpy as np

from tests.formats.real.layouts import NUM, POSES, Files, Layout, depth_png, picture, quaternion

KINECT = (640, 480)


def _tum(mark: str = "# ") -> Files:
    """Headings with the bag's name; where a script wrote the list anew, the last has lost its #."""
    tables: dict[str, list[str]] = {}
    for name, what in (("rgb", "color images"), ("depth", "depth maps")):
        heading = f"# {what}\n# file: 'rgbd_dataset_freiburg1_rpy.bag'\n{mark}timestamp filename"
        tables[f"{name}.txt"] = [heading]
    truth = "# ground truth trajectory\n# file: 'rgbd_dataset_freiburg1_rpy.bag'\n"
    tables["groundtruth.txt"] = [truth + mark + "timestamp tx ty tz qx qy qz qw"]
    files: Files = {"accelerometer.txt": b"# accelerometer data\n", "rgbd_assoc.txt": b""}
    for i in range(NUM):
        time = 1305031229.528748 + 0.035677 * i
        for name, data in (("rgb", picture(i, KINECT, "png")),
                           ("depth", depth_png(i, KINECT, 5000.0))):  # fmt: skip
            shown = f"{name}/{time + (0.000036 if name == 'depth' else 0):.6f}.png"
            files[shown] = data
            tables[f"{name}.txt"].append(f"{shown[len(name) + 1 : -4]} {shown}")
        numbers = " ".join(f"{v:.4f}" for v in [*POSES[i][:3, 3], *quaternion(POSES[i])])
        tables["groundtruth.txt"].append(f"{time - 0.0021:.4f} {numbers}")
    return files | {name: ("\n".join(lines) + "\n").encode() for name, lines in tables.items()}


def _seven_scenes(K: str = "", kind: str = "jpg") -> Files:
    """numpy.savetxt's eighteen digits, pictures as JPEG, intrinsics in the folder above."""
    files: Files = {"data/mesh.ply": b"", "data/vol_bnds.txt": b""}
    for i in range(NUM):
        rows = [" ".join(f"{value:.18e}" for value in row) for row in POSES[i]]
        base = f"data/frame-{i:06d}"
        files[f"{base}.pose.txt"] = ("\n".join(rows) + "\n").encode()
        files[f"{base}.depth.png"] = depth_png(i, KINECT)
        files[f"{base}.color.{kind}"] = picture(i, KINECT, "jpeg" if kind == "jpg" else "png")
    return files | ({"camera-intrinsics.txt": K.encode()} if K else {})


_K = " 5.7034000e+02\t 0.00000000e+00\t 3.20000000e+02\t\n" \
     " 0.00000000e+00\t 5.7134000e+02\t 2.40000000e+02\t\n" \
     " 0.00000000e+00\t 0.00000000e+00\t 1.00000000e+00\t\n"  # fmt: skip


def _replica() -> Files:
    """NICE-SLAM's rendering: sixteen numbers a line, steps of 1/6553.5 m."""
    camera = '{"camera": {"w": 64, "h": 48, "fx": 70.0, "fy": 70.0, "cx": 31.5, "cy": 23.5, '
    files: Files = {"cam_params.json": (camera + '"scale": 6553.5}}').encode()}
    lines = [" ".join(f"{value:.18e}" for value in pose.ravel()) for pose in POSES]
    files["traj.txt"] = ("\n".join(lines) + "\n").encode()
    for i in range(NUM):
        files[f"results/frame{i:06d}.jpg"] = picture(i, (64, 48))
        files[f"results/depth{i:06d}.png"] = depth_png(i, (64, 48), 6553.5)
    return files


def _llff() -> Files:
    """imgs2poses.py: names of a camera, masks under names of their own, copies of an eighth."""
    stored = io.BytesIO()
    table = [
        np.append(np.column_stack([T[:3, 1], T[:3, 0], -T[:3, 2], T[:3, 3], (48, 64, 70)]), (1, 9))
        for T in POSES
    ]
    np.save(stored, np.stack(table))
    files: Files = {"poses_bounds.npy": stored.getvalue(), "LICENSE.md": b""}
    for i, number in enumerate((9669, 9670, 9672)):
        files[f"images/IMG_{number}.JPG"] = picture(i, (64, 48))
        files[f"images_8/IMG_{number}.png"] = picture(i, (8, 6), "png")
        files[f"masks/IMG_{number}_mask.JPG"] = picture(i, (64, 48))
    return files


_Z = (0.0, 0.0, 1.0)
_TUM = {"size": KINECT, "intrinsics": (525.0, 525.0, 320.0, 240.0), "poses_off": 2e-4, "up": _Z,
        "remark": ("K.txt",)}  # fmt: skip
_SEVEN = {"size": KINECT, "given": "data"}

LAYOUTS = (
    Layout("TUM RGB-D", _tum, **_TUM),
    Layout("TUM RGB-D, a heading without #", lambda: _tum(""), **_TUM),
    Layout("7-Scenes, pictures as JPEG", _seven_scenes, intrinsics=(585.0, 585.0, 320.0, 240.0),
           **_SEVEN),
    Layout("3DMatch, another camera", lambda: _seven_scenes(_K, "png"),
           intrinsics=(570.34, 571.34, 320.0, 240.0), **_SEVEN),
    Layout("LLFF", _llff, size=(64, 48), intrinsics=(70.0, 70.0, 32.0, 24.0), has_depth=False),
    Layout("Replica of NICE-SLAM", _replica, size=(64, 48), intrinsics=(70.0, 70.0, 32.0, 24.0),
           up=_Z),
)  # fmt: skip


def lost_in_the_wild() -> dict[str, Files]:
    """Layouts that no reader takes, and which must not be taken for others."""
    table = "\n".join(" ".join(f"{v:.6g}" for v in [*T[:3, 3], *quaternion(T)]) for T in POSES)
    return {
        "pose.txt beside color/ and depth/": {
            "pose.txt": table.encode(), "color/1.png": picture(0, (64, 48), "png"),
            "depth/1.pgm": b"P5\n1 1\n65535\n\0\0",
        },
        "poses and depth of another project": {
            "rgb/1.png": picture(0, (64, 48), "png"), "depth/1.png": depth_png(0, (64, 48)),
            "real/depth_1.exr": b"v/1\1", "real/poses.json": b"{}",
        },
    }  # fmt: skip
