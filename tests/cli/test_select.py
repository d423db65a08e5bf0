"""`r3jax select`, as a user meets it: reduced captures that other programs read."""

import dataclasses
import json
import os
import shutil
import signal

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage

from r3jax.captures.camera_paths import write_camera_path
from r3jax.cli.console import Stages
from r3jax.cli.main import main
from r3jax.formats.captures import open_capture
from r3jax.formats.colmap.binary import write_binary
from r3jax.formats.colmap.reader import find_model, read_model
from r3jax.formats.nerfstudio import read_transforms
from tests.apps.audit.room import (
    LENS,
    pose_at,
    round_poses,
    write_nerfstudio,
    write_recording,
)
from tests.captures.faults.walk import CAMERA, walk
from tests.conftest import shared_path
from tests.formats.phones import video

pytestmark = [pytest.mark.full, pytest.mark.usefixtures("small_maps")]


def select(capture, out, *words):
    return main(["select", str(capture), "--out", str(out), "--voxel-size", "0.15", *words])


def record_of(out):
    return json.loads((out / "selection.json").read_text())


def state_of(folder):
    """Every file of a folder with its content."""
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_a_transforms_json_keeps_all_but_the_frames_dropped(captures, tmp_path):
    capture = captures / "nerfstudio"
    path = capture / "transforms.json"
    before = state_of(capture)
    assert select(capture, tmp_path / "out", "--frames", "6") == 0
    assert state_of(capture) == before
    old, new = (
        json.loads((p / "transforms.json").read_text()) for p in (capture, tmp_path / "out")
    )
    assert {k: v for k, v in old.items() if k != "frames"} == {
        k: v for k, v in new.items() if k != "frames"
    }
    kept = set(record_of(tmp_path / "out")["kept"])
    assert len(kept) == 6
    is_kept = [p.name in kept for p in read_transforms(path).image_paths]
    assert new["frames"] == [f for f, stays in zip(old["frames"], is_kept, strict=True) if stays]
    again = open_capture(tmp_path / "out").source
    for i, image in enumerate(again.image_paths):
        assert image.is_symlink()
        assert again.frame(i).rgb.shape == (LENS.height, LENS.width, 3)
    assert (tmp_path / "out" / "selection.html").exists()


def test_a_colmap_model_keeps_what_its_images_still_see(captures, tmp_path):
    capture = captures / "colmap"
    out = tmp_path / "out"
    arguments = ["select", str(capture), "--out", str(out), "--frames", "8", "--copy"]
    assert main(arguments) == 0
    old, new = (read_model(find_model(path)) for path in (capture, out))
    kept = set(record_of(out)["kept"])
    assert {image.name for image in new.images} == kept
    ids = {image.id for image in new.images}
    old_seen = dict(zip(old.points.ids.tolist(), tracks(old), strict=True))
    for number, track in zip(new.points.ids.tolist(), tracks(new), strict=True):
        assert track == [element for element in old_seen[number] if element[0] in ids]
        assert track
    known = set(new.points.ids.tolist())
    for image in new.images:
        assert set(image.point_ids[image.point_ids >= 0].tolist()) <= known
    for name in kept:
        assert (out / "images" / name).read_bytes() == (capture / "images" / name).read_bytes()
        assert not (out / "images" / name).is_symlink()


def test_a_reduced_model_keeps_its_masks_and_names_that_are_not_utf8(captures, tmp_path):
    """An archive from a Windows that writes file names in Latin-1."""
    capture, out = shutil.copytree(captures / "colmap", tmp_path / "capture"), tmp_path / "out"
    model = read_model(find_model(capture))
    latin = lambda name: os.fsdecode(b"K\xfcche " + name.encode())
    images = tuple(dataclasses.replace(i, name=latin(i.name)) for i in model.images)
    for old, new in zip(model.images, images, strict=True):
        (capture / "images" / old.name).rename(capture / "images" / new.name)
    write_binary(find_model(capture), dataclasses.replace(model, images=images))
    mask = np.full((LENS.height, LENS.width), 255, np.uint8)
    mask[:20] = 0
    (capture / "masks").mkdir()
    Image.fromarray(mask).save(capture / "masks" / f"{images[0].name}.png")
    keep = f"K\ufffdche {model.images[0].name}"
    assert select(capture, out, "--surfaces", "points", "--frames", "3", "--keep", keep) == 0
    assert keep in record_of(out)["kept"]
    again = open_capture(out).source
    at = [path.name for path in again.image_paths].index(images[0].name)
    np.testing.assert_array_equal(again.masked_rgb(at)[1], mask > 0)
    assert "K\ufffdche" in (out / "selection.html").read_text()


def tracks(model):
    """(image, keypoint) pairs of each point."""
    pairs = np.stack([model.points.track_images, model.points.track_keypoints], axis=1).tolist()
    ends = np.cumsum(model.points.track_lengths)
    return [
        [tuple(pair) for pair in pairs[end - length : end]]
        for end, length in zip(ends, model.points.track_lengths, strict=True)
    ]


@pytest.mark.slow
def test_pycolmap_reads_the_reduced_model_of_a_real_capture(tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    capture = shared_path("recordings", "banana")
    assert main(["select", str(capture), "--out", str(tmp_path / "out"), "--frames", "6"]) == 0
    model = pycolmap.Reconstruction(str(find_model(tmp_path / "out")))
    assert model.num_reg_images() == 6
    assert all(point.track.length() >= 1 for point in model.points3D.values())


def test_a_recording_becomes_a_transforms_json_with_depth(captures, tmp_path):
    assert select(captures / "recording", tmp_path / "out", "--share", "0.25") == 0
    old = open_capture(captures / "recording", "z").source
    new = read_transforms(tmp_path / "out")
    assert len(new) == 4
    names = [path.name for path in old.image_paths]
    for i, path in enumerate(new.image_paths):
        at = names.index(path.name)
        np.testing.assert_allclose(new.poses[i], old.poses[at], atol=1e-6)
        np.testing.assert_allclose(new.depth(i), old.depth(at), atol=1e-3)


def check_by_nerfstudios_rules(folder):
    """What its parser asserts (nerfstudio_dataparser.py), in our words."""
    content = json.loads((folder / "transforms.json").read_text())
    frames = content["frames"]
    names = [frame["file_path"] for frame in frames]
    assert all((folder / name).is_file() for name in names)
    for field in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        assert field in content or all(field in frame for frame in frames)
    for field in ("depth_file_path", "mask_path"):
        given = [frame[field] for frame in frames if field in frame]
        assert len(given) in (0, len(frames))
        assert all((folder / name).is_file() for name in given)
    assert content.get("camera_model", "OPENCV") in ("OPENCV", "OPENCV_FISHEYE", "PINHOLE")
    splits = [content.get(f"{split}_filenames") for split in ("train", "val", "test")]
    assert splits == [None] * 3 or all(part and set(part) <= set(names) for part in splits)
    if "ply_file_path" in content:
        assert (folder / content["ply_file_path"]).is_file()


@pytest.mark.parametrize("train", [4, 14])
def test_nerfstudio_would_open_what_is_written(captures, tmp_path, train):
    assert select(captures / "recording", tmp_path / "made", "--frames", "5") == 0
    check_by_nerfstudios_rules(tmp_path / "made")
    capture = tmp_path / "with_splits"
    write_nerfstudio(capture, round_poses(), depth=True)
    content = json.loads((capture / "transforms.json").read_text())
    names = [frame["file_path"] for frame in content["frames"]]
    content |= {"cx": LENS.width / 2, "cy": LENS.height / 2}
    content |= {"train_filenames": names[:train], "val_filenames": names[train:15],
                "test_filenames": names[15:]}  # fmt: skip
    (capture / "transforms.json").write_text(json.dumps(content))
    words = ("--frames", "5", "--keep", "000.png", "014.png", "015.png")
    assert select(capture, tmp_path / "kept", *words) == 0
    check_by_nerfstudios_rules(tmp_path / "kept")
    assert "test_filenames" in json.loads((tmp_path / "kept" / "transforms.json").read_text())
    assert select(capture, tmp_path / "lost", "--frames", "1") == 0
    check_by_nerfstudios_rules(tmp_path / "lost")


def test_the_same_folder_is_written_again_but_nothing_that_is_not_ours(captures, tmp_path):
    out = tmp_path / "out"
    for count in (8, 3):
        assert select(captures / "nerfstudio", out, "--frames", str(count)) == 0
    assert len(list((out / "images").iterdir())) == 3
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "thesis.txt").write_text("mine")
    assert select(captures / "nerfstudio", tmp_path / "other", "--frames", "3") == 2


def test_more_frames_than_there_are_keep_all_and_it_is_said(captures, tmp_path):
    assert select(captures / "recording", tmp_path / "out", "--frames", "60") == 0
    record = record_of(tmp_path / "out")
    assert len(record["kept"]) == 16
    assert any("60" in note and "16" in note for note in record["notes"])


def test_frames_that_were_not_looked_at_are_counted(captures, tmp_path):
    out = tmp_path / "out"
    assert select(captures / "recording", out, "--frames", "3", "--max-frames", "8") == 0
    assert any("8 of the capture's 16 frames" in note for note in record_of(out)["notes"])


def test_frames_that_must_stay_stay(captures, tmp_path):
    names = open_capture(captures / "recording", "z").source.image_paths
    words = ("--frames", "3", "--keep", names[5].name, names[6].stem)
    assert select(captures / "recording", tmp_path / "out", *words) == 0
    assert {names[5].name, names[6].name} <= set(record_of(tmp_path / "out")["kept"])


def test_targets_may_be_a_path_but_not_outside_of_the_capture(captures, tmp_path, capsys):
    inside = np.stack([pose_at([2.0, 1.5, 1.2], [4.0, 1.5, 1.2])])
    write_camera_path(tmp_path / "in.json", inside, LENS.camera)
    words = ("--frames", "3", "--targets", str(tmp_path / "in.json"))
    assert select(captures / "recording", tmp_path / "in", *words) == 0
    assert record_of(tmp_path / "in")["num_targets"] == 1
    outside = np.stack([pose_at([100.0, 1.5, 1.2], [104.0, 1.5, 1.2])])
    write_camera_path(tmp_path / "out.json", outside, LENS.camera)
    words = ("--frames", "3", "--targets", str(tmp_path / "out.json"))
    assert select(captures / "recording", tmp_path / "out", *words) == 2
    assert "out.json" in capsys.readouterr().err


def test_targets_may_be_where_people_could_stand(captures, tmp_path):
    words = ("--frames", "4", "--targets", "stand")
    assert select(captures / "recording", tmp_path / "out", *words) == 0
    record = record_of(tmp_path / "out")
    assert record["targets"] == "stand"
    assert record["num_targets"] % 8 == 0  # level directions of each place
    assert len(record["kept"]) == 4
    assert np.all(np.diff(record["renderability"]) >= -1e-6)


def test_ctrl_c_writes_the_frames_chosen_so_far(captures, tmp_path, monkeypatch):
    told, stages = Stages.on_progress, []

    def on_progress(self, stage, steps):
        told(self, stage, steps)
        stages.append(stage)
        if stages[-2:] == ["choosing frames", ""]:  # after the first choice
            os.kill(os.getpid(), signal.SIGINT)

    monkeypatch.setattr(Stages, "on_progress", on_progress)
    assert select(captures / "nerfstudio", tmp_path / "out", "--frames", "6") == 0
    record = record_of(tmp_path / "out")
    assert 1 <= len(record["kept"]) < 6
    assert not record["is_complete"]
    assert len(open_capture(tmp_path / "out").source) == len(record["kept"])


def write_walk(folder, smeared, width=9):
    """A walk through a flat; some of its frames are smeared, across and down."""
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    for i, (rgb, depth, _) in enumerate(walk()):
        size = (width, width, 1) if i in smeared else 1
        Image.fromarray(ndimage.uniform_filter(rgb, size)).save(folder / "images" / f"{i:03d}.png")
        steps = np.rint(1000.0 * depth).astype(np.uint16)
        Image.fromarray(steps).save(folder / "depth" / f"{i:03d}.png")
    fx, fy, cx, cy = (float(v) for v in (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy))
    np.savetxt(folder / "K.txt", [[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    poses = np.stack([pose for _, _, pose in walk()])
    np.savetxt(folder / "poses.txt", poses.reshape(-1, 16), fmt="%.9g")


def test_blurred_frames_alone_are_left_out(tmp_path):
    write_walk(tmp_path / "walk", {4, 9})
    assert select(tmp_path / "walk", tmp_path / "out", "--drop-blurred") == 0
    dropped = record_of(tmp_path / "out")["dropped"]
    assert set(dropped) == {"004.png", "009.png"}
    assert all("blurred" in why for why in dropped.values())
    words = ("--drop-blurred", "--keep", "004.png")
    assert select(tmp_path / "walk", tmp_path / "kept", *words) == 0
    assert set(record_of(tmp_path / "kept")["dropped"]) == {"009.png"}


def test_a_blurred_frame_is_no_choice_where_sharp_ones_show_the_same(tmp_path):
    write_walk(tmp_path / "walk", {4, 9})
    assert select(tmp_path / "walk", tmp_path / "out", "--frames", "6") == 0
    assert not {"004.png", "009.png"} & set(record_of(tmp_path / "out")["kept"])


def test_that_all_are_blurred_is_said(tmp_path):
    write_walk(tmp_path / "walk", set(range(len(walk()))), 5)
    assert select(tmp_path / "walk", tmp_path / "out", "--frames", "3", "--drop-blurred") == 0
    assert any("blurred" in note for note in record_of(tmp_path / "out")["notes"])


def test_surfaces_of_photos_alone_may_be_points_or_swept(captures, tmp_path):
    words = ("--frames", "4", "--surfaces", "points")
    assert select(captures / "colmap", tmp_path / "points", *words) == 0
    assert record_of(tmp_path / "points")["surfaces_from"] == "tracks"
    real = tmp_path / "real"
    real.mkdir()
    (real / "images").symlink_to(shared_path("recordings", "hololens_lounge", "images").resolve())
    shutil.copytree(shared_path("recordings", "lounge_sfm", "sparse", "3"), real / "sparse" / "0")
    words = ["--frames", "5", "--out", str(tmp_path / "swept")]
    assert main(["select", str(real), *words]) == 0
    assert record_of(tmp_path / "swept")["surfaces_from"] == "sweep"
    assert "plane sweep" in (tmp_path / "swept" / "selection.html").read_text()


def test_two_scenes_are_kept_in_proportion_and_it_is_said(captures, tmp_path):
    poses = round_poses()
    both = np.concatenate([poses, poses[::2]])
    write_recording(tmp_path / "both", np.concatenate([poses, poses[::2]]))
    both[16:, 0, 3] += 30.0
    np.savetxt(tmp_path / "both" / "poses.txt", both.reshape(-1, 16), fmt="%.17g")
    assert select(tmp_path / "both", tmp_path / "out", "--frames", "6") == 0
    record = record_of(tmp_path / "out")
    numbers = [int(name.partition(".")[0]) for name in record["kept"]]
    assert sum(number < 16 for number in numbers) == 4
    assert record["scenes"] == 2
    assert any("2 scenes" in note for note in record["notes"])


def test_frames_that_share_nothing_are_refused(tmp_path, capsys):
    poses = round_poses(8)[::4]
    poses[1, :3, 3] += [40.0, 0.0, 0.0]
    write_recording(tmp_path / "apart", round_poses(8)[::4])
    np.savetxt(tmp_path / "apart" / "poses.txt", poses.reshape(-1, 16), fmt="%.17g")
    assert select(tmp_path / "apart", tmp_path / "out", "--frames", "1") == 2
    assert "same surface" in capsys.readouterr().err


def test_twins_are_left_out_and_named(captures, tmp_path):
    poses = round_poses()
    write_recording(tmp_path / "twins", np.concatenate([poses, poses[3:4]]))
    assert select(tmp_path / "twins", tmp_path / "out", "--drop-duplicates") == 0
    record = record_of(tmp_path / "out")
    assert len(record["kept"]) == 16
    assert list(record["dropped"].values()) == ["twin of 003.png"]


def test_of_a_video_sharp_frames_are_written_and_nothing_else_is_promised(tmp_path, capsys):
    wide = np.random.default_rng(0).integers(0, 255, (36, 400, 3)).repeat(4, 0).repeat(4, 1)
    walk = [wide[:, x : x + 192].astype(np.uint8) for x in range(0, 800, 16)]
    (tmp_path / "walk.mp4").write_bytes(video(walk))
    words = ["select", str(tmp_path / "walk.mp4"), "--out", str(tmp_path / "out")]
    assert main([*words, "--frames", "5"]) == 0
    pictures = sorted((tmp_path / "out" / "images").iterdir())
    assert len(pictures) == 5
    assert "poses" in capsys.readouterr().out
    assert main([*words, "--share", "0.5"]) == 2
    assert "--frames" in capsys.readouterr().err
