"""Folders that are no capture: what they most likely are, and the command that converts them."""

import sqlite3
from contextlib import closing

import pytest

from r3jax.formats.captures import open_capture
from r3jax.formats.errors import FormatError, check_capture
from tests.formats import phones, sequences
from tests.fuzz.mutations import zipped
from tests.fuzz.tree import lay_out

FOLDERS = {
    "images": (
        {"IMG_1.HEIC": b"", "IMG_2.HEIC": b""},
        r"look like images without poses: ns-process-data images --data \S+scan --output-dir OUT",
    ),
    "images below": ({"images/1.jpg": b""}, r"ns-process-data images --data \S+scan/images "),
    "a video": (
        {"clip.MOV": b"", "notes.txt": b""},
        r"like a video without poses: ns-process-data video --data \S+scan/clip\.MOV ",
    ),
    "colmap": (
        {"database.db": b"", "images/1.jpg": b""},
        r"COLMAP project without a model: colmap mapper --database_path \S+scan/database\.db",
    ),
    "colmap, half of it": (
        {"points3D.txt": b"", "images.txt": b"", "photos/1.jpg": b""},
        r"COLMAP model, but \S+scan/points3D\.txt has no cameras\.txt beside it",
    ),
    "metashape": (
        {"cameras.xml": b"", "images/1.jpg": b""},
        r"Metashape: ns-process-data metashape --data \S+scan --xml \S+scan/cameras\.xml",
    ),
    "images beside a program's own folder": (
        {".idea/misc.xml": b"", "images/1.jpg": b""},
        r"ns-process-data images --data \S+scan/images ",
    ),
    "exr": ({"rgb/0.jpg": b"", "depth/0.exr": b""}, r"Record3D's export .*without metadata\.json"),
    "exr below": ({"EXR_RGBD/depth/0.exr": b""}, r"Record3D's export .*metadata\.json .*EXR_RGBD"),
    "tum": (
        {name: data for name, data in sequences.tum().items() if name != "groundtruth.txt"},
        r"TUM RGB-D without groundtruth\.txt: .*trajectory",
    ),
    "colors beside depth": (
        {"depth/1.png": b"", "mask/1.png": b"", "photos/1.png": b""},
        r"ns-process-data images --data \S+scan/photos ",
    ),
    "a model": ({"scan.glb": b""}, "a finished model without the images it was made of"),
    "stray": ({"rgb.mp4": b"", "depth/000000.png": b""}, "Stray Scanner without odometry"),
    "scannet": ({"color/0.jpg": b"", "depth/0.png": b""}, "export of ScanNet without pose/"),
    "polycam": ({"keyframes/images/1.jpg": b""}, "Polycam export without keyframes/cameras"),
    "nothing": ({"notes.txt": b""}, "this is neither a run .run.json., a recording"),
    "one below": (
        {f"day1/{name}": data for name, data in sequences.tum().items()},
        r"not a capture, but \S+scan/day1 is one: give that folder",
    ),
    "some below": (
        {f"seq-0{k}/{n}": d for k in (1, 2, 3) for n, d in sequences.seven_scenes().items()},
        r"but \S+scan/seq-01 is one \(and 2 more\): give that folder",
    ),
    "several phones": (
        phones.polycam(top="monday/") | phones.polycam(top="friday/"),
        r"but \S+scan/friday is one \(and 1 more\): give that folder",
    ),
}


def test_a_capture_of_a_common_name_is_named_after_its_parents_too(tmp_path):
    lay_out(tmp_path / "walk" / "data" / "seq-01", sequences.seven_scenes())
    assert open_capture(tmp_path / "walk" / "data" / "seq-01").name == "walk-data-seq-01"


@pytest.mark.parametrize("name", FOLDERS)
def test_a_folder_that_is_not_understood_gets_a_guess(tmp_path, name):
    files, message = FOLDERS[name]
    lay_out(tmp_path / "scan", files)
    with pytest.raises(FormatError, match=message) as found:
        open_capture(tmp_path / "scan")
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("files", "message"),
    [
        ({"a/1.jpg": b""}, r"unpack this archive first; .* images --data \S+scan/a --output-dir"),
        (
            phones.polycam(top="monday/") | phones.polycam(top="friday/"),
            "holds several captures: unpack it and give one of its folders",
        ),
        ({"notes.txt": b""}, "holds no capture that is known: unpack it"),
    ],
)
def test_an_archive_of_something_else_gets_a_guess(tmp_path, files, message):
    (tmp_path / "scan.zip").write_bytes(zipped(files))
    with pytest.raises(FormatError, match=rf"scan\.zip: .*{message}"):
        open_capture(tmp_path / "scan.zip")


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("clip.mp4", r"ns-process-data video --data \S+clip\.mp4 --output-dir OUT"),
        ("mesh.GLB", "a folder of the images that a model was made of"),
        ("notes.txt", r"transforms\.json, or an app's file \(\.zip, \.r3d, \.sens, \.bag"),
    ],
)
def test_a_file_that_is_no_capture_says_what_to_do(tmp_path, name, message):
    (tmp_path / name).touch()
    with pytest.raises(FormatError, match=message):
        check_capture(tmp_path / name)


def test_a_database_of_colmap_says_what_to_do(tmp_path):
    with closing(sqlite3.connect(tmp_path / "database.db")) as connection:
        connection.execute("CREATE TABLE cameras (camera_id INTEGER)")
    with pytest.raises(FormatError, match="COLMAP"):
        open_capture(tmp_path / "database.db")


def test_files_of_apps_pass_the_first_check(tmp_path):
    for name in ("scan.zip", "scan.R3D", "scene.sens"):
        (tmp_path / name).touch()
        check_capture(tmp_path / name)
    (tmp_path / "scan.r3d").write_bytes(zipped(phones.record3d()))
    assert len(open_capture(tmp_path / "scan.r3d")) == phones.NUM


def test_a_model_of_colmap_beside_raw_data_goes_first(tmp_path):
    files = {f"raw/{name}": data for name, data in phones.polycam().items()}
    lay_out(tmp_path, files | {"sparse/0/cameras.bin": b"", "sparse/0/images.bin": b""})
    with pytest.raises(FormatError, match=r"sparse/0/\w+\.bin"):
        open_capture(tmp_path)


def test_a_transforms_json_that_cannot_be_read_names_the_colmap_model_beside_it(tmp_path):
    model = {f"sparse/0/{name}.txt": b"" for name in ("cameras", "images", "points3D")}
    lay_out(tmp_path, model | {"transforms.json": b'{"frames": [{"file_path": "/them/1.jpeg"}]}'})
    with pytest.raises(FormatError, match=r"its COLMAP model may be whole: give .*sparse"):
        open_capture(tmp_path)
    (tmp_path / "sparse/0/cameras.txt").unlink()
    with pytest.raises(FormatError) as error:
        open_capture(tmp_path)
    assert "COLMAP" not in str(error.value)
