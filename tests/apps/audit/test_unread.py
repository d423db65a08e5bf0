"""Pictures that cannot be read, and pictures of which nothing is known: left out, and said."""

import json
from dataclasses import replace

import numpy as np
import pytest

from r3jax.apps.audit.audit import audit
from r3jax.apps.audit.settings import AuditSettings
from r3jax.captures.faults.faults import find_faults
from r3jax.captures.source import source_of
from r3jax.captures.survey import survey_of
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.errors import FormatError
from r3jax.formats.nerfstudio import read_transforms
from tests.apps.audit.room import round_poses, write_colmap, write_nerfstudio

POSES = round_poses(6)


def cut(path):
    data = path.read_bytes()
    path.write_bytes(data[: 2 * len(data) // 3])


BREAK = {
    "missing": lambda path: path.unlink(),
    "cut off": cut,
    "empty": lambda path: path.write_bytes(b""),
    "no image": lambda path: path.write_text("<html>"),
}


@pytest.fixture
def capture(tmp_path):
    return write_nerfstudio(tmp_path / "scan", POSES, depth=True)


def opened(path):
    return source_of(read_transforms(path), "scan")


@pytest.mark.parametrize("how", BREAK)
@pytest.mark.parametrize("what", ["images", "depth"])
def test_a_picture_that_cannot_be_read_is_left_out_and_named(capture, how, what):
    for number in (0, 4):
        BREAK[how](capture / what / f"{number:03d}.png")
    source = opened(capture)
    assert survey_of(source, AuditSettings()).median_depth > 0.5
    found = find_faults(source, np.arange(6))
    assert set(found.left_out) == {0, 4}
    assert found.left_out[4].startswith("004.png: ")
    assert found.looked_at == 4
    assert found.record["pictures"] == [1, 2, 3, 5]


def test_the_size_of_an_image_that_is_gone_is_that_of_the_others(capture):
    content = json.loads((capture / "transforms.json").read_text())
    del content["w"], content["h"]
    (capture / "transforms.json").write_text(json.dumps(content))
    (capture / "images" / "000.png").unlink()
    assert len(set(read_transforms(capture).lenses)) == 1
    assert set(find_faults(opened(capture), np.arange(6)).left_out) == {0}


def test_without_any_image_only_depth_is_spoken_of(capture):
    for image in (capture / "images").iterdir():
        image.unlink()
    source = opened(capture)
    assert not source.has_images
    assert source.remark is not None
    assert source.remark.startswith("None of the 6 pictures was found")
    assert str(capture / "images" / "000.png") in source.remark
    found = find_faults(source, np.arange(6))
    assert found.left_out == {}
    assert not {"detail", "brightness"} & found.record.keys()
    assert {finding.kind for finding in found.findings} <= {"pose", "scale"}


def test_where_nothing_can_be_read_the_first_reason_is_named(capture):
    for image in (capture / "images").iterdir():
        image.write_bytes(b"")
    with pytest.raises(FormatError, match=r"000\.png: .*empty"):
        survey_of(opened(capture), AuditSettings())


def test_pictures_without_depth_are_known_by_their_numbers(capture):
    content = json.loads((capture / "transforms.json").read_text())
    for frame in content["frames"][::2]:
        del frame["depth_file_path"]
    (capture / "transforms.json").write_text(json.dumps(content))
    assert find_faults(opened(capture), np.arange(6)).without_depth == (0, 2, 4)


@pytest.mark.parametrize(("count", "is_enough"), [(1, False), (20, False), (200, True)])
def test_some_tens_of_points_are_no_capture(tmp_path, count, is_enough):
    images = read_colmap(write_colmap(tmp_path / "scan", POSES))
    assert images.points is not None
    kept = images.points.seen_point < count
    points = replace(
        images.points,
        seen_point=images.points.seen_point[kept],
        seen_image=images.points.seen_image[kept],
    )
    few = replace(images, points=points)
    if is_enough:
        assert source_of(few, "scan").kind == "tracks"
    else:
        with pytest.raises(FormatError, match=r"only \d+ points"):
            source_of(few, "scan")


def test_a_single_picture_has_no_others_to_be_judged_by(tmp_path):
    source = opened(write_nerfstudio(tmp_path / "scan", POSES[:1], depth=True))
    with pytest.raises(ValueError, match="1 of"):
        audit(source)
