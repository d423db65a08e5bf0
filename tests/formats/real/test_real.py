"""Every reader finds the right cameras, pictures and depth in files as the wild has them."""

import numpy as np
import pytest

from r3jax.captures.source import source_of
from r3jax.formats.captures import open_capture
from r3jax.formats.errors import FormatError
from r3jax.formats.posed_images import PosedImages
from tests.formats.real import colmap, nerf, phone, robots, sequences
from tests.formats.real.layouts import POSES, Layout, color, meters
from tests.fuzz.tree import lay_out

LAYOUTS = [
    layout
    for family in (colmap, nerf, phone, sequences, robots)
    for layout in family.LAYOUTS
]  # fmt: skip

JPEG = 12.0
"""Largest error of a plain color that a JPEG or a video may make [of 255]."""


@pytest.mark.parametrize("layout", LAYOUTS, ids=lambda layout: layout.name)
def test_a_real_layout_is_read_as_it_is_meant(layout: Layout, tmp_path):
    lay_out(tmp_path / "capture", layout.files())
    images = open_capture(tmp_path / "capture" / layout.given).source
    assert isinstance(images, PosedImages)
    assert len(images) == len(layout.frames)
    np.testing.assert_allclose(images.poses, POSES[list(layout.frames)], atol=layout.poses_off)
    assert images.lenses[0].model == layout.model
    assert images.lenses[0].intrinsics == pytest.approx(layout.intrinsics, rel=1e-6)
    if layout.up is None:
        assert images.up is None
    else:
        np.testing.assert_array_equal(images.up, layout.up)
    assert_remark(images.remark, layout.remark)
    for index, shown in enumerate(layout.frames):
        assert_picture(images, index, shown, layout)
    if layout.has_points:
        assert images.points is not None
        assert [len(images.points.seen_by(i)) for i in range(3)] == [colmap.NUM_POINTS] * 3


def assert_remark(remark: str | None, words: tuple[str, ...]) -> None:
    """Something is said if, and only if, there is something to say."""
    if not words:
        assert remark is None
    for word in words:
        assert word in str(remark)


def assert_picture(images: PosedImages, index: int, shown: int, layout: Layout) -> None:
    """Color and depth of the two quarters, in the middle of each."""
    width, height = layout.size
    rgb = images.rgb(index)
    assert rgb.shape == (height, width, 3)
    for row, column, expected in (
        (height // 4, width // 4, (255, 255, 255)),
        (3 * height // 4, 3 * width // 4, color(shown)),
        (height // 4, 3 * width // 4, color(shown)),
    ):
        assert np.abs(rgb[row, column].astype(int) - expected).max() < JPEG
        if layout.has_depth:
            frame = images.frame(index)
            depth = float(np.asarray(frame.depth)[row, column])
            assert depth == pytest.approx(meters(shown, width, height)[row, column], abs=2e-3)
    if not layout.has_depth:
        assert images.depth_paths[index] is None


def test_a_transforms_json_without_points_names_the_model_beside_it(tmp_path):
    layouts = {layout.name: layout for layout in LAYOUTS}
    model = layouts["colmap_text of instant-ngp"].files()
    lay_out(tmp_path, layouts["instant-ngp's colmap2nerf"].files() | model)
    capture = open_capture(tmp_path)
    with pytest.raises(FormatError, match=r"model beside it .*colmap_text"):
        source_of(capture.source, capture.name)


@pytest.mark.parametrize("name", sequences.lost_in_the_wild())
def test_poses_in_a_layout_of_somebodys_own_are_not_denied(name, tmp_path):
    lay_out(tmp_path, sequences.lost_in_the_wild()[name])
    with pytest.raises(FormatError, match=r"\(.*pose.*\)") as found:
        open_capture(tmp_path)
    assert not any(word in str(found.value) for word in ("ScanNet", "Record3D", "without poses"))


def test_a_map_that_kept_no_pictures_says_so(tmp_path):
    lay_out(tmp_path, robots.without_pictures())
    with pytest.raises(FormatError, match="BinDataKept"):
        open_capture(tmp_path / "rtabmap.db")


@pytest.mark.parametrize("name", robots.pointers())
def test_a_clone_without_git_lfs_is_told_so(name, tmp_path):
    lay_out(tmp_path, robots.pointers()[name])
    with pytest.raises(FormatError, match="git lfs pull"):
        open_capture(tmp_path / name)
