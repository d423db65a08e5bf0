"""Which surfaces a capture without depth gets."""

import dataclasses

import numpy as np

from r3jax.captures import surfaces
from r3jax.captures.source import source_of
from r3jax.captures.surfaces import with_surfaces
from r3jax.formats.captures import open_capture
from tests.apps.audit.room import HEIGHT, WIDTH, picture, round_poses, write_colmap


def test_pixels_that_masks_hide_need_no_depth(tmp_path, monkeypatch):
    poses = round_poses(6)
    source = source_of(open_capture(write_colmap(tmp_path, poses)).source, "room")
    photograph = source.photograph
    assert photograph is not None
    is_shown = np.zeros((HEIGHT, WIDTH), dtype=bool)
    is_shown[: HEIGHT // 12] = True  # 8 % of the pixels
    swept = [np.where(is_shown, picture(pose)[1], 0.0).astype(np.float32) for pose in poses]
    monkeypatch.setattr(surfaces, "sweep", lambda photos, points, on_photo: swept)
    assert with_surfaces(source).kind == "tracks"

    def masked(index: int, stride: int):
        rgb, gray = photograph(index, stride)
        return rgb, gray * is_shown

    assert with_surfaces(dataclasses.replace(source, photograph=masked)).kind == "sweep"
