"""Planners of places without end: what is at hand, ways to what is not, and views left there."""

import itertools
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.errors import InputError, PathError
from r3jax.mapping.tiles import whole_map
from r3jax.mapping.update import integrate_growing
from r3jax.planning.far import Views, arrived, far_arrays, far_of, first_far, weigh_far, with_views
from r3jax.planning.planner import at_hand, first_map
from r3jax.planning.policy import Decision
from tests.mapping.test_tiles import assert_same_map
from tests.rooms_of_boxes import frame_in_room, pose_at

CAMERA = r3jax.Camera.from_fov(48, 36, 75.0)
CONFIG = r3jax.MappingConfig(voxel_size=0.1, cell_size=0.25, max_range=3.0)
HALL = np.array([[0.0, 0.0, 0.0], [30.0, 4.0, 2.6]])
ENDLESS = np.array([[-np.inf] * 3, [np.inf] * 3])
KEY = jax.random.key(3)


def a_policy(name="r3-pano", **settings):
    scoring = r3jax.ScoringConfig(max_range=3.0)
    return r3jax.make_policy(name, scoring=scoring, num_candidates=12, num_frontier=6, **settings)


def far_at(position, box=ENDLESS):
    pose = np.eye(4)
    pose[:3, 3] = position
    return first_far(CONFIG, a_policy(), CAMERA, box, [pose])


def way(*corners):
    """Cells along lines between corners, each a neighbor of the next."""
    cells = [np.array(corners[0])[None]]
    for a, b in itertools.pairwise(corners):
        steps = np.linspace(a, b, int(np.abs(np.subtract(b, a)).max()) + 1)
        cells.append(np.round(steps[1:]).astype(np.int64))
    return np.concatenate(cells)


def a_view(position, place, path, utility):
    pose = np.eye(4)[None].copy()
    pose[0, :3, 3] = position
    return Views(pose, np.array([place], float), np.array([path]), {"utility": np.array([utility])})


def test_a_view_left_far_away_is_gone_back_to_over_the_way_that_was_come():
    """Round a corner: 200 cells out, 100 to the side; nothing is left here."""
    far = far_at([0.1, 0.1, 0.1])
    far = replace(far, trails=way((0, 0, 0), (200, 0, 0), (200, 100, 0)))
    place = (np.array([200, 100, 0]) + 0.5) * 0.25
    far = replace(far, views=a_view(place + np.array([0.0, 2.0, 0.0]), place, 2.0, 50.0))
    here = np.eye(4)
    here[:3, 3] = 0.125
    decision, after = weigh_far(far, a_policy(), None, here)
    assert decision is not None
    np.testing.assert_allclose(decision.waypoints[0], here[:3, 3])
    np.testing.assert_allclose(decision.waypoints[-1], place)
    np.testing.assert_allclose(decision.T_world_camera[:3, 3], place)
    assert decision.length == pytest.approx(300 * 0.25, rel=0.02)  # the corner is cut by one cell
    assert len(decision.waypoints) <= 5
    assert len(after.views.path) == 0  # a promise is taken once


@pytest.mark.parametrize("kind", ["zone", "costmap", "refused"])
def test_no_path_leads_through_what_was_closed_since(kind):
    far = replace(far_at([0.1, 0.1, 0.1]), trails=way((0, 0, 0), (200, 0, 0)))
    place = np.array([200.5, 0.5, 0.5]) * 0.25
    far = replace(far, views=a_view(place, place, 0.0, 50.0))
    here = np.eye(4)
    here[:3, 3] = 0.125
    assert weigh_far(far, a_policy(), None, here)[0] is not None
    closed = {
        "zone": {"zones": (np.array([[20.0, -1.0], [21.0, -1.0], [21.0, 1.0], [20.0, 1.0]]),)},
        "costmap": {"costs": (np.array([[20.0, 0.0]]), 0.3)},
        "refused": {"refused": np.array([[*place, 0.5]])},
    }
    assert weigh_far(replace(far, **closed[kind]), a_policy(), None, here)[0] is None


def test_a_view_without_a_way_is_no_goal():
    far = far_at([0.1, 0.1, 0.1])
    cells = np.concatenate([way((0, 0, 0), (9, 0, 0)), way((100, 0, 0), (200, 0, 0))])
    place = np.array([200.5, 0.5, 0.5]) * 0.25
    far = replace(far, trails=cells, views=a_view(place, place, 0.0, 50.0))
    here = np.eye(4)
    here[:3, 3] = 0.125
    assert weigh_far(far, a_policy(), None, here) == (None, far)


@pytest.mark.parametrize(("promise", "goes"), [(5.0, False), (500.0, True)])
def test_near_and_far_views_are_weighed_together(promise, goes):
    far = replace(far_at([0.1, 0.1, 0.1]), trails=way((0, 0, 0), (80, 0, 0)))
    place = np.array([80.5, 0.5, 0.5]) * 0.25
    far = replace(far, views=a_view(place, place, 0.0, promise))
    near = Decision(
        np.eye(4), np.zeros((2, 3)), 1.0, 0.5, np.tile(np.eye(4), (2, 1, 1)),
        {"utility": np.array([40.0, 30.0]), "path": np.array([1.0, 2.0]),
         "total": np.array([0.5, 0.4])},
    )  # fmt: skip
    here = np.eye(4)
    here[:3, 3] = 0.125
    decision, _ = weigh_far(far, a_policy(), near, here)
    assert (decision is not near) is goes
    if goes:
        assert len(decision.candidates) == len(decision.utilities["total"]) == 3
        assert decision.score == decision.utilities["total"].max()


def test_of_views_close_together_the_newest_best_is_kept():
    poses = np.tile(np.eye(4), (4, 1, 1))
    poses[:, :3, 3] = [[3.1, 0.1, 0.1], [3.2, 0.2, 0.2], [5.1, 0.1, 0.1], [0.2, 0.0, 0.0]]
    utilities = {
        "utility": np.array([1.0, 4.0, 2.0, 9.0]),
        "path": np.array([3.0, 3.0, np.inf, 0.1]),
    }
    decision = Decision(np.eye(4), np.zeros((1, 3)), 0.0, 0.0, poses,
                        utilities | {"total": np.zeros(4)})  # fmt: skip
    far = replace(far_at([0.0, 0.0, 0.0]), views=a_view([3.3, 0.3, 0.3], [0, 0, 0], 9.0, 99.0))
    kept = with_views(far, decision, np.zeros(3), 0.5).views
    assert kept.values["utility"].tolist() == [4.0]


def test_a_robot_that_was_carried_a_step_is_still_on_its_way():
    far = replace(far_at([0.1, 0.1, 0.1]), trails=way((0, 0, 0), (4, 0, 0)))
    near = arrived(far, np.array([1.6, 0.1, 0.1]))
    assert len(near.trails) > len(far.trails)
    gaps = np.linalg.norm(near.trails[:, None] - near.trails[None], axis=2)
    assert np.sort(gaps, axis=1)[:, 1].max() < 1.8  # every cell has a neighbor
    assert len(arrived(far, np.array([50.0, 0.1, 0.1])).trails) == len(far.trails) + 1


def test_limits_zones_and_refusals_are_drawn_into_every_block():
    box = np.array([[-20.0, -np.inf, 0.0], [9.0, np.inf, 2.0]])
    far = far_at([0.0, 0.0, 1.0], box)
    lattice = far.tiles.lattice
    assert lattice.num == (5, 5, 1)
    zone = np.array([[6.0, 1.0], [7.0, 1.0], [7.0, 2.0], [6.0, 2.0]])
    far = replace(far, zones=(zone,), refused=np.array([[5.0, 0.0, 1.0, 0.6]]))
    for middle in ((1, 0, 0), (2, 0, 0)):
        moved = replace(far, tiles=replace(far.tiles, middle=middle))
        grid = moved.grid(np.zeros(lattice.shape, np.float32))
        cell = lambda p, g=grid: tuple(np.asarray(r3jax.mapping.occupancy.world_to_cell(
            g, jnp.asarray([p], jnp.float32)))[0].tolist())  # fmt: skip
        assert grid.explorable[cell([8.5, 0.0, 1.0])]
        assert not grid.explorable[cell([9.6, 0.0, 1.0])]
        assert grid.closed[cell([6.5, 1.5, 1.0])]
        assert grid.refused[cell([5.0, 0.0, 1.0])]
        assert not grid.refused[cell([4.2, 0.0, 1.0])]
        corner = lattice.corner(middle)
        assert grid.refused[cell([*(corner[:2] + 0.3), 1.0])]


def test_other_policies_and_positions_are_refused():
    for name in ("frontier", "r3-ahead", "random"):
        with pytest.raises(InputError, match=name):
            r3jax.start(CAMERA, policy=name)
    with pytest.raises(InputError, match="bounds"):
        r3jax.start(CAMERA, np.array([[0.0, 0.0, np.nan], [1.0, 1.0, 1.0]]))
    planner = r3jax.start(CAMERA, policy=a_policy(), config=CONFIG)
    with pytest.raises(InputError, match="subtract an origin"):
        at_hand(planner, np.array([500_000.0, 5_600_000.0, 100.0]))  # UTM
    with pytest.raises(InputError, match=r"tile_folder.*bounds"):
        r3jax.start(CAMERA, HALL, a_policy(), tile_folder="unused")
    with pytest.raises(InputError, match="polygons"):
        r3jax.keep_out(planner, np.zeros(planner.grid.log_odds.shape[:2], bool))


@pytest.mark.full
def test_a_hall_is_explored_to_its_end_by_tiles(tmp_path):
    """No bounds: map and tiles are the map without tiles, and a saved planner goes on alike."""
    pose = pose_at([2.0, 2.0, 1.3], 0.0, 0.0)
    planner = r3jax.start(CAMERA, policy=a_policy(), starts=[pose], config=CONFIG)
    shape, capacity = planner.grid.log_odds.shape, planner.map_state.capacity
    whole, farthest, first = first_map(planner.config), 0.0, planner
    for step in range(30):
        frame = frame_in_room(CAMERA, pose, room=HALL, noise=0.002, seed=step)
        frame = r3jax.Frame.from_arrays(frame.rgb, frame.depth, pose, CAMERA)
        planner = r3jax.observe(planner, frame)
        whole = integrate_growing(whole, frame, CONFIG.max_range)
        decision, planner, info = r3jax.decide(planner, pose, jax.random.fold_in(KEY, step))
        assert decision is not None, info.reason
        np.testing.assert_allclose(decision.waypoints[0], pose[:3, 3])
        np.testing.assert_allclose(decision.waypoints[-1], decision.T_world_camera[:3, 3])
        assert np.all(decision.waypoints > HALL[0]) and np.all(decision.waypoints < HALL[1])  # noqa: PT018
        pose = decision.T_world_camera
        farthest = max(farthest, pose[0, 3])
    assert (planner.grid.log_odds.shape, planner.map_state.capacity) == (shape, capacity)
    assert farthest > 12.0
    assert len(planner.far.tiles.voxels) > 0
    assert_same_map(whole_map(planner.map_state, planner.far.tiles), whole)
    assert len(first.far.tiles.voxels) == 0  # planners share tiles and change none

    r3jax.save(planner, tmp_path / "saved")
    scratch = tmp_path / "scratch"
    again = r3jax.load(tmp_path / "saved", tile_folder=scratch, tile_memory=0)
    assert not again.far.tiles.voxels.memory
    assert_same_map(whole_map(again.map_state, again.far.tiles), whole)
    back = pose_at([2.0, 2.0, 1.3], 180.0, 0.0)
    frame = frame_in_room(CAMERA, back, room=HALL)
    frame = r3jax.Frame.from_arrays(frame.rgb, frame.depth, back, CAMERA)
    ends = [r3jax.decide(r3jax.observe(p, frame), back, KEY)[0] for p in (planner, again)]
    np.testing.assert_array_equal(ends[0].T_world_camera, ends[1].T_world_camera)

    for path in scratch.rglob("*.tile"):
        path.unlink()
    with pytest.raises(PathError, match=r"r3jax\.rebuild"):
        at_hand(again, back[:3, 3])
    rebuilt = r3jax.rebuild(again, [frame])
    assert rebuilt.far.tiles.folder is again.far.tiles.folder
    alone = integrate_growing(first_map(planner.config), frame, CONFIG.max_range)
    assert_same_map(rebuilt.whole_map, alone)


def test_what_is_known_of_far_places_can_be_stored():
    far = replace(far_at([0.0, 0.0, 0.0]), trails=way((0, 0, 0), (4, 0, 0)))
    far = replace(far, views=a_view([3.0, 0.0, 0.0], [0, 0, 0], 3.0, 7.0),
                  zones=(np.zeros((3, 2)), np.ones((4, 2))))  # fmt: skip
    again = far_of(far_arrays(far), CONFIG, CAMERA)
    first, second = far_arrays(far), far_arrays(again)
    assert first.keys() == second.keys()
    for name in first:
        np.testing.assert_array_equal(first[name], second[name])
    assert again.tiles.lattice == far.tiles.lattice
