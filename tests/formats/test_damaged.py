"""Damaged captures of every format: each is refused by FormatError, which names the file and fact.

Damage by chance is in `tests/fuzz`; here is what people do to their files.
"""

import json
import re
from dataclasses import dataclass

import numpy as np
import pytest

from r3jax.formats.captures import open_capture
from r3jax.formats.errors import FormatError
from r3jax.formats.points import read_points
from tests.formats import phones, rtabmap, sequences
from tests.formats.sequences import encoded
from tests.formats.test_colmap import CAPTURE
from tests.formats.test_nerfstudio import CONTENT
from tests.formats.test_points import TEXT
from tests.fuzz.mutations import zipped
from tests.fuzz.tree import lay_out


def recording() -> dict[str, bytes]:
    pose = b"1 0 0 0 0 -1 0 0 0 0 -1 0 0 0 0 1\n"
    rgb, depth = encoded(np.zeros((8, 10, 3), np.uint8)), encoded(np.ones((8, 10), np.uint16))
    files = {f"images/00{i}.png": rgb for i in range(3)}
    files |= {f"depth/00{i}.png": depth for i in range(3)}
    return files | {"poses.txt": 3 * pose, "K.txt": b"8 0 4.5\n0 8 3.5\n0 0 1\n"}


def transforms() -> dict[str, bytes]:
    images = dict.fromkeys(
        ("images/a.jpg", "images/b.png"), encoded(np.zeros((8, 10, 3), np.uint8))
    )
    return {"transforms.json": json.dumps(CONTENT).encode(), **images}


GOOD = {
    "colmap": lambda: {f"sparse/0/{name}": text.encode() for name, text in CAPTURE.items()},
    "transforms": transforms,
    "recording": recording,
    "polycam": phones.polycam,
    "record3d": phones.record3d,
    "stray_scanner": phones.stray_scanner,
    "arkit_scenes": phones.arkit_scenes,
    "scannet": phones.scannet,
    "sens": lambda: {"scene.sens": phones.sens()},
    "rtabmap": rtabmap.export,
    "replica_slam": sequences.replica_slam,
    "tum": sequences.tum,
    "seven_scenes": sequences.seven_scenes,
}


@dataclass(frozen=True)
class Damage:
    """What is done to the first file whose name holds `file`."""

    file: str
    old: bytes | int | None
    """A regular expression, the first match of which is replaced; a place [bytes]; None: all."""

    new: bytes | None
    """None: all files of this name are deleted."""

    fact: str
    """What the message must hold beside the path of the capture: a regular expression."""

    def __call__(self, files: dict[str, bytes]) -> dict[str, bytes]:
        """The damaged files."""
        names = [name for name in files if self.file in name]
        assert names
        if self.new is None:
            return {name: data for name, data in files.items() if name not in names}
        data, new = files[names[0]], self.new
        if isinstance(self.old, int):
            return files | {names[0]: data[: self.old] + new + data[self.old + len(new) :]}
        if self.old is None:
            return files | {names[0]: new}
        changed, count = re.subn(self.old, lambda _: new, data, count=1)
        assert count
        return files | {names[0]: changed}


DAMAGES = {
    "colmap": [
        ("points3D", None, None, r"points3D\.txt"),
        ("cameras", b"PINHOLE", b"EQUIRECTANGULAR", r"cameras\.txt: line 5.*EQUIRECTANGULAR"),
        ("cameras", b" 16 10 5", b"", "line 5.* 4 parameters"),
        ("cameras", rb"500\.5", b"nan", "line 4"),
        ("cameras", rb"500\.5", b"-5", "focal lengths -5"),
        ("cameras", b"640", b"99999999", "99999999 x 480"),
        ("images", b" 7 second", b" 8 second", "camera 8"),
        ("images", rb"20 0\.7", b"10 0.7", "image 10 "),
        ("images", rb"0\.7071068", b"0.9", r"images\.txt.*quaternion"),
        ("images", b"1 2 3 7", b"1 2 inf 7", "inf"),
        ("images", b"a/first", b"../../x", r"\.\./\.\./x"),
        ("images", b"a/first", b"..\\x", r"leads out"),
        ("images", b"a/first", b"/etc/first", "/etc/first"),
        ("images", rb" 3 a/first\.png", b"", "line 5.* 10 words"),
        ("images", b" -1\n", b"\n", "line 3"),
        ("points3D", b"255", b"256", "256 128 0"),
        ("points3D", b" 99 3", b" 99", "line 1"),
        ("points3D", b"\n5", b"\n11", r"points3D\.txt.*twice"),
        ("points3D", b"-1 -2", b"nan -2", "point 5 "),
        ("images", None, b"# none\n", r"images\.txt"),
        ("cameras", None, None, "this is neither"),
    ],
    "transforms": [
        ("json", b'"frames"', b'"pictures"', "frames"),
        ("json", rb'"frames": \[.*\]', b'"frames": []', "no frames"),
        ("json", b'"file_path"', b'"path"', r"frames\[0\].*file_path"),
        ("json", b'"images/b.png"', b"7", r"frames\[0\].*file_path"),
        ("json", rb"\./images/a", b"../../x", r"\.\./\.\./x"),
        ("json", rb"\./images/a", b"/etc/passwd", "/etc/passwd"),
        ("json", rb'\./images/a"', b'a", "depth_file_path": "../x.png"', r"\.\./x\.png"),
        ("json", b'"w"', b'"ply_file_path": "/x.ply", "w"', r"/x\.ply"),
        ("json", b'"transform_matrix"', b'"matrix"', r"frames\[0\].*transform_matrix"),
        ("json", rb"\[0, 0, -1, 2\], \[0, 1, 0, 3\], ", b"", "3x4"),
        ("json", rb"\[1, 0, 0, 1\]", b"[1]", "3x4"),
        ("json", rb"\[1, 0, 0, 1\]", b'"x"', "transform_matrix"),
        ("json", rb"\[1, 0, 0, 1\]", b"[-1, 0, 0, 1]", r"frames\[0\].*mirrors"),
        ("json", rb"\[1, 0, 0, 1\]", b"[2, 0, 0, 1]", "not rigid"),
        ("json", rb"\[1, 0, 0, 1\]", b"[1, 0, 0, 1e30]", "1e\\+30"),
        ("json", rb'"fl_x": 12\.5, "fl_y": 12\.25', b'"x": 0', r"frames\[0\].*fl_x"),
        ("json", b'"fl_y": ', b'"fl_y": -', "focal lengths 12.5 and -12"),
        ("json", rb'"fl_x": 12\.5, "fl_y": 12\.25', b'"camera_angle_x": 4', "camera_angle_x .*4"),
        ("json", b'"w"', b'"camera_model": "VR180_L", "w"', "VR180_L"),
        ("json", b'"w"', b'"camera_model": "EQUIRECTANGULAR", "w"', "10 x 8 pixels"),
        ("json", b'"w": 10', b'"w": 10.5', r"`w`.*10\.5"),
        ("json", b'"w"', b'"k4": 0.1, "w"', "k4"),
        ("json", b'"w"', b'"depth_unit_scale_factor": 0, "w"', "depth_unit_scale_factor 0"),
        ("json", b'"w"', b'"applied_scale": 0.0, "w"', "applied_scale 0"),
        ("json", b'"w"', b'"applied_transform": [[1.0]], "w"', "applied_transform"),
        ("json", rb'"w": 10(.*)images/b\.png', b'"frames": [{"file_path": "gone', "."),
        ("json", None, b"[]", "ns-export cameras"),
        ("json", None, b'{"frames": NaN}', "NaN"),
    ],
    "recording": [
        ("K.txt", None, None, r"K\.txt"),
        ("K.txt", b"4.5", b"x", r"K\.txt: line 1"),
        ("K.txt", rb"4\.5", b"45", "45, 3.5.*10x8"),
        ("K.txt", None, b"", r"K\.txt"),
        ("001.png", None, None, "2 images, 2 depth images, 3 poses"),
        ("poses", b"^1.*\n", b"", "3 images, 3 depth images, 2 poses"),
        ("poses", b"^1", b"nan", r"poses\.txt: pose 0"),
        ("poses", b"^1", b"1.5", r"pose 0 .*not rigid"),
        ("poses", b"^1", b"-1", r"pose 0 .*mirrors"),
        ("poses", None, b"one two\n", "line 1 has 2 numbers, not 16"),
    ],
    "polycam": [
        ("keyframes/depth", None, None, "ns-process-data images"),
        ("cameras/", None, None, "Developer mode"),
        ("corrected_cameras", b'"fx"', b'"f"', r"1600000\.json: .*fx"),
        ("corrected_cameras", rb'"t_00": [-\d.e]+', b'"t_00": 7.0', r"1600000\.json: the pose"),
        ("corrected_cameras", b'"width": 48', b'"width": -1', "-1 x 36"),
        ("corrected_cameras", rb'"fx": [\d.]+', b'"fx": "x"', r"camera\.fx"),
        ("corrected_cameras", None, b'{"fx": ', r"1600000\.json: this is not JSON"),
    ],
    "record3d": [
        (".depth", None, None, r"\.r3d"),
        ("metadata", rb'"poses": \[\[.*?\]\]', b'"poses": [[0, 0, 0, 1, 0, 0]]', "1 poses"),
        ("metadata", rb'"poses": \[\[.*?\]\]', b'"poses": []', "0 poses"),
        ("metadata", rb'"poses": \[\[[^,]*', b'"poses": [[9', "metadata: pose 0.*quaternion"),
        ("metadata", rb'"K": \[.*?\]', b'"K": [1.0]', "`K`.* 9 .* 1"),
        ("metadata", b'"dw": 16', b'"dw": 1048576', "1048576 x 12"),
        ("metadata", b'"w"', b'"width"', " w"),
    ],
    "stray_scanner": [
        ("depth/", None, None, "ns-process-data video"),
        ("odometry", None, None, r"odometry\.csv"),
        ("odometry", b"qw", b"q", r"odometry\.csv: .*qw"),
        ("odometry", rb"\n(.|\n)*", b"\n", r"odometry\.csv"),
        ("odometry", rb"\n$", b"\n1, 2\n", "row 5 has 2 fields"),
        ("odometry", b"000001", b"x", "row 2: `frame`.*x"),
        ("odometry", b"000003", b"-3", "-3 is"),
        ("rgb.mp4", None, b"ftyp", r"rgb\.mp4"),
    ],
    "arkit_scenes": [
        ("lowres_depth", None, None, "lowres_depth"),
        ("pincam", None, None, "lowres_wide_intrinsics"),
        ("1.628.pincam", None, b"256 192 1", r"pincam: line 1.* not 6"),
        ("1.628.pincam", None, b"1e300 1 1 1 1 1", "0 x 1"),
        ("traj", rb"\S+ \S+$", b"", r"wide\.traj: line 4.* not 7"),
        ("traj", None, b"a b c d e f g", r"wide\.traj: line 1: "),
        ("traj", None, b"6791 nan 0 0 0 0 0", r"wide\.traj"),
        ("traj", None, b"7 0 0 0 0 0 0", "lowres_wide"),
    ],
    "scannet": [
        ("pose/11", None, None, r"pose/11\.txt"),
        ("pose/11", None, b"1 0 0 0", r"11\.txt.* 4x4 .* 1 lines"),
        ("pose/11", b"0[.]", b"7.", r"11\.txt: the pose"),
        ("intrinsic_color", None, b"1 2 3", r"_color\.txt: .*3x3"),
        ("intrinsic_depth", None, b"0 0 0 0\n" * 4, "focal lengths 0"),
        ("intrinsic/", None, None, "--export_poses"),
    ],
    "sens": [
        ("sens", 0, b"\3", "version 3"),
        ("sens", 4, (1 << 40).to_bytes(8, "little"), "1099511627776"),
        ("sens", 283, b"\0", "0 and 1"),
        ("sens", 291, (1 << 20).to_bytes(4, "little"), "16777216 pixels"),
        ("sens", 307, bytes(4), "0 steps"),
        ("sens", 311, (1 << 50).to_bytes(8, "little"), "1125899906842624 frames"),
        ("sens", rb"(?s).{500}\Z", b"", "cut off"),
        ("sens", rb"(?s)(?<=^.{100}).*", b"", "cut off"),
        ("sens", 27, bytes(4), "focal lengths 0"),
    ],
    "rtabmap": [
        ("scan_depth", None, None, "rtabmap-export --images_id"),
        ("scan_rgb", rb"(?s)(?<=^.{40}).*", b"", r"scan_rgb/3\.jpg"),
        ("poses", b" 3\n", b"\n", r"poses\.txt: line 2 has 8 numbers, not 9"),
        ("yaml", b"camera_matrix", b"no", r"scan_calib/3\.yaml: .*camera_matrix"),
        ("yaml", rb"0\., 0\., 1\. \]", b"1. ]", "camera_matrix .* 9 .* 7"),
    ],
    "replica_slam": [
        ("traj", None, b"", r"traj\.txt"),
        ("traj", rb"\s\S+\n", b"\n", r"traj\.txt: line 1 has 15 numbers, not 16"),
        ("000001.", None, None, "2 images, 2 depth images, 3 poses"),
        ("cam_params", None, None, r"cam_params\.json"),
        ("cam_params", None, b'{"camera": {"w": 1}}', "`camera`.*cx"),
        ("cam_params", rb"6553\.5", b"0", "scale 0"),
    ],
    "tum": [
        ("rgb.txt", None, b"100.0 ../x.png\n", r"rgb\.txt: line 1: .*\.\./x\.png"),
        ("depth.txt", None, b"# nothing\n", r"depth\.txt"),
        ("depth.txt", None, b"now x.png\n", r"depth\.txt: line 1"),
        ("depth.txt", None, b"inf x.png\n", r"depth\.txt"),
        ("rgb.txt", None, b"100.0\n", r"rgb\.txt: line 1"),
        ("groundtruth", None, b"7 0 0 0 0 0 0 1\n", r"0\.02 s"),
        ("groundtruth", None, b"100 0 0 0 0 0 0 2\n", r"pose at 100\.0000 s: .*quaternion"),
        ("groundtruth", None, b"100 1e13 0 0 0 0 0 1\n", r"1e\+?13|10000000000000"),
    ],
    "seven_scenes": [
        ("000001.pose", None, None, r"000001\.pose\.txt"),
        ("000001.pose", None, b"1 0 0 0\n", "4x4 .* 1 lines"),
        ("000000.pose", None, b"nan nan nan nan\n" * 4, r"000000\.pose\.txt: .*not finite"),
    ],
}

CASES = [
    pytest.param(kind, Damage(*row), id=f"{kind} {i}")
    for kind, rows in DAMAGES.items()
    for i, row in enumerate(rows)
]


@pytest.mark.parametrize(("kind", "damage"), CASES)
def test_a_damaged_capture_is_named(tmp_path, kind, damage):
    path = tmp_path / kind
    lay_out(path, damage(GOOD[kind]()))
    with pytest.raises(FormatError, match=damage.fact) as found:
        open_capture(path)
    assert str(path) in str(found.value)


@pytest.mark.parametrize("row", [DAMAGES["polycam"][2], DAMAGES["record3d"][4]])
def test_a_member_of_an_archive_is_named_below_the_archive(tmp_path, row):
    kind = "polycam" if "cameras" in row[0] else "record3d"
    path = tmp_path / "scan.zip"
    path.write_bytes(zipped(Damage(*row)(GOOD[kind]())))
    with pytest.raises(FormatError, match=row[3]) as found:
        open_capture(path)
    assert str(path) in str(found.value)


PIXELS = {
    "polycam": [
        ("corrected_images", rb"(?s)(?<=^.{50}).*", b"", r"1600000\.jpg"),
        ("corrected_cameras", b'"width": 48', b'"width": 50', r"0\.jpg: .*48 x 36.*50 x 36"),
        ("keyframes/depth", None, encoded(np.zeros((12, 16, 3), np.uint8)), r"h/1600000\.png"),
        ("keyframes/conf", None, encoded(np.zeros((3, 4), np.uint8)), r"e/16.* 4 x 3 .* 16 x 12"),
    ],
    "recording": [
        ("depth/000", None, encoded(np.zeros((8, 10), np.uint8)), r"depth/000\.png: .*16 bits"),
        ("images/000", None, None, r"images/000\.png: the file is missing"),
    ],
    "sens": [
        ("sens", rb"\xff\xd8", b"\0\0", r"scene\.sens"),
        ("sens", rb"\x78\x9c", b"\0\0", r"scene\.sens"),
    ],
    "record3d": [
        ("0.depth", rb"(?s)(?<=^.{30}).*", b"", r"0\.depth: .*768"),
        ("0.depth", b"^....", b"bvx1", r"0\.depth: .* 0 bytes, not 768"),
    ],
}


@pytest.mark.parametrize(
    ("kind", "damage"), [(kind, Damage(*row)) for kind, rows in PIXELS.items() for row in rows]
)
def test_damaged_pixels_are_named_when_they_are_read(tmp_path, kind, damage):
    lay_out(tmp_path / kind, damage(GOOD[kind]()))
    images = open_capture(tmp_path / kind)
    with pytest.raises(FormatError, match=damage.fact):
        next(images.frames())


POINTS = [
    ("ply", "plx", "end_header"),
    ("end_header", "end", "end_header"),
    ("ascii", "EBCDIC", "format"),
    ("element vertex 2", "element face 2", "element face 2"),
    ("property float nx", "property list uchar int nx", "property list uchar int nx"),
    ("float nx", "float x", "property float x"),
    ("double z", "double w", "z"),
    ("vertex 2", f"vertex {10**12}", "1000000000000 points"),
    ("vertex 2", "vertex -2", "vertex -2"),
    ("0.1", "nan", "point 0"),
    ("0.1", "one", "point 0"),
    (" 0 51", " 0", "point 0 has 6 numbers, not 7"),
    ("255 0 51", "1e400 0 51", "red"),
]


@pytest.mark.parametrize(("old", "new", "fact"), POINTS)
def test_damaged_points_are_named(tmp_path, old, new, fact):
    assert old in TEXT
    (tmp_path / "p.ply").write_text(TEXT.replace(old, new, 1))
    with pytest.raises(FormatError, match=rf"p\.ply: .*{fact}"):
        read_points(tmp_path / "p.ply")
