"""COLMAP's own library reads what we write, and we read what it writes."""

import dataclasses

import numpy as np
import pytest

from r3jax.formats.colmap.binary import read_binary, write_binary
from r3jax.formats.colmap.model import ColmapModel, points_without_tracks, pose_of
from r3jax.formats.colmap.reader import read_colmap, read_model, reconstruction_of
from r3jax.formats.colmap.text import read_text, write_text
from r3jax.formats.exports import posed_model
from r3jax.formats.lenses import MODELS, Lens
from tests.formats.colmap_models import assert_equal, random_pose

pytestmark = pytest.mark.full

pycolmap = pytest.importorskip("pycolmap")

WAYS = {"binary": (write_binary, read_binary), "text": (write_text, read_text)}


@pytest.fixture(scope="module")
def theirs():
    """Two rigs of two cameras, posed as rigs and frames: COLMAP 3.12 and later."""
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs, options.num_cameras_per_rig = 2, 2
    options.num_frames_per_rig, options.num_points3D = 3, 20
    options.sensor_from_rig_translation_stddev = 0.1
    options.sensor_from_rig_rotation_stddev = 5.0
    pycolmap.set_random_seed(0)
    return pycolmap.synthesize_dataset(options)


def our_model() -> ColmapModel:
    rng = np.random.default_rng(0)
    lens = Lens("PINHOLE", 64, 48, (70.125, 71.3, 1 / 3 + 32, 24.5))
    poses = np.stack([random_pose(seed) for seed in range(6)])
    points = points_without_tracks(
        rng.normal(size=(7, 3)), rng.integers(0, 256, (7, 3), dtype=np.uint8)
    )
    return posed_model(lens, [f"{i:06d}.png" for i in range(6)], poses, points)


def assert_agree(theirs, ours: ColmapModel) -> None:
    """Their reconstruction says what our model says, through their own accessors."""
    assert sorted(theirs.cameras) == sorted(ours.cameras)
    for number, lens in ours.cameras.items():
        camera = theirs.cameras[number]
        assert camera.model.name == lens.model
        assert (camera.width, camera.height) == (lens.width, lens.height)
        np.testing.assert_allclose(camera.params, lens.params, rtol=1e-15)
    assert sorted(theirs.images) == sorted(image.id for image in ours.images)
    for image in ours.images:
        other = theirs.images[image.id]
        assert (other.name, other.camera_id) == (image.name, image.camera_id)
        T = pose_of(image.quaternion, image.translation)
        np.testing.assert_allclose(other.projection_center(), T[:3, 3], atol=1e-9)
        np.testing.assert_allclose(other.viewing_direction(), T[:3, 2], atol=1e-9)
        matrix = other.cam_from_world().matrix()
        np.testing.assert_allclose(matrix, np.linalg.inv(T)[:3], atol=1e-9)
        np.testing.assert_allclose([p.xy for p in other.points2D], image.keypoints.tolist())
    points = ours.points
    assert sorted(theirs.points3D) == sorted(points.ids.tolist())
    starts = np.cumsum(points.track_lengths) - points.track_lengths
    for i, number in enumerate(points.ids.tolist()):
        other = theirs.points3D[number]
        np.testing.assert_allclose(other.xyz, points.xyz[i], rtol=1e-15)
        np.testing.assert_array_equal(other.color, points.rgb[i])
        track = slice(starts[i], starts[i] + points.track_lengths[i])
        expected = zip(points.track_images[track], points.track_keypoints[track], strict=True)
        found = [(e.image_id, e.point2D_idx) for e in other.track.elements]
        assert sorted(found) == sorted((int(a), int(b)) for a, b in expected)


@pytest.mark.parametrize("way", WAYS)
def test_colmap_reads_what_we_write(tmp_path, way):
    WAYS[way][0](tmp_path, our_model())
    assert_agree(pycolmap.Reconstruction(str(tmp_path)), our_model())


def test_a_point_falls_on_the_same_pixel(tmp_path):
    """Camera, pose and pixel convention at once: their projection against ours."""
    write_binary(tmp_path, our_model())
    theirs, ours = pycolmap.Reconstruction(str(tmp_path)), read_colmap(tmp_path)
    for i, image in enumerate(our_model().images):
        T = ours.poses[i]
        fx, fy, cx, cy = ours.lenses[i].intrinsics
        x, y, z = 0.4, -0.3, 2.0
        world = T[:3, :3] @ [x, y, z] + T[:3, 3]
        found = theirs.images[image.id].project_point(world)
        np.testing.assert_allclose(found, [fx * x / z + cx, fy * y / z + cy], atol=1e-6)


@pytest.mark.parametrize("way", WAYS)
def test_we_read_what_colmap_writes(tmp_path, theirs, way):
    (theirs.write_binary if way == "binary" else theirs.write_text)(str(tmp_path))
    suffix = ".bin" if way == "binary" else ".txt"
    assert (tmp_path / f"rigs{suffix}").exists()
    assert_agree(theirs, read_model(tmp_path))


@pytest.mark.parametrize("way", WAYS)
def test_a_model_without_rigs_goes_through_colmap_unchanged(tmp_path, theirs, way):
    """Read by us, written by us without rigs and frames, read by COLMAP."""
    theirs.write_binary(str(tmp_path))
    ours = read_model(tmp_path)
    for name in ("again", "back"):
        (tmp_path / name).mkdir()
    write, read = WAYS[way]
    write(tmp_path / "again", ours)
    assert_equal(read(tmp_path / "again"), ours)
    assert_agree(pycolmap.Reconstruction(str(tmp_path / "again")), ours)


def test_which_image_sees_which_point(tmp_path, theirs):
    theirs.write_binary(str(tmp_path))
    images = read_colmap(tmp_path)
    assert images.points is not None
    by_name = {image.name: image for image in theirs.images.values()}
    for i, path in enumerate(images.image_paths):
        keypoints = by_name[path.name].points2D
        expected = {p.point3D_id for p in keypoints if p.has_point3D()}
        positions = {tuple(images.points.xyz[j]) for j in images.points.seen_by(i)}
        assert positions == {tuple(theirs.points3D[number].xyz) for number in expected}
        assert len(expected) > 0


def test_names_with_blanks_survive_in_binary(tmp_path):
    model = our_model()
    renamed = tuple(
        dataclasses.replace(image, name=f"a folder/{image.name}") for image in model.images
    )
    model = dataclasses.replace(model, images=renamed)
    write_binary(tmp_path, model)
    assert_agree(pycolmap.Reconstruction(str(tmp_path)), model)


@pytest.mark.parametrize("model", [name for name, (number, _) in MODELS.items() if number >= 0])
def test_every_camera_model_has_colmaps_number_and_parameters(model):
    number, names = MODELS[model]
    camera = pycolmap.Camera.create_from_model_name(1, model, 100.0, 64, 32)
    assert int(camera.model) == number
    assert camera.params_info.replace(" ", "").split(",") == list(names)
    lens = Lens(model, 64, 32, tuple(camera.params))
    if lens.is_panorama:  # COLMAP knows no focal length of it
        return
    np.testing.assert_allclose(
        [camera.focal_length_x, camera.focal_length_y]
        if len(camera.focal_length_idxs()) == 2
        else [camera.focal_length] * 2,
        lens.intrinsics[:2],
    )
    principal = camera.principal_point_x, camera.principal_point_y
    assert principal == lens.intrinsics[2:]


def test_the_numbers_of_a_reconstruction_are_colmaps(shared):
    folder = shared("recordings", "lounge_sfm", "sparse", "3")
    ours = reconstruction_of(read_model(folder), unposed=27)
    theirs = pycolmap.Reconstruction(folder)
    assert (ours.posed, ours.pictures) == (theirs.num_reg_images(), theirs.num_reg_images() + 27)
    assert ours.track_length == pytest.approx(theirs.compute_mean_track_length())
    errors = [point.error for point in theirs.points3D.values()]
    assert ours.error_median == pytest.approx(np.median(errors))
    assert ours.error_p95 == pytest.approx(np.percentile(errors, 95))
    angles = []
    for point in theirs.points3D.values():
        centers = [theirs.images[e.image_id].projection_center() for e in point.track.elements]
        rays = [point.xyz - center for center in centers]
        rays = [ray / np.linalg.norm(ray) for ray in rays]
        cosines = [a @ b for i, a in enumerate(rays) for b in rays[:i]]
        angles.append(np.degrees(np.arccos(np.clip(min(cosines), -1, 1))))
    assert ours.angle == pytest.approx(np.median(angles))
