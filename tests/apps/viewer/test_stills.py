"""The depth buffer of squares, against loops over pixels; overviews have everything in view."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.apps.viewer.stills import NEAR, Squares, draw, lines, overview
from r3jax.geometry.cameras import Camera

CAMERA = Camera.from_fov(24, 18, 70.0)
POSE = np.eye(4)
BLUE = (0, 0, 255)


def by_loops(layers) -> np.ndarray:
    """What `draw` draws without shading, pixel by pixel and square by square, in float64."""
    picture = np.empty((CAMERA.height, CAMERA.width, 3), np.uint8)
    picture[:] = BLUE
    for row in range(CAMERA.height):
        for column in range(CAMERA.width):
            nearest = np.inf
            for layer in layers:
                for (x, y, z), color in zip(layer.points, layer.colors, strict=True):
                    if z <= NEAR:
                        continue
                    half = 0.5 * max(layer.edge * float(CAMERA.focal) / z, layer.least, 1.0)
                    u = float(CAMERA.fx) * x / z + float(CAMERA.cx)
                    v = float(CAMERA.fy) * y / z + float(CAMERA.cy)
                    inside = abs(column + 0.5 - u) <= half and abs(row + 0.5 - v) <= half
                    if inside and z - layer.lift < nearest:
                        nearest = z - layer.lift
                        picture[row, column] = color
    return picture


coordinate = st.floats(-1.5, 1.5)
points = st.lists(st.tuples(coordinate, coordinate, st.floats(-0.5, 3.0)), max_size=12)


def layer_of(triples, seed: int, **more) -> Squares:
    rng = np.random.default_rng(seed)
    colors = rng.integers(0, 256, (len(triples), 3), dtype=np.uint8)
    return Squares(np.array(triples, np.float64).reshape(-1, 3), colors, **more)


@pytest.mark.full
@given(points, points)
def test_the_nearest_square_wins_every_pixel(first, second):
    layers = [layer_of(first, 1, edge=0.2), layer_of(second, 2, edge=0.05, least=3.0, lift=0.1)]
    drawn = draw(CAMERA, POSE, layers, background=BLUE, strength=0.0)
    expected = by_loops(layers)
    # A pixel center on the very edge of a square may go either way.
    assert (drawn != expected).any(axis=-1).sum() <= 2


def test_a_square_has_its_size_and_place():
    layer = Squares(np.array([[0.0, 0.0, 2.0]]), np.array([[9, 8, 7]], np.uint8), edge=0.5)
    drawn = draw(CAMERA, POSE, [layer], background=BLUE, strength=0.0)
    side = 0.5 * float(CAMERA.focal) / 2.0
    rows, columns = np.nonzero((drawn == (9, 8, 7)).all(axis=-1))
    assert abs(len(set(rows)) - side) <= 1.0
    assert abs(len(set(columns)) - side) <= 1.0
    assert abs(rows.mean() + 0.5 - float(CAMERA.cy)) <= 0.5
    assert abs(columns.mean() + 0.5 - float(CAMERA.cx)) <= 0.5


def test_nothing_is_a_blank_picture():
    empty = layer_of([], 0, edge=0.1)
    for layers in ([], [empty]):
        assert (draw(CAMERA, POSE, layers, background=BLUE) == BLUE).all()


def test_what_stands_behind_an_edge_is_darkened_and_lines_are_not():
    wall = [(x, y, 2.0) for x in np.arange(-2, 2, 0.05) for y in np.arange(-2, 2, 0.05)]
    step = [(x, y, 1.5) for x in np.arange(-0.3, 0.3, 0.05) for y in np.arange(-0.3, 0.3, 0.05)]
    both = np.array(wall + step)
    white = np.full((len(both), 3), 200, np.uint8)
    drawn = draw(CAMERA, POSE, [Squares(both, white, edge=0.08)])
    assert (drawn[9, 12] == 200).all()  # the middle of the step has level neighbors
    assert drawn.min() < 150  # the wall beside it does not
    flat = draw(CAMERA, POSE, [Squares(both, white, edge=0.08, shaded=False)])
    assert (flat == 200).all()


def test_a_line_is_drawn_from_end_to_end_without_gaps():
    segment = np.array([[[-0.5, -0.3, 2.0], [0.6, 0.4, 1.2]]])
    red = np.array([255, 0, 0], np.uint8)
    drawn = draw(CAMERA, POSE, [lines(segment, red, 0.01, least=1.0)], background=BLUE)
    on = (drawn == (255, 0, 0)).all(axis=-1)
    ends = segment[0] / segment[0, :, 2:]
    columns = np.floor(float(CAMERA.fx) * ends[:, 0] + float(CAMERA.cx)).astype(int)
    assert on.any(axis=0)[columns.min() : columns.max() + 1].all()
    assert not on.any(axis=0)[: columns.min()].any()


def test_no_lines_are_no_squares():
    layer = lines(np.zeros((0, 2, 3)), np.zeros((0, 3), np.uint8), 0.01)
    assert len(layer.points) == len(layer.colors) == 0


@pytest.mark.parametrize("elevation", [10.0, 48.0, 89.0])
@pytest.mark.parametrize("azimuth", [-90.0, 30.0])
def test_an_overview_has_every_point_in_view_and_wastes_little(azimuth, elevation):
    rng = np.random.default_rng(3)
    cloud = rng.uniform([-4.0, 0.0, 0.0], [4.0, 3.0, 2.0], (200, 3))
    camera, pose = overview(cloud, 320, 200, azimuth, elevation)
    x, y, z = ((cloud - pose[:3, 3]) @ pose[:3, :3]).T
    assert z.min() > NEAR
    u, v = float(camera.fx) * x / z + 160.0, float(camera.fy) * y / z + 100.0
    assert u.min() >= 0.0
    assert u.max() <= 320.0
    assert v.min() >= 0.0
    assert v.max() <= 200.0
    assert max(np.ptp(u) / 320.0, np.ptp(v) / 200.0) > 0.85
    toward = cloud.mean(axis=0) - pose[:3, 3]
    assert toward @ pose[:3, 2] > 0.0
    assert pose[2, 3] > cloud[:, 2].mean()
