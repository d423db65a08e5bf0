"""Shapes enclose their volume with the front outside; fields and textures tile."""

import numpy as np
import pytest

from r3jax.errors import InputError
from r3jax.simulators.scenes.procedural import shapes
from r3jax.simulators.scenes.procedural.materials import textures
from r3jax.simulators.scenes.procedural.materials.textures import cloud
from r3jax.simulators.scenes.procedural.model import Finish, Model
from r3jax.simulators.world import Material


def volume(shape: shapes.Shape) -> float:
    """Signed volume by the divergence theorem: positive where fronts face outwards [m3]."""
    a, b, c = shape.corners[:, 0], shape.corners[:, 1], shape.corners[:, 2]
    return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0)


def test_a_box_has_its_volume_however_it_is_cut():
    low, high = (1.0, -2.0, 0.5), (1.7, -1.5, 2.5)
    assert volume(shapes.box(low, high)) == pytest.approx(0.7, rel=1e-9)
    assert volume(shapes.box(low, high, upright=True, step=0.3)) == pytest.approx(0.7, rel=1e-9)


def test_a_flat_box_is_refused():
    with pytest.raises(InputError):
        shapes.box((0, 0, 0), (1, 0, 1))


def test_round_solids_come_close_to_theirs():
    exact = np.pi * 0.25 * 2.0
    assert 0.97 * exact < volume(shapes.cylinder(0.5, 1.0, 3.0, 24)) < exact
    exact = 4.0 / 3.0 * np.pi * 0.3 * 0.4 * 0.5
    assert 0.95 * exact < volume(shapes.ball((0.3, 0.4, 0.5), 32, 24)) < exact
    block = volume(shapes.cushion((0, 0, 0), (0.6, 0.5, 0.2)))
    assert 0.6 * 0.06 < block < 0.06  # softer than its box, fuller than an ellipsoid
    assert block > np.pi / 6 * 0.06


def test_turning_and_moving_keep_size_and_side():
    shape = shapes.cylinder(0.2, 0.0, 1.0).turned(70.0, "x").turned(-30.0, "y").moved(3.0, 2.0, 1.0)
    assert volume(shape) == pytest.approx(volume(shapes.cylinder(0.2, 0.0, 1.0)), rel=1e-9)


def test_panels_and_discs_face_forward():
    for shape in (shapes.panel(0.3, 1.0, 0.5, 0.4), shapes.disc(0.2)):
        edges = shape.corners[:, 1:] - shape.corners[:, :1]
        normal = np.cross(edges[:, 0], edges[:, 1])
        assert np.all(normal[:, 1] > 0)
        assert np.allclose(normal[:, [0, 2]], 0.0)


def test_pictures_are_not_mirrored():
    """Seen from the front (+y), x runs to the left: u must fall with x, and v rise with z."""
    for shape in (shapes.panel(0.0, 0.0, 1.0, 1.0), shapes.disc(0.5)):
        x, z = shape.corners[..., 0].ravel(), shape.corners[..., 2].ravel()
        u, v = shape.uv[..., 0].ravel(), shape.uv[..., 1].ravel()
        assert np.allclose(u + x, (u + x)[0])
        assert np.allclose(v - z, (v - z)[0])


@pytest.mark.parametrize(
    ("heading", "front"), [("n", (0, 1)), ("e", (1, 0)), ("s", (0, -1)), ("w", (-1, 0))]
)
def test_furniture_faces_where_it_is_told(heading, front):
    finish = Finish(Material(), (1.0, 1.0))
    chair = Model().add(shapes.box((-0.1, 1.0, 0.0), (0.1, 1.2, 0.3)), finish)
    placed = Model().put(chair, 5.0, 7.0, 0.0, heading)
    middle = placed.pieces[0].corners.reshape(-1, 3).mean(axis=0)
    assert np.allclose(middle[:2], np.array([5.0, 7.0]) + 1.1 * np.array(front), atol=1e-9)


def test_fields_are_normal_and_repeat_without_a_seam():
    field = cloud(128, 192, 5, 1.4, 2.0)
    assert field.shape == (128, 192)
    assert abs(float(field.mean())) < 1e-4
    assert float(field.std()) == pytest.approx(1.0, abs=1e-3)
    inside = np.abs(np.diff(field, axis=0)).mean()
    assert np.abs(field[0] - field[-1]).mean() < 1.5 * inside


@pytest.mark.parametrize(
    "texture",
    [
        lambda: textures.plaster((0.8, 0.8, 0.7), 3),
        lambda: textures.wood((0.7, 0.5, 0.3), 4),
        lambda: textures.marble((0.9, 0.9, 0.9), (0.4, 0.4, 0.4), 5),
        lambda: textures.terrazzo((0.8, 0.8, 0.7), ((0.5, 0.3, 0.2),), 6),
        lambda: textures.wallpaper(
            (0.9, 0.9, 0.8), ((0.4, 0.5, 0.4), (0.7, 0.5, 0.4)), "botanical", 7
        ),
    ],
    ids=["plaster", "wood", "marble", "terrazzo", "wallpaper"],
)
def test_textures_repeat_without_a_seam(texture):
    gray = texture().astype(float).mean(axis=2)
    for axis in (0, 1):
        steps = np.abs(np.diff(gray, axis=axis)).mean(axis=1 - axis)
        first, last = np.take(gray, 0, axis), np.take(gray, -1, axis)
        assert np.abs(first - last).mean() <= 1.5 * steps.max()


def test_an_unknown_motif_lists_the_known_ones():
    with pytest.raises(ValueError, match=r"'dots'.*botanical"):
        textures.wallpaper((1.0, 1.0, 1.0), ((0.0, 0.0, 0.0),), "dots", 1)
