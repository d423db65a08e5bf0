"""The map of all pictures and the maps of all but some: against maps made the plain way."""

import functools
import tempfile
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.captures import capture_maps as real
from r3jax.captures import neighborhoods
from r3jax.captures.capture_maps import Seen, integrate_rays, see
from r3jax.captures.settings import SurveySettings
from r3jax.captures.source import Source, source_of
from r3jax.captures.survey import RANGE, Survey, survey_of
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.recordings import read_recording
from r3jax.mapping.occupancy import centers_on_host, empty_grid, mark_free_ball
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.update import integrate
from tests.apps.audit.room import round_poses, write_colmap, write_recording

SETTINGS = SurveySettings(voxel_size=0.1)
NUM = 8


@functools.cache
def room() -> tuple[Source, Survey]:
    with tempfile.TemporaryDirectory() as name:
        folder = write_recording(Path(name) / "room", round_poses(NUM))
        source = source_of(read_recording(folder, "z"), "room")
        pictures = [source.read(i) for i in range(len(source))]
    source = Source(
        source.name, source.poses, source.lenses, source.labels, "depth", True, None, 1,
        pictures.__getitem__,
    )  # fmt: skip
    return source, survey_of(source, SETTINGS)


@functools.cache
def seen() -> Seen:
    return see(*room(), folds=4)


def plain(numbers) -> MapState:
    """The map of some pictures, one after the other."""
    source, survey = room()
    state = empty_map(1 << 15, survey.voxel_size)
    for i in numbers:
        state = integrate(state, source.frame(i, survey.alignment), RANGE)
    return state


def by_key(state: MapState) -> dict[tuple[int, int], tuple]:
    """What is known of each voxel that was measured, but for marks."""
    rows = np.flatnonzero(np.asarray(state.count) > 0)
    key = np.asarray(state.key)[:, rows].T.tolist()
    columns = (state.count, state.mean[0], state.mean[1], state.mean[2], state.m2)
    values = np.stack([np.asarray(x)[rows] for x in columns], axis=1)
    return {tuple(k): v for k, v in zip(key, values, strict=True)}


def assert_same(a: MapState, b: MapState) -> None:
    first, second = by_key(a), by_key(b)
    assert first.keys() == second.keys()
    for key, value in first.items():
        np.testing.assert_allclose(value, second[key], atol=2e-5)


def test_colors_and_counts_are_those_of_plain_integration():
    """Colors and counts are those of plain integration, of all and of all but a fold."""
    found = real.see(*room(), folds=4)
    assert_same(found.state, plain(range(NUM)))
    for fold in (0, 3):
        others = [i for i in range(NUM) if i % 4 != fold]
        assert_same(found.without(fold), plain(others))


def test_marks_leave_with_their_picture():
    """No mark comes from a picture that is left out, and none is missing."""
    found = real.see(*room(), folds=NUM)
    for fold in (1, 5):
        without, part = found.without(fold), found.folds[fold]
        union = np.asarray(without.visited) | np.asarray(part.visited)
        np.testing.assert_array_equal(union, found.state.visited)
        best = np.maximum(without.resolution, part.resolution)
        np.testing.assert_array_equal(best, found.state.resolution)
        only = np.asarray(part.visited) & ~np.asarray(without.visited)
        assert only.any()  # so the picture's own marks do leave with it
        # A picture marks one direction of a voxel.
        assert np.bitwise_count(np.asarray(part.visited)).sum(axis=0).max() == 1


def test_every_part_has_the_rows_of_the_whole():
    for part in seen().folds:
        np.testing.assert_array_equal(part.key, seen().state.key)
        assert int(part.dropped) == 0
    assert seen().fold_of.tolist() == [0, 1, 2, 3, 0, 1, 2, 3]


def test_the_order_of_the_pictures_does_not_matter():
    source, survey = room()
    order = [5, 2, 7, 0, 1, 6, 3, 4]
    turned = Source(
        source.name, source.poses[order], source.lenses, source.labels, "depth", True, None, 1,
        lambda i: source.read(order[i]),
    )  # fmt: skip
    other = see(turned, survey, folds=2)
    assert_same(other.state, seen().state)
    order_of = lambda state: np.lexsort(np.asarray(state.key)[:, np.asarray(state.occupied)])
    for name in ("visited", "resolution"):
        one, two = (
            np.asarray(getattr(s, name))[..., np.asarray(s.occupied)][..., order_of(s)]
            for s in (seen().state, other.state)
        )
        np.testing.assert_allclose(one, two, rtol=1e-6)


def test_the_camera_stands_in_free_space():
    source, _ = room()
    grid = seen().grid
    cells = np.floor((source.poses[:, :3, 3] - np.asarray(grid.origin)) / float(grid.cell_size))
    assert np.asarray(grid.free)[tuple(cells.astype(int).T)].all()


@given(st.integers(0, 100))
def test_cameras_free_the_space_round_them_as_one_after_the_other(seed):
    rng = np.random.default_rng(seed)
    grid = empty_grid(np.array([[0.0, 0.0, 0.0], [2.0, 1.4, 1.0]]), 0.2)
    odds = rng.uniform(-4.0, 4.0, grid.log_odds.shape).astype(np.float32)
    grid = one_by_one = eqx.tree_at(lambda g: g.log_odds, grid, jnp.asarray(odds))
    cameras = rng.uniform(-0.3, 2.2, (6, 3))
    for camera in cameras:
        one_by_one = mark_free_ball(one_by_one, jnp.asarray(camera, jnp.float32), real.MARGIN)
    found = real.free_round(grid, cameras)
    np.testing.assert_array_equal(found.log_odds, one_by_one.log_odds)


def test_voxels_that_are_far_too_small_are_refused(monkeypatch):
    source, survey = room()
    monkeypatch.setattr(real, "_MOST_ROWS", 1 << 10)
    monkeypatch.setattr(real, "_CAPACITY", 1 << 10)
    with pytest.raises(ValueError, match="larger --voxel-size"):
        see(source, survey, folds=2)


def test_a_place_of_too_many_voxels_is_mapped_in_larger_ones_unless_they_are_given(monkeypatch):
    source, survey = room()
    needed = int(see(source, survey, folds=2).state.num_occupied)
    monkeypatch.setattr(real, "_MOST_ROWS", 1 << (needed.bit_length() - 2))
    monkeypatch.setattr(real, "_CAPACITY", 1 << 5)
    tried: list[tuple[float, int]] = []

    def mapped(survey: Survey, on_frame: Callable[[], None]) -> Seen:
        tried.append((survey.voxel_size, 0))

        def counted() -> None:
            tried[-1] = tried[-1][0], tried[-1][1] + 1
            on_frame()

        return see(source, survey, 2, counted)

    fitting, found = real.in_fitting_voxels(survey, SurveySettings(), mapped)
    sizes, seen_images = zip(*tried, strict=True)
    assert float(found.state.voxel_size) == pytest.approx(fitting.voxel_size)
    assert fitting.voxel_size > survey.voxel_size
    assert int(found.state.num_occupied) <= real._MOST_ROWS
    assert seen_images[-1] == 2 * NUM
    for size, larger, images in zip(sizes, sizes[1:], seen_images, strict=False):
        assert larger == pytest.approx(size * max(1.5, (NUM / images) ** 0.5))
    with pytest.raises(ValueError, match="larger --voxel-size"):
        real.in_fitting_voxels(survey, SurveySettings(voxel_size=survey.voxel_size), mapped)


def test_neighborhoods_give_the_folds_and_marks_of_one_map(monkeypatch):
    (source, survey), whole = room(), seen()  # made before, or it would be cached as divided
    split = lambda eyes, max_range: [np.arange(len(eyes))[i::3] for i in range(3)]
    monkeypatch.setattr(real, "divided", split)
    monkeypatch.setattr(neighborhoods, "divided", split)
    found = see(source, survey, folds=4)
    np.testing.assert_array_equal(found.fold_of, whole.fold_of)
    np.testing.assert_allclose(found.grid.log_odds, whole.grid.log_odds, atol=1e-5)
    pairs = [(found.state, whole.state), *zip(found.folds, whole.folds, strict=True)]
    for a, b in pairs:
        assert_same(a, b)
        first, second = marks(a), marks(b)
        assert first.keys() == second.keys()
        for key, (words, resolution) in first.items():
            assert words == second[key][0]
            assert resolution == pytest.approx(second[key][1], rel=1e-5)


def marks(state: MapState) -> dict[tuple[int, int], tuple]:
    """From where each voxel was seen, and how sharply."""
    rows = np.flatnonzero(np.asarray(state.visited).any(axis=0))
    key, visited = (np.asarray(x)[:, rows].T.tolist() for x in (state.key, state.visited))
    sharp = np.asarray(state.resolution)[rows].tolist()
    return {tuple(k): v for k, *v in zip(key, visited, sharp, strict=True)}


def test_more_folds_than_pictures_leave_one_each():
    source, survey = room()
    found = see(source, survey, folds=99)
    assert len(found.folds) == NUM
    jax.tree.map(np.testing.assert_array_equal, found.state.key, seen().state.key)


@given(
    eye=st.tuples(*[st.floats(0.3, 1.7)] * 3),
    seed=st.integers(0, 99),
)
def test_rays_to_points_free_what_lies_before_them_and_nothing_else(eye, seed):
    """By the geometry alone: a cell that is freed lies near a ray, and none of them behind one."""
    rng = np.random.default_rng(seed)
    eye, points = np.array(eye), rng.uniform(0.0, 2.0, (6, 3))
    grid = integrate_rays(empty_grid(np.array([[0.0] * 3, [2.0] * 3]), 0.2), eye, points)
    centers = centers_on_host(grid, np.argwhere(np.asarray(grid.free)))
    offset = points - eye
    length = np.maximum(np.linalg.norm(offset, axis=1), 1e-9)
    along = np.einsum("cd,pd->cp", centers - eye, offset / length[:, None])
    nearest = eye + np.clip(along, 0, length)[..., None] * (offset / length[:, None])
    off = np.linalg.norm(centers[:, None] - nearest, axis=-1)
    assert (off.min(axis=1) <= 0.2 * np.sqrt(3) / 2 + 1e-6).all()
    holds = np.floor((points - np.asarray(grid.origin)) / 0.2).astype(int)
    assert not np.asarray(grid.free)[tuple(holds.T)].any()


def test_a_point_was_seen_by_the_images_of_its_track_and_by_no_other(tmp_path):
    """Against the tracks themselves: observations of voxels, and their directions."""
    poses = round_poses(NUM)
    model = read_colmap(write_colmap(tmp_path / "model", poses))
    source = source_of(model, "model")
    survey = survey_of(source, SurveySettings(voxel_size=1e-3))  # a voxel to each point
    found = see(source, survey, folds=4)
    tracks = np.bincount(model.points.seen_point, minlength=len(model.points))
    count = np.asarray(found.state.count)
    # Two points in one pixel are one, and some lie out of range; none are invented.
    pixels = sum(int((source.read(i)[1] > 0.0).sum()) for i in range(NUM))
    assert pixels <= tracks.sum()
    assert 0.9 * pixels <= count.sum() <= pixels
    bits = np.unpackbits(np.asarray(found.state.visited).view(np.uint8)).sum()
    assert bits <= count.sum()
    assert count.max() <= tracks.max()
    assert np.asarray(found.grid.free).any()
