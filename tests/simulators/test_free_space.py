"""Free space against closed-form distances and floods; ground truth against the simulator."""

import itertools
import math
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage
from scipy.spatial import KDTree
from trimesh.triangles import closest_point

from r3jax.simulators import free_space
from r3jax.simulators.base import NoisySimulator
from r3jax.simulators.free_space import GroundTruth
from r3jax.simulators.raycast.raycast import RaycastSimulator
from r3jax.simulators.scenes.registry import open_world
from tests.simulators.rooms import SMALL, box_quads, facing_x, world_of

START = facing_x(0.8, 1.5, 1.25)
ROOM = (5.0, 3.0, 2.5)
SPACING = (0.5, 0.5, 0.5)


def quad(corner, *, x=0.0, y=0.0, z=0.0):
    """An upright or level rectangle from its corner along two of the axes."""
    edges = np.diag([x, y, z])[[k for k, side in enumerate((x, y, z)) if side]]
    return (corner, edges[0], edges[1])


def truth_of(quads, start=START):
    return GroundTruth(RaycastSimulator(world_of(quads), SMALL, start_pose=start))


def distance(points, quads):
    """Closed form, float64: all quads lie along the axes, each is a flat box."""
    ends = [np.stack([c, np.add(c, e), np.add(c, f), np.add(np.add(c, e), f)]) for c, e, f in quads]
    gaps = [
        np.maximum(np.maximum(end.min(axis=0) - points, points - end.max(axis=0)), 0.0)
        for end in ends
    ]
    return np.min([np.linalg.norm(gap, axis=-1) for gap in gaps], axis=0)


class Flood(NamedTuple):
    """The nodes that the oracle reaches: a grid from half a step or so from the room's corner."""

    reached: np.ndarray
    low: np.ndarray
    step: float

    def has(self, points):
        index = np.rint((points - self.low) / self.step).astype(int)
        return self.reached[tuple(index.T)]


def grid(low, step):
    axes = [np.arange(low, side, step) for side in ROOM]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def flood(quads, low, step, margin):
    """The component of the start among the nodes of a grid in the room."""
    nodes = grid(low, step)
    component, _ = ndimage.label(distance(nodes, quads) >= margin - 1e-4)
    at = np.linalg.norm(nodes - START[:3, 3], axis=-1) <= step * math.sqrt(3)
    return Flood(np.isin(component, np.setdiff1d(component[at], [0])), nodes[0, 0, 0], step)


def assert_free_space_is_the_flooded_one(quads, margin, spacing=0.5):
    points = grid(0.5 * spacing, spacing).reshape(-1, 3)
    expected = points[flood(quads, 0.05 if spacing == 0.5 else 0.0, 0.1, margin).has(points)]
    found = truth_of(quads).free_positions([spacing] * 3, margin)
    np.testing.assert_allclose(found, expected, atol=1e-9)


side = st.sampled_from([0.2, 0.45, 0.75, 1.1, 1.6, 2.4])
corner = st.tuples(st.floats(1.3, 4.5), st.floats(0.0, 2.5), st.floats(0.0, 2.0))
furniture = st.lists(st.tuples(corner, st.tuples(side, side, side)), max_size=4)


def furnished(pieces):
    """The room with closed boxes in it."""
    quads = box_quads((0, 0, 0), ROOM, inward=True)
    for low, size in pieces:
        quads += box_quads(low, np.minimum(low + np.array(size), ROOM), inward=False)
    return quads


@settings(max_examples=5)
@given(furniture, st.sampled_from([0.2, 0.3, 0.45]))
def test_positions_are_the_nodes_that_a_flood_reaches(pieces, margin):
    assert_free_space_is_the_flooded_one(furnished(pieces), margin)


@pytest.mark.full
@settings(max_examples=3)
@given(furniture)
def test_positions_keep_the_margin_and_stay_reachable_on_a_finer_grid(pieces):
    quads = furnished(pieces)
    truth = truth_of(quads)
    found = truth.free_positions(SPACING, 0.3)
    assert (distance(found, quads) >= 0.3 - 2e-4).all()
    # Between two nodes, half a step from each, the margin shrinks by no more than that.
    assert flood(quads, 0.0, 0.05, 0.25).has(found).all()


NESTED = box_quads((0, 0, 0), ROOM, inward=True) + box_quads(
    (-0.7, -0.7, -0.7), (5.7, 3.7, 3.2), inward=True
)


def test_only_the_room_of_the_start_counts():
    found = truth_of(NESTED).free_positions((1.0, 1.0, 0.75), 0.3)
    assert len(found) > 4
    assert (found > 0.0).all()
    assert (found < ROOM).all()


def test_both_rooms_are_found_through_a_door():
    """A wall at x = 2.5 with a door of 0.9 m; without the door nothing behind it counts."""
    room = box_quads((0, 0, 0), ROOM, inward=True)
    wall = [quad((2.5, 0, 0), y=1.0, z=2.5), quad((2.5, 1.9, 0), y=1.1, z=2.5)]
    door = quad((2.5, 1.0, 0), y=0.9, z=2.5)
    far = {}
    for name, quads in (("open", room + wall), ("shut", [*room, *wall, door])):
        found = truth_of(quads).free_positions(SPACING, 0.3)
        far[name] = int((found[:, 0] > 2.5).sum())
        assert (found[:, 0] < 2.5).sum() > 10
    assert far["open"] > 10
    assert far["shut"] == 0


def test_a_path_through_a_window_leads_nowhere():
    """The wall at x = 5 has a hole of 1.4 m; a terrace and a fence make the world larger."""
    quads = box_quads((0, 0, 0), ROOM, inward=True)
    quads = [q for q in quads if not (np.array([q[0], q[0] + q[1] + q[2]])[:, 0] == 5.0).all()]
    quads += [quad((5, 0, 0), y=0.8, z=2.5), quad((5, 2.2, 0), y=0.8, z=2.5)]
    quads += [quad((5, 0, 0), x=4, y=3), quad((9, 0, 0), y=3, z=2.5)]
    found = truth_of(quads).free_positions(SPACING, 0.3)
    assert len(found) > 10
    assert (found[:, 0] < 5.0).all()


def test_blocks_decide_as_their_nodes_do():
    pieces = [((1.6, 0.4, 0.0), (0.75, 1.1, 0.75)), ((3.0, 1.2, 0.9), (0.2, 1.6, 1.1))]
    assert_free_space_is_the_flooded_one(furnished(pieces), 0.3, 0.2)


def test_pieces_tell_the_distance():
    """Long thin triangles in space against dense samples of them."""
    rng = np.random.default_rng(5)
    vertices, faces = rng.uniform(-2, 2, (30, 3)), np.arange(30).reshape(-1, 3)
    surface = free_space._Surface(vertices, faces)
    weights = rng.dirichlet([0.7, 0.7, 0.7], 20_000)
    samples = np.einsum("wk,fkj->fwj", weights, vertices[faces]).reshape(-1, 3)
    points = rng.uniform(-2, 2, (600, 3))
    exact, _ = KDTree(samples).query(points)  # no less than the distance, and a little more
    low, high = surface.bounds(points)
    assert (low <= exact).all()
    assert (high >= exact - 0.1).all()
    assert (high - low < 0.15).all()
    is_clear = np.abs(exact - 0.25) > 0.05
    assert is_clear.sum() > 300
    np.testing.assert_array_equal(surface.keeps(points, 0.25)[is_clear], (exact > 0.25)[is_clear])


def test_a_scan_without_a_ceiling_keeps_its_positions():
    without = box_quads((0, 0, 0), ROOM, inward=True)[:-1]
    whole = truth_of(box_quads((0, 0, 0), ROOM, inward=True)).free_positions(SPACING, 0.3)
    found = truth_of(without).free_positions(SPACING, 0.3)
    assert {*map(tuple, whole)} <= {*map(tuple, found)}


def test_a_closed_cupboard_is_not_free_inside():
    cupboard = ((2.5, 0.5, 0.0), (4.5, 2.5, 2.0))  # 2 m wide: its middle is a meter from any side
    quads = box_quads((0, 0, 0), ROOM, inward=True) + box_quads(*cupboard, inward=False)
    found = truth_of(quads).free_positions(SPACING, 0.3)
    assert len(found) > 10
    assert not ((found > cupboard[0]) & (found < cupboard[1])).all(axis=1).any()


@pytest.mark.full
def test_an_embedded_scene_keeps_the_margin_by_another_program_s_measure():
    world = open_world("kitchen")
    found = GroundTruth(RaycastSimulator(world, SMALL)).free_positions((1.0, 1.0, 0.75), 0.3)
    assert len(found) > 20
    triangles = world.vertices[world.faces]
    for position in found:
        at = np.broadcast_to(position, (len(triangles), 3))
        nearest = closest_point(triangles, at)
        assert np.linalg.norm(nearest - position, axis=1).min() >= 0.3 - 2e-4


@pytest.mark.parametrize(
    ("spacing", "margin", "words"),
    [
        ((1.0, 0.0, 1.0), 0.3, "three lengths"),
        ((1.0, 1.0), 0.3, "three lengths"),
        ((1.0, math.nan, 1.0), 0.3, "three lengths"),
        (SPACING, 0.0, "at least 0.05"),
        (SPACING, math.nan, "at least 0.05"),
        (SPACING, 1.0, r"only 0\.80 m free"),
    ],
)
def test_bad_settings_are_refused(spacing, margin, words):
    with pytest.raises(ValueError, match=words):
        truth_of(furnished([])).free_positions(spacing, margin)


def test_a_world_too_large_is_refused():
    quads = [*furnished([]), quad((0, 0, -1.0), x=3000, y=3000)]
    with pytest.raises(ValueError, match="meters"):
        truth_of(quads).free_positions(SPACING, 0.3)


def test_views_into_the_void_are_known():
    truth = truth_of(
        [quad((3, -50, -50), y=100, z=100), quad((0, 0, 0), x=1, y=1)], facing_x(1.5, 0, 1)
    )
    away = facing_x(1.5, 0, 1) @ np.diag([-1.0, 1.0, -1.0, 1.0])
    beside = facing_x(1.5, 0, 1) @ np.array(
        [[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 0, 1.0]]
    )
    share = truth.seen_share(np.stack([facing_x(1.5, 0, 1), away, beside]))
    np.testing.assert_allclose(share, [1.0, 0.0, 0.5], atol=1e-6)


def test_frames_are_those_of_the_simulator_without_noise_and_limit():
    world = world_of(furnished([]))
    noisy = NoisySimulator(RaycastSimulator(world, SMALL, max_range=1.0, start_pose=START), 0.1)
    exact = RaycastSimulator(world, SMALL, max_range=None, start_pose=START)
    truth = GroundTruth(noisy)
    (frame,) = truth.frames(START[None], SMALL)
    np.testing.assert_array_equal(frame.rgb, exact.render(START).rgb)
    np.testing.assert_array_equal(frame.depth, exact.render(START).depth)
    assert np.asarray(frame.depth).max() > 4.0
    assert np.isinf(np.asarray(noisy.render(START).depth)).any()  # the explorer's own is untouched
    assert truth.scene_hash == world.content_hash
    assert truth.scene == "test"


def test_what_has_no_mesh_is_refused():
    class Recorded:
        camera, bounds, start_pose = SMALL, np.zeros((2, 3)), START

        def render(self, T_world_camera):
            raise NotImplementedError

    with pytest.raises(ValueError, match="Recorded"):
        GroundTruth(Recorded())


@pytest.fixture(scope="module")
def office():
    return RaycastSimulator(open_world("office"))


@pytest.mark.parametrize(
    "waypoints",
    [
        [[1.45, 3.95, 1.2], [1.45, 3.45, 1.2]],  # the wall below a pane of glass
        [[1.45, 4.2, 2.0], [1.45, 4.2, -0.5]],  # the floor
        [[1.45, 4.2, 2.0], [1.45, 4.2, 1.9], [1.45, 9.0, 1.9]],  # behind a bend
    ],
)
def test_a_path_through_a_surface_has_no_room(office, waypoints):
    assert GroundTruth(office).room_along([np.array(waypoints)])[0] == 0.0


def test_a_path_through_glass_has_room(office):
    """A pane between two rooms of the office, from 1.45 m up: a depth sensor sees nothing there."""
    path = np.array([[1.45, 3.95, 2.25], [1.45, 3.45, 2.25]])
    assert not office.segment_is_clear(*path)
    assert GroundTruth(office).room_along([path])[0] > 0.15


def test_the_room_along_a_path_is_the_least_clearance(office):
    path = np.array([[0.65, 4.25, 2.45], [1.2, 4.25, 2.3], [1.2, 4.6, 2.3]])
    truth = GroundTruth(office)
    (room,), (place,) = truth.room_along([path])
    share = np.linspace(0.0, 1.0, 400)[:, None]
    points = np.concatenate([a + share * (b - a) for a, b in itertools.pairwise(path)])
    assert room == pytest.approx(office.clearance(points).min(), abs=0.01)
    assert office.clearance(place[None])[0] == pytest.approx(room, abs=1e-6)
    assert truth.room_along([path[:1]])[0] == office.clearance(path[:1])[0]


def test_many_paths_are_measured_as_each_one(office):
    """With waypoints that stand still, none at all, and a surface across some of them."""
    rng = np.random.default_rng(0)
    low, high = office.bounds
    paths = [rng.uniform(low, high, (rng.integers(1, 5), 3)) for _ in range(40)]
    paths.append(np.repeat(paths[0][:1], 3, axis=0))
    truth = GroundTruth(office)
    rooms, places = truth.room_along(paths)
    assert 0 < (rooms == 0.0).sum() < len(paths)
    for path, room, place in zip(paths, rooms, places, strict=True):
        one, where = truth.room_along([path])
        assert room == one[0]
        np.testing.assert_array_equal(place, where[0])
    limited, _ = truth.room_along(paths, 0.3)
    np.testing.assert_array_equal(limited, np.where(rooms <= 0.3, rooms, np.inf))
