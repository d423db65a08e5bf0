"""Textures and lamps against closed forms. One wall across the view, one pixel or all of them."""

import dataclasses

import numpy as np
import pytest

from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.world import Lamp, Material
from tests.simulators.rooms import SMALL, facing_x, world_of

LAMPS = (
    Lamp(position=(1.0, 1.5, 2.0), color=(0.9, 0.6, 0.4), reach=3.0),
    Lamp(position=(-1.0, -2.0, 0.5), color=(0.3, 0.5, 0.6), reach=5.0),
)


def seen(world, pose=None, **settings):
    simulator = RaycastSimulator(world, SMALL, **settings)
    return np.asarray(simulator.render(facing_x(0, 0, 0) if pose is None else pose).rgb)


def textured_wall(texture, repeats=1.0, size=2.0):
    """A wall of `size` meters at x = 2; the picture stands upright for a camera at the origin."""
    quad = ((2, 0.5 * size, -0.5 * size), (0, -size, 0), (0, 0, size))  # u right, v up
    world = world_of([quad], [Material(texture=texture)])
    return dataclasses.replace(world, face_uv=world.face_uv * repeats)


def test_the_first_row_of_a_texture_is_on_top():
    texture = np.zeros((4, 4, 3), np.uint8)
    texture[0, 0], texture[0, -1], texture[-1, 0] = (255, 0, 0), (0, 255, 0), (0, 0, 255)
    rgb = seen(textured_wall(texture))
    rows, columns = np.nonzero(rgb.max(axis=-1) > 0.9)
    colors = rgb[rows, columns].round()
    for color, is_top, is_left in (
        ((1, 0, 0), True, True),
        ((0, 1, 0), True, False),
        ((0, 0, 1), False, True),
    ):
        where = (colors == color).all(axis=1)
        assert where.any()
        assert ((rows[where] < 32) == is_top).all()
        assert ((columns[where] < 32) == is_left).all()


def test_a_magnified_texture_is_interpolated_between_texel_centers():
    ramp = np.zeros((2, 16, 3), np.uint8)
    ramp[:] = np.arange(16)[None, :, None] * 16
    rgb = seen(textured_wall(ramp, size=4.0), supersample=0)
    u = ((np.arange(64) + 0.5 - 32) / float(SMALL.fx) * 2.0 + 2.0) / 4.0
    inner = (u > 0.5 / 16) & (u < 1 - 0.5 / 16)
    expected = (u * 16 - 0.5) * 16 / 255
    np.testing.assert_allclose(rgb[32, inner, 0], expected[inner], atol=2e-3)


def test_coordinates_outside_the_unit_square_repeat_the_texture():
    rng = np.random.default_rng(0)
    texture = rng.integers(0, 256, (8, 8, 3), dtype=np.uint8)
    tiled = np.tile(texture, (3, 3, 1))
    three_times = textured_wall(texture, repeats=3.0)
    below_zero = dataclasses.replace(three_times, face_uv=three_times.face_uv - 7.0)
    expected = seen(textured_wall(tiled))
    assert expected.std() > 0.1
    np.testing.assert_allclose(seen(three_times), expected, atol=2e-3)
    np.testing.assert_allclose(seen(below_zero), expected, atol=2e-3)


def test_detail_finer_than_the_pixels_becomes_its_mean():
    checks = (np.indices((512, 512)).sum(axis=0) % 2 * 255).astype(np.uint8)
    wall = textured_wall(np.repeat(checks[..., None], 3, axis=2), repeats=4.0, size=8.0)
    rgb = seen(wall)
    np.testing.assert_allclose(rgb, 0.5, atol=0.03)


def test_texture_material_and_vertex_colors_multiply():
    texture = np.full((2, 2, 3), 204, np.uint8)
    world = textured_wall(texture, size=9.0)
    half = dataclasses.replace(
        world,
        materials=(Material(texture=texture, color=(0.5, 1.0, 0.25)),),
        face_color=np.full((2, 3, 3), 0.5, np.float32),
    )
    np.testing.assert_allclose(seen(half)[32, 32], np.array([0.2, 0.4, 0.1]), atol=1e-5)


def test_vertex_colors_blend_across_a_face():
    world = world_of([((2, 4, -4), (0, -8, 0), (0, 0, 8))])
    right = world.face_uv[..., :1]  # u grows to the right
    colored = dataclasses.replace(world, face_color=np.repeat(right, 3, axis=2))
    rgb = seen(colored)
    u = ((np.arange(64) + 0.5 - 32) / float(SMALL.fx) * 2.0 + 4.0) / 8.0
    np.testing.assert_allclose(rgb[..., 0], np.broadcast_to(u, (64, 64)), atol=1e-5)


def blinn_phong(point, normal, camera, material, ambient):
    """The module's formula in float64 for one point."""
    view = (camera - point) / np.linalg.norm(camera - point)
    diffuse, highlight = np.zeros(3), np.zeros(3)
    for lamp in LAMPS:
        offset = np.array(lamp.position) - point
        distance = np.linalg.norm(offset)
        light = np.array(lamp.color) / (1 + (distance / lamp.reach) ** 2)
        incidence = normal @ offset / distance
        half = offset / distance + view
        diffuse += light * max(incidence, 0)
        if incidence > 0:
            highlight += light * max(normal @ half / np.linalg.norm(half), 0) ** material.shininess
    received = ambient + (1 - ambient) * diffuse
    share = material.emission + (1 - material.emission) * received
    return np.clip(np.array(material.color) * share + material.specular * highlight, 0, 1)


@pytest.mark.parametrize(
    "material",
    [
        Material(color=(0.6, 0.5, 0.4)),
        Material(color=(0.3, 0.2, 0.1), specular=0.5, shininess=12.0),
        Material(color=(0.3, 0.6, 0.1), specular=0.2, emission=0.7),
    ],
)
@pytest.mark.parametrize("is_front", [True, False])
def test_lamps_follow_the_formula_on_both_sides(material, is_front):
    edges = ((0, 0, 8), (0, 8, 0)) if is_front else ((0, 8, 0), (0, 0, 8))
    world = world_of([((2.5, -4, -4), *edges)], [material], lamps=LAMPS, ambient=0.3)
    rgb = seen(world)
    for row, column in ((3, 7), (32, 32), (60, 20), (12, 55)):
        y, z = (32 - column - 0.5) / float(SMALL.fx), (32 - row - 0.5) / float(SMALL.fy)
        point = 2.5 * np.array([1.0, y, z])
        expected = blinn_phong(point, np.array([-1.0, 0, 0]), np.zeros(3), material, 0.3)
        np.testing.assert_allclose(rgb[row, column], expected, atol=1e-4)


def center_color(material, pose):
    """What the camera sees of the point (2, 0, 0) of a lamp-lit wall, in its image's middle."""
    wall = ((2, -4, -4), (0, 0, 8), (0, 8, 0))
    return seen(world_of([wall], [material], lamps=LAMPS, ambient=0.3), pose)[31:33, 31:33].mean(
        axis=(0, 1)
    )


def test_only_highlights_depend_on_the_viewpoint():
    angle = 0.6
    turn = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
    )
    aside = facing_x(0, 0, 0)
    aside[:3, :3] = turn @ aside[:3, :3]
    aside[:3, 3] = [2, 0, 0] - 2.0 * aside[:3, 2]
    matte = Material(color=(0.5, 0.5, 0.5))
    glossy = dataclasses.replace(matte, specular=0.8, shininess=4.0)
    front = facing_x(0, 0, 0)
    np.testing.assert_allclose(center_color(matte, front), center_color(matte, aside), atol=2e-3)
    assert np.abs(center_color(glossy, front) - center_color(glossy, aside)).max() > 0.03


def test_without_lighting_every_surface_shows_its_color():
    wall = ((2, -4, -4), (0, 0, 8), (0, 8, 0))
    material = Material(color=(0.6, 0.5, 0.4), specular=1.0, emission=0.2)
    rgb = seen(world_of([wall], [material], lamps=LAMPS, ambient=0.1), lighting=False)
    np.testing.assert_allclose(rgb, np.broadcast_to([0.6, 0.5, 0.4], rgb.shape), atol=1e-6)
