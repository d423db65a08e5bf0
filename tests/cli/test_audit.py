"""`r3jax audit`, as a user meets it, on a small room in every format."""

import functools
import json
import shlex

import numpy as np
import pytest

from r3jax.apps.audit.live.growing import subset
from r3jax.apps.audit.settings import AuditSettings
from r3jax.captures.camera_paths import write_camera_path
from r3jax.captures.source import source_of
from r3jax.cli.commands import audit as command
from r3jax.cli.main import main
from r3jax.files import MARKER
from r3jax.formats.captures import open_capture
from r3jax.formats.nerfstudio import read_transforms
from tests.apps.audit.room import (
    LENS,
    pose_at,
    round_poses,
    write_colmap,
    write_nerfstudio,
)
from tests.formats import rtabmap
from tests.formats.bags import COLOR, write_bag


@pytest.fixture(scope="module", autouse=True)
def _little_work(small_maps):
    """Few places and small maps: the room is small."""
    few = functools.partial(AuditSettings, num_places=16, num_standpoints=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command, "AuditSettings", few)
        yield


def audit(capture, out, *words):
    options = ("--views", "2", "--folds", "4", "--out", str(out))
    return main(["audit", str(capture), *options, *words])


@pytest.fixture(scope="module")
def audited(captures, tmp_path_factory):
    out = tmp_path_factory.mktemp("audits") / "room"
    assert audit(captures / "recording", out, "--voxel-size", "0.15") == 0
    return out


@pytest.mark.full
def test_an_audit_leaves_a_page_clouds_cameras_and_numbers(audited):
    names = {path.name for path in audited.iterdir()} - {MARKER}
    assert names == {
        "report.html", "voxels.ply", "causes.ply", "suggested.json", "suggested_transforms.json",
        "audit.json",
    }  # fmt: skip
    record = json.loads((audited / "audit.json").read_text())
    assert record["voxel_size"] == pytest.approx(0.15)
    assert [frame["fold"] for frame in record["path"]["frames"]] == [0, 1, 2, 3] * 4
    assert len(record["suggested"]) == 2
    page = (audited / "report.html").read_text()
    assert page.count("data:image/png;base64,") >= 6
    assert "http://" not in page
    assert "https://" not in page
    before, _, details = page.partition("<details>")
    assert 'class="verdict' in before  # what to do stands before everything that is folded
    assert before.count("<li>") <= 3
    assert before.count("<h3>") == 1
    assert details.count("<h3>") >= len(record["suggested"]) - 1
    assert sorted(view["rank"] for view in record["suggested"]) == [1, 2]


@pytest.mark.full
def test_the_suggested_views_are_a_capture_that_our_reader_opens(audited):
    record = json.loads((audited / "audit.json").read_text())
    images = read_transforms(audited / "suggested_transforms.json")
    written = [view["camera_to_world_opengl"] for view in record["suggested"]]
    np.testing.assert_array_equal(images.poses @ np.diag([1.0, -1, -1, 1]), written)
    assert (images.lenses[0].width, images.lenses[0].height) == (LENS.width, LENS.height)


@pytest.mark.full
def test_the_same_words_give_the_same_numbers(captures, audited, tmp_path):
    assert audit(captures / "recording", tmp_path / "again", "--voxel-size", "0.15") == 0
    for name in ("audit.json", "suggested_transforms.json", "voxels.ply"):
        assert (tmp_path / "again" / name).read_bytes() == (audited / name).read_bytes()


@pytest.mark.full
@pytest.mark.parametrize("kind", ["bag", "rtabmap"])
def test_recordings_of_robots_are_audited(tmp_path, kind, capsys):
    words = ["--voxel-size", "0.15"]
    if kind == "bag":
        path = write_bag(tmp_path / "drive")
        words += ["--topics", f"color={COLOR}"]
    else:
        path = tmp_path / "map.db"
        path.write_bytes(rtabmap.database())
    assert audit(path, tmp_path / "out", *words) == 0
    captured = capsys.readouterr()
    said = " ".join(captured.out.split())  # lines are wrapped
    if kind == "bag":
        assert f"Color is {COLOR}, depth /camera/aligned_depth" in said
        following = " ".join(captured.err.split())
        assert f"next r3jax audit {path} " in following
        assert f"--topics color={COLOR}" in following
    else:
        assert "1 of 4 images" in said
    record = json.loads((tmp_path / "out" / "audit.json").read_text())
    assert record["depth_from"] == "depth"
    assert record["unit"] == "metre"


@pytest.mark.full
@pytest.mark.parametrize(
    "name",
    ["nerfstudio", pytest.param("nerfstudio/transforms.json", marks=pytest.mark.slow), "colmap"],
)
def test_other_formats_are_audited(captures, tmp_path, name, capsys):
    words = ["--surfaces", "points"] if name == "colmap" else ["--voxel-size", "0.15"]
    assert audit(captures / name, tmp_path / "out", *words) == 0
    said = " ".join(capsys.readouterr().out.split())  # lines are wrapped
    assert "R ≥ 0.5" in said
    assert "Views to take" in said
    record = json.loads((tmp_path / "out" / "audit.json").read_text())
    assert record["depth_from"] == ("tracks" if name == "colmap" else "depth")
    assert record["unit"] == ("unknown" if name == "colmap" else "metre")
    positions = np.array([v["camera_to_world_opengl"] for v in record["suggested"]])[:, :3, 3]
    assert (positions > 0).all()
    assert (positions < (3.0 if name == "colmap" else 1.0) * np.array([4.0, 3.0, 2.4])).all()


@pytest.mark.full
def test_a_given_path_is_judged_frame_by_frame(captures, tmp_path, capsys):
    poses = np.stack([pose_at([1.5, 1.5, 1.2], t) for t in ([4, 1, 1], [2, 3, 1], [0, 0, 2])])
    write_camera_path(tmp_path / "path.json", poses, LENS.camera)
    known = [str(tmp_path / "path.json"), str(captures / "recording")]
    for path, count in zip(known, (3, 16), strict=True):
        out = tmp_path / f"out{count}"
        assert audit(captures / "recording", out, "--path", path, "--views", "0") == 0
        record = json.loads((out / "audit.json").read_text())
        assert record["path"]["own"] is False
        assert len(record["path"]["frames"]) == count
        assert not (out / "suggested.json").exists()
        assert 0.3 < record["path"]["mean"] <= 1.0


def refused(capsys, *words):
    assert main(["audit", *map(str, words)]) == 2
    said = capsys.readouterr().err
    assert "Traceback" not in said
    return said


def test_a_missing_picture_is_named(captures, tmp_path, capsys):
    capture = write_nerfstudio(tmp_path / "holes", round_poses(3), depth=True)
    (capture / "images" / "001.png").unlink()
    assert main(["audit", str(capture), "--views", "0", "--out", str(tmp_path / "out")]) == 0
    assert "001.png" in capsys.readouterr().out


def test_the_name_of_a_capture_is_that_of_its_folder(captures):
    assert open_capture(captures / "nerfstudio" / "transforms.json").name == "nerfstudio"
    name = f"{captures.name}-colmap"  # many captures lie in a folder called so
    assert open_capture(captures / "colmap").name == name
    assert open_capture(captures / "colmap").models.parts == ("runs", name, "models")


def test_a_wrong_unit_of_depth_ends_in_one_line_and_no_folder(captures, tmp_path, capsys):
    write_nerfstudio(tmp_path / "capture", round_poses(), depth=True)
    path = tmp_path / "capture" / "transforms.json"
    content = json.loads(path.read_text())
    content["depth_unit_scale_factor"] = 5 * content.get("depth_unit_scale_factor", 0.001)
    path.write_text(json.dumps(content))
    assert audit(path, tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "poses" in said
    assert "multiplied by 0.2" in said
    assert not (tmp_path / "out").exists()


@pytest.mark.full
def test_what_came_in_while_scanning_is_audited_in_the_end(captures, tmp_path, capsys, monkeypatch):
    source = source_of(open_capture(captures / "recording", "z").source, "scan")
    came_in = [subset(source, list(range(12))), None]
    monkeypatch.setattr(command, "follow", lambda *_, **__: came_in.pop(0))
    words = ["--live", "--port", "0", "--voxel-size", "0.15", "--views", "0"]
    assert audit(captures / "recording", tmp_path / "out", *words) == 0
    assert "http://127.0.0.1:" in capsys.readouterr().err
    assert json.loads((tmp_path / "out" / "audit.json").read_text())["pictures"] == 12
    told = refused(capsys, "/no/such/topic", "--live", "--port", 0)
    assert "-r color:=/no/such/topic" in told
    assert "no frames" in refused(capsys, captures / "recording", "--live", "--port", 0)


def test_captures_whose_folders_have_common_names_are_told_apart(captures):
    poses = round_poses(3)
    for path, name in (
        (write_colmap(captures / "kitchen", poses) / "sparse" / "0", "kitchen-sparse-0"),
        (write_nerfstudio(captures / "chess" / "seq-01", poses, depth=True), "chess-seq-01"),
    ):
        assert open_capture(path).name == name


def test_the_audit_of_another_capture_is_not_replaced(captures, audited, tmp_path, capsys):
    said = refused(capsys, captures / "nerfstudio", "--out", audited)
    assert str(captures / "recording") in said
    assert "--out" in said
    assert audit(captures / "recording", audited, "--voxel-size", "0.15") == 0


def test_the_command_that_comes_next_keeps_the_options(captures, tmp_path, capsys):
    out = tmp_path / "my audit"
    words = ("--up=-z", "--max-frames", "12", "--trust-depth", "--voxel-size", "0.2")
    assert audit(captures / "recording", out, *words) == 0
    line = next(line for line in capsys.readouterr().err.splitlines() if line.startswith("next"))
    again = shlex.split(line.removeprefix("next"))
    expected = {"--up=-z", "--max-frames", "12", "--trust-depth", "--voxel-size", "0.2"}
    assert again[:3] == ["r3jax", "audit", str(captures / "recording")]
    assert {*expected, "--views", "--folds", "--out", str(out)} <= set(again)
    assert "--port" not in again
