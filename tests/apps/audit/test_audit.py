"""Whole audits of a room in which it is known what is wrong."""

import json
import re
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.apps.audit.audit import Audit, audit
from r3jax.apps.audit.audit_figures import _value_picture
from r3jax.apps.audit.audit_page import picture_faults
from r3jax.apps.audit.diagnosis import (
    CAUSES,
    FINE,
    NOT_KNOWN,
    Pictures,
    cause_of,
    demand_of,
    known_rows,
    view_score,
)
from r3jax.apps.audit.outputs import record_of, suggested_poses, write_outputs
from r3jax.apps.audit.sentences import (
    CONTRADICTED,
    method,
    saturation,
    state,
    verdict,
)
from r3jax.apps.audit.settings import AuditSettings
from r3jax.apps.audit.suggest import Task, _lacking
from r3jax.captures import capture_maps
from r3jax.captures.camera_paths import CameraPath
from r3jax.captures.source import Source, source_of
from r3jax.captures.survey import MARGIN, RANGE, survey_of
from r3jax.captures.vertical import Vertical
from r3jax.formats.colmap.reader import read_colmap
from r3jax.formats.errors import FormatError
from r3jax.formats.nerfstudio import read_transforms
from r3jax.formats.points import read_points
from r3jax.formats.recordings import read_recording
from r3jax.mapping.occupancy import centers_on_host
from tests.apps.audit.room import (
    LENS,
    SIZE,
    pose_at,
    round_poses,
    write_colmap,
    write_far_recording,
    write_nerfstudio,
    write_recording,
)

VOXEL = 0.15
SETTINGS = AuditSettings(voxel_size=VOXEL, views=3, folds=4, num_places=16, num_standpoints=8)
FEW_VIEWS = replace(SETTINGS, voxel_size=None, views=2, surfaces="points")
NO_VIEWS = replace(SETTINGS, views=0)


def corner_poses() -> np.ndarray:
    """All pictures from one corner of the room, towards the other half."""
    targets = [[4, y, z] for y in (0.5, 1.5, 2.5) for z in (0.4, 2.0)] + [[2, 0, 1.2], [2, 3, 1.2]]
    return np.stack([pose_at([0.5 + 0.05 * i, 0.6, 1.2], t) for i, t in enumerate(targets)])


@pytest.fixture(scope="module", autouse=True)
def _small_maps():
    """A room needs no more rows: everything else is three times as quick."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(capture_maps, "_CAPACITY", 1 << 13)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("captures")


@pytest.fixture(scope="module")
def corner(folder) -> Audit:
    recording = read_recording(write_recording(folder / "corner", corner_poses()), "z")
    return audit(source_of(recording, "corner"), SETTINGS)


@pytest.fixture(scope="module")
def cloud(folder) -> Audit:
    images = read_transforms(write_nerfstudio(folder / "cloud", round_poses(), depth=False))
    return audit(source_of(images, "cloud"), FEW_VIEWS)


def test_an_audit_in_coordinates_of_utm_says_so_and_comes_back_in_them(folder, tmp_path):
    far = np.array([500_000.0, 4_600_000.0, 100.0])
    recording = read_recording(write_far_recording(folder / "far", corner_poses(), far), "z")
    found = audit(source_of(recording, "far"), replace(SETTINGS, views=1))
    assert "was subtracted" in " ".join(method(found))
    written = write_outputs(found, tmp_path, tmp_path / "capture")
    points, _ = read_points(written["causes"])
    local = np.asarray(points, np.float64) - far
    to_wall = np.minimum(np.abs(local), np.abs(local - SIZE)).min(axis=1)
    assert len(local) > 500
    assert np.percentile(to_wall, 99) < VOXEL
    (eye,) = suggested_poses(found)[:, :3, 3] - far
    assert ((eye > 0.0) & (eye < SIZE)).all()


def centers(found: Audit) -> np.ndarray:
    return np.asarray(found.seen.state.center, float).T


def test_what_was_seen_from_one_side_only_is_seen_from_wrong_angles_or_from_afar(corner):
    found = corner.diagnosis
    evaluated = found.is_seen
    far = evaluated & (centers(corner)[:, 0] > 3.0)
    assert far.sum() > 100
    bad = far & (found.value < FINE)
    names = {CAUSES[i] for i in np.unique(found.cause[bad])}
    assert names <= {"angle", "rare", "distance"}
    assert found.share("noise") < 0.02  # nothing flickers there
    assert sum(found.share(cause) for cause in CAUSES) == pytest.approx(1.0)


def test_the_capture_ends_behind_its_cameras(corner):
    """Nobody looked back into the corner."""
    assert corner.unseen_area > 0.2
    assert any(region.center[0] < 1.6 for region in corner.unseen)
    total = sum(region.area for region in corner.unseen)
    assert 0 < total <= corner.unseen_area + 1e-6
    areas = [region.area for region in corner.unseen]
    assert areas[0] >= 0.5 * max(areas)


def test_suggested_views_are_in_the_open_and_promise_more_than_random_ones(corner):
    views = corner.plan.ranked
    assert len(views) == 3
    means = [corner.diagnosis.mean, *(view.mean_after for view in views)]
    assert (np.diff(means) >= -1e-6).all()  # an imagined view takes nothing away
    assert means[-1] > corner.plan.random_mean[-1]
    for view in views:
        eye = view.pose[:3, 3]
        assert (eye >= MARGIN - 0.02).all()
        assert (eye <= SIZE - MARGIN + 0.02).all()
        assert abs(view.pose[2, 0]) < 1e-6  # no roll
        assert view.gain >= 1


def changed(found: Audit, **of_survey) -> Audit:
    return replace(found, survey=replace(found.survey, **of_survey))


def test_the_verdict_says_what_speaks_against_the_numbers(corner, cloud):
    """What is not known, or not to be believed, is told with its number and what helps."""
    tilted = changed(cloud, up=Vertical(np.array([0.6, 0.0, 0.8]), 12.4))
    for sentences in (verdict, method):
        assert "12 degrees" in " ".join(sentences(tilted))
        assert "--up=0.60,0.00,0.80" in " ".join(sentences(tilted))
    one_place = changed(corner, span=0.05 * corner.survey.median_depth)
    assert record_of(one_place)["taken_from_one_place"]
    assert not any("%" in text for text in verdict(one_place))
    contradicted = replace(corner, faults=replace(corner.faults, findings=(), fits=False))
    assert CONTRADICTED in verdict(contradicted)
    assert picture_faults(contradicted)["remarks"] == [CONTRADICTED]
    remark = "2 of 3 pictures have a pose."
    assert verdict(replace(cloud, source=replace(cloud.source, remark=remark)))[0] == remark
    for value, is_saturated in ((0.95, True), (0.6, False)):
        frames = [replace(f, score=replace(f.score, renderability=value)) for f in corner.frames]
        said = " ".join(verdict(replace(corner, frames=tuple(frames))))
        assert (saturation() in said) == is_saturated


def test_only_what_is_known_can_say_that_a_capture_must_start_again(cloud):
    """A small object on a white table: most pixels have no depth, and the others are fine."""
    for fine, rare, said in ((0.2, 0.1, "gaps"), (0.05, 0.25, "again")):
        shares = dict.fromkeys(cloud.shares, 0.0) | {"fine": fine, "rare": rare, NOT_KNOWN: 0.7}
        frames = [replace(f, score=replace(f.score, shares=shares)) for f in cloud.frames]
        assert state(replace(cloud, frames=tuple(frames))) == said


def test_a_gain_is_what_all_surfaces_gain_together(corner):
    """Two ways to the same number: view by view, and standpoint by standpoint."""
    evaluated = corner.diagnosis.is_seen.sum()
    before = corner.diagnosis.mean
    for view in corner.plan.ranked:
        surfaces = (view.mean_after - before) * evaluated
        cells = float(corner.config.lambda1) * len(view.cells)
        # Voxels that are nearly perfect are left out of gains.
        assert view.gain == pytest.approx(surfaces + cells, rel=0.03, abs=0.5)
        before = view.mean_after


def test_places_are_searched_around_which_most_is_lacking(corner):
    state, grid = corner.seen.state, corner.seen.grid
    config = eqx.tree_at(lambda c: c.max_range, corner.config, jnp.float32(2.0))
    demand = demand_of(state, corner.standpoints, corner.config, np.asarray(state.present))
    task = Task(corner.lens.camera, demand, config)
    x, y, z = np.meshgrid(np.arange(0.2, 4.0, 0.2), np.arange(0.2, 3.0, 0.2), [0.8, 1.6])
    places = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
    chosen = _lacking(state, grid, task, places, 20)
    diagnosis = task.evaluate(state)[1]
    surfaces = np.asarray(state.center, np.float64).T[diagnosis.is_seen]
    cells = centers_on_host(grid, np.argwhere(np.asarray(grid.unexplored)))
    gap = lambda points: np.linalg.norm(points[None] - places[:, None], axis=2)
    lacks = ((gap(surfaces) <= 2.0) * (1.0 - diagnosis.value[diagnosis.is_seen])).sum(axis=1)
    lacks += float(config.lambda1) * (gap(cells) <= 2.0).sum(axis=1)
    # Cubes of a meter are counted, not voxels.
    assert lacks[chosen].min() > np.percentile(lacks, 80)
    assert len(np.unique(chosen)) == 20


def test_regions_hold_bad_voxels_and_do_not_overlap(corner):
    found = corner.diagnosis
    rows = [region.rows for region in corner.regions]
    assert len(rows) > 1
    joined = np.concatenate(rows)
    assert len(np.unique(joined)) == len(joined)
    assert (found.value[joined] < FINE).all()
    for region in corner.regions:
        place = centers(corner)[region.rows]
        assert (np.ptp(place, axis=0) <= 1.0 + VOXEL).all()
        assert region.area == pytest.approx(len(region.rows) * VOXEL**2, rel=1e-3)
        assert 0 < region.bad_share <= 1
    losses = [((1 - found.value)[r]).sum() for r in rows]
    assert losses == sorted(losses, reverse=True)


def test_own_frames_are_judged_without_themselves(corner):
    poses = corner.source.poses
    path = CameraPath(poses, (LENS,) * len(poses))
    whole = audit(corner.source, NO_VIEWS, path)
    assert not whole.is_own_path
    assert len(whole.frames) == len(corner.frames) == len(poses)
    assert (whole.renderability >= corner.renderability - 1e-6).all()
    assert whole.renderability.mean() > corner.renderability.mean() + 0.02
    assert whole.plan.views == ()
    np.testing.assert_allclose(whole.renderability.max(), 1.0, atol=0.2)


def test_colors_that_contradict_are_noise(corner):
    rng = np.random.default_rng(0)
    gains = rng.uniform(0.3, 1.7, len(corner.source))

    def flickering(index):
        rgb, depth = corner.source.read(index)
        return np.clip(rgb * gains[index], 0, 255).astype(np.uint8), depth

    changed = replace(corner.source, read=flickering)
    found = audit(changed, NO_VIEWS)
    assert found.diagnosis.noise[found.diagnosis.is_seen].mean() < 0.9
    calm = corner.diagnosis.noise[corner.diagnosis.is_seen].mean()
    assert calm > 0.97
    assert found.diagnosis.share("noise") > 0.05


def test_the_dearest_term_is_the_cause():
    value = np.array([0.9, 0.1, 0.1, 0.1, 0.1])
    costs = np.array([[9, 5, 5, 1, 1], [1, 1, 1, 5, 1], [1, 1, 1, 1, 5]], float)
    directions = np.array([9, 9, 2, 1, 1])
    found = [CAUSES[i] for i in cause_of(value, costs, directions)]
    assert found == ["fine", "angle", "rare", "noise", "distance"]


def test_units_and_axes_of_a_capture_change_nothing_but_the_coordinates(cloud, folder):
    """The same room in units of 4 cm, lying on its side: the same frames, the same views."""
    side = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    poses = cloud.source.poses.copy()
    poses[:, :3, :3] = side @ poses[:, :3, :3]
    poses[:, :3, 3] = 25.0 * poses[:, :3, 3] @ side.T

    def read(index):
        rgb, depth = cloud.source.read(index)
        return rgb, depth * 25.0

    turned = replace(cloud.source, poses=poses, read=read)
    other = audit(turned, FEW_VIEWS)
    assert other.survey.unit == "u"
    assert other.survey.median_depth == pytest.approx(25 * cloud.survey.median_depth, rel=1e-5)
    np.testing.assert_allclose(other.renderability, cloud.renderability, atol=0.03)
    assert other.diagnosis.mean == pytest.approx(cloud.diagnosis.mean, abs=0.03)
    first = suggested_poses(other)[0][:3, 3] / 25.0 @ side
    assert ((first > 0) & (first < SIZE)).all()


def test_a_cloud_without_depth_has_no_free_space_and_stays_among_its_cameras(cloud):
    assert cloud.survey.unit == "u"
    assert cloud.unseen == ()
    assert cloud.unseen_area == 0.0
    cameras = cloud.survey.alignment.points(cloud.source.poses[:, :3, 3])
    for view in cloud.plan.views:
        gap = np.linalg.norm(cameras - view.pose[:3, 3], axis=1).min()
        assert gap < 1.2 * cloud.survey.alignment.scale
    walls = cloud.survey.alignment.points_back(
        centers(cloud)[np.asarray(cloud.seen.state.occupied)]
    )
    off = np.minimum(np.abs(walls), np.abs(walls - SIZE)).min(axis=1)
    # The map is the room, to the size of a voxel.
    assert np.median(off) < 0.6 * cloud.survey.length(cloud.survey.voxel_size)


def test_tracks_of_a_model_are_as_good_as_a_cloud(folder, cloud):
    images = read_colmap(write_colmap(folder / "model", round_poses()))
    source = source_of(images, "model")
    assert (source.kind, source.is_metric, source.has_images) == ("tracks", False, True)
    found = audit(source, replace(FEW_VIEWS, views=0))
    np.testing.assert_allclose(found.renderability, cloud.renderability, atol=0.15)
    assert found.diagnosis.fine_share > 0.3


def test_without_depth_images_what_no_point_shows_is_not_known(cloud, corner):
    """One measure for the headline and the frames: nothing is fine that no pixel shows."""
    shares = cloud.shares
    assert shares.keys() == {*CAUSES, "unseen", NOT_KNOWN}
    assert 0.0 < shares[NOT_KNOWN] < 1.0
    said = " ".join(verdict(cloud))
    assert re.search(rf"\b{100 * shares['fine']:.0f}\s% of the pixels", said)
    assert re.search(rf"\b{100 * shares[NOT_KNOWN]:.0f}\s% is not known", said)
    assert "not known" not in " ".join(verdict(corner))


@pytest.mark.parametrize("name", ["corner", "cloud"])
def test_no_two_numbers_of_an_audit_contradict_each_other(name, request):
    """Shares sum to 1 everywhere; the mean over frames is that of their pixels."""
    found: Audit = request.getfixturevalue(name)
    record = record_of(found)
    path, surfaces = record["path"], record["surfaces"]
    scores = path["frames"]
    for share in (path["share"], surfaces["share"], *(score["shares"] for score in scores)):
        assert sum(share.values()) == pytest.approx(1.0)
        assert min(share.values()) >= 0.0
    for cause in path["share"]:
        mean = np.mean([score["shares"][cause] for score in scores])
        assert path["share"][cause] == pytest.approx(mean)
    covered = np.array([score["coverage"] for score in scores])
    of_pixels = [score["renderability"] for score in scores]
    if found.source.is_complete:
        assert NOT_KNOWN not in path["share"]
        assert path["mean"] == pytest.approx(np.mean(of_pixels))
        return
    assert surfaces["share"] == path["share"]
    judged = covered + [s["shares"]["unseen"] for s in scores]
    np.testing.assert_allclose([s["shares"][NOT_KNOWN] for s in scores], 1.0 - judged, atol=1e-6)
    assert path["mean"] == pytest.approx(np.average(of_pixels, weights=judged))
    # What is fine has R of FINE or more, and the rest has less: the mean lies between.
    fine = path["share"]["fine"] / (1.0 - path["share"][NOT_KNOWN])
    assert fine * FINE <= path["mean"] <= fine + (1.0 - fine) * FINE


def test_a_frame_of_which_nothing_is_known_has_no_number(cloud):
    away = np.eye(4)
    away[:3, 3] = 100.0
    known = known_rows(cloud.seen.state, is_complete=False)
    pictures = Pictures(known, [cloud.camera], away[None])
    score = view_score(cloud.seen.state, cloud.camera, away, cloud.config, pictures)
    assert (score.cause, score.coverage) == (NOT_KNOWN, 0.0)
    assert np.isnan(score.renderability)
    blank = replace(cloud.frames[0], score=score)
    found = replace(cloud, frames=(blank, *cloud.frames[1:]))
    assert record_of(found)["path"]["frames"][0]["renderability"] is None
    assert "nan" not in " ".join(verdict(found))
    json.dumps(record_of(found), allow_nan=False)


def test_pixels_that_no_picture_can_show_are_unseen_and_count_0(cloud):
    known, pose = known_rows(cloud.seen.state, is_complete=False), cloud.frames[0].pose
    by = lambda poses, depth=None: view_score(
        cloud.seen.state,
        cloud.camera,
        pose,
        cloud.config,
        Pictures(known, [cloud.camera] * len(poses), np.reshape(poses, (-1, 4, 4))),
        depth,
    )
    alone, shown = by([]), by([pose])
    assert by([pose], np.full((4, 3), 1.1 * RANGE)).shares == pytest.approx(alone.shares)
    assert 0.0 < alone.coverage < 1.0
    assert alone.shares["unseen"] == pytest.approx(1.0 - alone.coverage)
    assert (alone.shares[NOT_KNOWN], shown.shares["unseen"]) == (0.0, 0.0)
    assert alone.renderability == pytest.approx(shown.renderability * alone.coverage)
    for score in (alone, shown):
        assert sum(score.shares.values()) == pytest.approx(1.0)


def test_pictures_without_a_point_are_not_known_either(cloud):
    blank = replace(cloud.faults, without_depth=(3, 5, 7, 9))
    fewer = replace(cloud, faults=blank)
    known = 1.0 - cloud.shares[NOT_KNOWN]
    assert 1.0 - fewer.shares[NOT_KNOWN] == pytest.approx(known * 16 / 20)
    assert sum(fewer.shares.values()) == pytest.approx(1.0)


def test_what_cannot_be_read_and_what_has_no_depth_is_left_out_and_said(folder):
    path = write_nerfstudio(folder / "partly", round_poses(12), depth=True)
    content = json.loads((path / "transforms.json").read_text())
    for frame in content["frames"][8:]:
        del frame["depth_file_path"]
    (path / "transforms.json").write_text(json.dumps(content))
    (path / "images" / "002.png").unlink()
    found = audit(source_of(read_transforms(path), "partly"), NO_VIEWS)
    assert found.survey.chosen.tolist() == [0, 1, 3, 4, 5, 6, 7]
    assert len(found.frames) == 7
    first, second, *_ = verdict(found)
    for fact in ("1 of the 12", "002.png"):
        assert fact in first
    assert "4 of the 11" in second
    record = record_of(found)
    assert [entry["index"] for entry in record["pictures_left_out"]] == [2]
    assert record["pictures_without_depth"] == [8, 9, 10, 11]


def test_a_model_without_images_is_audited_by_its_points(folder):
    path = write_colmap(folder / "bare", round_poses(8))
    for image in (path / "images").iterdir():
        image.unlink()
    source = source_of(read_colmap(path), "bare")
    assert not source.has_images
    found = audit(source, replace(FEW_VIEWS, views=0))
    assert found.diagnosis.share("noise") == 0.0
    assert "noise" in method(found)[-1]
    assert verdict(found)[0].startswith("None of the 8 pictures was found")
    (remark,) = picture_faults(found)["remarks"]
    assert "sharp" not in remark
    assert "consistent with" not in remark


def test_everything_written_is_in_the_captures_coordinates(cloud, tmp_path):
    written = write_outputs(cloud, tmp_path, tmp_path / "capture")
    poses = suggested_poses(cloud)
    images = read_transforms(written["transforms"])
    np.testing.assert_array_equal(images.poses, poses)
    assert images.lenses[0].params == LENS.params
    for pose in poses:
        assert ((pose[:3, 3] > 0) & (pose[:3, 3] < SIZE)).all()
    for name in ("renderability", "causes"):
        points, _ = read_points(written[name])
        off = np.minimum(np.abs(points), np.abs(points - SIZE)).min(axis=1)
        assert np.median(off) < 0.6 * cloud.survey.length(cloud.survey.voxel_size)
    record = record_of(cloud)
    assert len(record["path"]["frames"]) == 16
    assert record["surfaces"]["share"].keys() == {*CAUSES, "unseen", NOT_KNOWN}
    assert record["up"] == [0.0, 0.0, 1.0]


def one_picture(depth: np.ndarray) -> Source:
    rgb = np.zeros((36, 48, 3), np.uint8)
    return Source("one", np.eye(4)[None], (LENS,), ("a",), "depth", True, None, 1,
                  lambda index: (rgb, depth))  # fmt: skip


def test_a_raster_does_not_grow_with_the_place(corner):
    """Voxels of 2 mm in a room 5 m wide would be a picture of 6 million pixels, and so on."""
    small, _ = _value_picture(corner, 1.2)
    tiny = replace(corner.survey, voxel_size=1e-7)
    large, extent = _value_picture(replace(corner, survey=tiny), 1.2)
    assert max(large.shape) <= 2001
    assert extent[1] - extent[0] == pytest.approx(SIZE[0], abs=0.4)
    assert np.nanmean(large) == pytest.approx(np.nanmean(small), abs=0.1)


def test_a_capture_without_any_depth_is_refused():
    with pytest.raises(FormatError):
        survey_of(one_picture(np.zeros((36, 48), np.float32)), AuditSettings())


@pytest.mark.parametrize(
    ("depth", "range_in_meters"), [(3.0, 5.0), (20.0, 20.0), (0.5, 1.25), (4.9, 5.0)]
)
def test_a_capture_of_a_rooms_size_stays_as_it_is_and_others_are_scaled(depth, range_in_meters):
    survey = survey_of(one_picture(np.full((36, 48), depth, np.float32)), AuditSettings(up="-y"))
    assert survey.length(5.0) == pytest.approx(range_in_meters)
    assert survey.alignment.scale == pytest.approx(5.0 / range_in_meters)
    assert survey.length(survey.voxel_size) >= 0.01 * range_in_meters


@pytest.mark.parametrize(("depth", "factor"), [(2000.0, "0.001"), (0.002, "1000")])
def test_a_median_depth_that_no_room_has_is_refused_with_the_factor_unless_it_is_meant(
    depth, factor
):
    source = one_picture(np.full((36, 48), depth, np.float32))
    with pytest.raises(ValueError, match=rf"--depth-scale {factor} "):
        survey_of(source, AuditSettings())
    survey = survey_of(source, AuditSettings(up="-y", trust_depth=True))
    assert survey.median_depth == pytest.approx(depth)
    assert survey.doubt is not None


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"voxel_size": 0.0}, "--voxel-size"),
        ({"voxel_size": 5.0}, "--voxel-size"),
        ({"max_range": float("nan")}, "--max-range"),
        ({"max_range": 5000.0}, "--max-range 5000"),
        ({"views": -1}, "--views"),
        ({"views": 10**9}, "--views"),
        ({"folds": 1}, "--folds .* 2"),
        ({"max_frames": 0}, "--max-frames .* 2"),
        ({"seed": -1}, "--seed"),
        ({"up": "w"}, "--up"),
    ],
)
def test_wishes_without_sense_are_named(settings, named):
    with pytest.raises(ValueError, match=named):
        survey_of(one_picture(np.ones((36, 48), np.float32)), AuditSettings(**settings))
