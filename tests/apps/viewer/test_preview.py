"""A look says what the public functions say of the same pose."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.apps.viewer.drawing import (
    TERMS,
    Context,
    paint,
    preview_from,
    preview_pictures,
    quick_preview_from,
)
from r3jax.apps.viewer.story import Timeline
from r3jax.geometry.cameras import pose_along
from r3jax.splatting.scene import GaussianScene


@pytest.fixture(scope="module")
def around(run):
    moment = Timeline(run).at(len(run.rows) - 1)
    return Context(moment.map_state, moment.grid, run.camera)


@pytest.fixture(scope="module")
def pose(run):
    position = run.rows[0].pose[:3, 3] + np.array([0.2, -0.1, 0.1], np.float32)
    return np.asarray(pose_along(position, np.array([0.9, 0.3, -0.2])), np.float64)


@pytest.fixture(scope="module")
def look(around, pose):
    return preview_from(around, pose)


def test_renderability_is_that_of_the_public_function(around, look):
    T = jnp.asarray(look.T_world_camera, jnp.float32)
    expected = float(r3jax.renderability(around.map_state, around.camera, T))
    assert 0.0 < expected < 1.0
    assert look.glance.renderability == pytest.approx(expected, abs=1e-6)
    image = np.asarray(r3jax.renderability_image(around.map_state, around.camera, T))
    np.testing.assert_allclose(np.nan_to_num(look.glance.images["renderability"]), image, atol=1e-6)


def test_the_terms_multiply_to_renderability(look):
    value, bias, noise, resolution = (look.glance.images[name] for name in TERMS)
    np.testing.assert_allclose(value, bias * noise * resolution, atol=1e-5)


def test_means_count_pixels_without_a_voxel_as_nothing(look):
    for name in TERMS:
        image = look.glance.images[name]
        assert look.glance.means[name] == pytest.approx(np.nansum(image) / image.size, abs=1e-5)
        assert look.glance.seen == pytest.approx(np.mean(~np.isnan(image)))


def test_utility_and_panorama_are_those_of_the_public_functions(around, look):
    T = jnp.asarray(look.T_world_camera, jnp.float32)
    state, grid, camera = around.map_state, around.grid, around.camera
    utility = r3jax.view_utility(state, grid, camera, T)
    assert look.exploration == pytest.approx(float(utility.exploration))
    assert look.rendering == pytest.approx(float(utility.rendering), rel=1e-5)
    panorama = r3jax.panorama(state, grid, camera, T[:3, 3])
    np.testing.assert_allclose(look.direction_scores, panorama.direction_scores, rtol=1e-5)
    best = int(np.argmax(look.direction_scores))
    np.testing.assert_allclose(
        look.best_direction, r3jax.geometry.sphere.fibonacci_lattice(526)[best], atol=1e-6
    )


def test_the_suggestion_looks_along_the_best_direction_from_the_same_place(look):
    np.testing.assert_allclose(look.T_suggested[:3, 3], look.T_world_camera[:3, 3], atol=1e-6)
    np.testing.assert_allclose(look.T_suggested[:3, 2], look.best_direction, atol=1e-5)


def test_a_view_of_nothing_known_has_no_renderability(around, pose):
    away = pose.copy()
    away[:3, 3] += 100.0
    glance = quick_preview_from(around, away)
    assert (glance.renderability, glance.seen) == (0.0, 0.0)
    assert np.isnan(glance.images["bias"]).all()


def test_splats_are_of_the_same_pose_and_compared_with_the_true_image(around, pose):
    model = GaussianScene(
        means=jnp.asarray(pose[None, :3, 3] + pose[None, :3, 2], jnp.float32),
        quats=jnp.asarray([[1.0, 0.0, 0.0, 0.0]]),
        log_scales=jnp.full((1, 3), -2.0),
        opacity_logits=jnp.asarray([4.0]),
        sh=jnp.full((1, 1, 3), 1.0),
    )
    camera = around.camera.resized(16, 16)
    more = Context(
        around.map_state,
        around.grid,
        around.camera,
        picture_camera=camera,
        model=model,
        background=(0.0, 1.0, 0.0),
    )
    look = preview_from(more, pose)
    expected = r3jax.render(
        model, camera, jnp.asarray(pose, jnp.float32), jnp.asarray([0.0, 1.0, 0.0])
    )
    assert look.splats is not None
    np.testing.assert_allclose(look.splats, np.asarray(expected.rgb).clip(0.0, 1.0), atol=1e-6)
    assert look.splats[8, 8, 0] > 0.3  # the Gaussian stands right ahead
    assert look.splats[0, 0].tolist() == pytest.approx([0.0, 1.0, 0.0], abs=0.05)
    names = [name for name, _ in preview_pictures(look)]
    assert names == ["renderability", "splats"]
    seen = dataclasses.replace(look, truth=np.asarray(look.splats))
    (_, error), *others = preview_pictures(seen, "bias")[::-1]
    assert [name for name, _ in others[::-1]] == ["bias", "splats", "true image"]
    assert (error == paint(np.ones(1))).all()  # no error is green
