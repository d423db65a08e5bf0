"""Voxels that frames see through are removed; what is there stays, thin and transparent or not."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.mapping import update
from r3jax.mapping.state import MapState
from tests.mapping.test_kernels import CAPACITY, REACH, assert_same_map, frame_of
from tests.rooms_of_boxes import ROOM, frame_in_room, pose_at

CAMERA = r3jax.Camera.from_fov(160, 120, 70.0)
PERSON = np.array([[0.6, -0.25, 0.0], [0.9, 0.25, 1.7]])
EYE = (-1.4, 0.0, 1.2)

formulas = jax.jit(update._by_formulas)
kernels = jax.jit(update._by_kernels)


def new_map(**options) -> MapState:
    return r3jax.empty_map(1 << 15, **{"remove_moved": True, **options})


def mapped(frames: list[r3jax.Frame], state: MapState | None = None) -> MapState:
    """The map of frames, by the kernels."""
    return functools.reduce(r3jax.integrate, frames, new_map() if state is None else state)


def centers(state: MapState) -> np.ndarray:
    """Centers of the voxels, [n, 3] [m]."""
    return np.asarray(state.center).T[np.asarray(state.present)]


def ghosts(state: MapState) -> int:
    """Number of voxels in the middle of the room, away from its walls."""
    inside = (centers(state) > ROOM[0] + 0.25) & (centers(state) < ROOM[1] - 0.25)
    return int(inside.all(axis=1).sum())


def looks(num: int, **options) -> list[r3jax.Frame]:
    """Frames across the room, from slightly other places each."""
    return [
        frame_in_room(
            CAMERA, pose_at(np.add(EYE, [0.0, 0.1 * i, 0.0]), -2.0 * i, -8.0), seed=i, **options
        )
        for i in range(num)
    ]


@pytest.mark.parametrize("frames_with_person", [1, 2, 6])
def test_a_person_who_has_left_is_gone_within_three_looks(frames_with_person):
    there = looks(frames_with_person, boxes=[PERSON], noise=0.01)
    state = mapped(there)
    assert ghosts(state) > 150
    assert ghosts(mapped(looks(3, noise=0.01), state)) == 0
    forever = mapped(looks(3, noise=0.01), mapped(there, new_map(remove_moved=False)))
    assert ghosts(forever) > 150


@pytest.mark.parametrize("yaw", [30.0, -30.0])
def test_a_person_at_the_border_of_the_image_is_gone_as_far_as_it_shows(yaw):
    """Half of a footprint beyond the border is no reason to keep what the other half denies."""
    there = frame_in_room(CAMERA, pose_at(EYE, yaw, -8.0), [PERSON])
    later = [frame_in_room(CAMERA, pose_at(EYE, yaw, -8.0), seed=i) for i in range(3)]
    state = mapped([there])
    before, left = (ghost_pixels(one, there) for one in (state, mapped(later, state)))
    half = int(np.ceil(float(CAMERA.fx) * 0.867 * 0.05 / 2.0)) + 1
    at_border = lambda x: np.sum((x[:, 0] < half) | (x[:, 0] >= CAMERA.width - half))
    assert at_border(before) > 20
    # All but those at the floor's and the images' corners, of which a quarter is in view.
    assert len(left) <= 0.05 * len(before)


def ghost_pixels(state: MapState, frame: r3jax.Frame) -> np.ndarray:
    """Columns and rows of the voxels in the middle of the room that lie in a frame, [n, 2]."""
    xyz = centers(state)
    inside = (xyz > ROOM[0] + 0.25) & (xyz < ROOM[1] - 0.25)
    T = np.linalg.inv(np.asarray(frame.T_world_camera, np.float64))
    x, y, z = T[:3, :3] @ xyz[inside.all(axis=1)].T + T[:3, 3:]
    camera = frame.camera
    pixels = np.stack([camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy], axis=1)
    return pixels[((pixels >= 0) & (pixels < [camera.width, camera.height])).all(axis=1) & (z > 0)]


def test_a_person_behind_a_pole_is_gone_beside_it():
    """What is nearer than a voxel hides a part of it, and says nothing about the rest."""
    pole = np.array([[-0.6, -0.02, 0.0], [-0.56, 0.02, 2.6]])
    person = np.array([[0.6, -0.25, 0.0], [0.9, 0.25, 1.7]])
    there, later = looks(1, boxes=[pole, person]), looks(3, boxes=[pole])
    state = mapped(there)
    row = lambda s: ghost_pixels(s, there[0])
    is_pole = lambda x: np.abs(x[:, 0] - 80.0) < 30.0
    assert is_pole(row(state)).sum() > 50
    only_pole = mapped(later, mapped(looks(1, boxes=[pole])))
    assert len(row(mapped(later, state))) - len(row(only_pole)) <= 0.05 * len(row(state))


@pytest.mark.parametrize("width", [320, 1280])
def test_a_person_near_by_is_gone_in_images_of_any_size(width):
    camera = r3jax.Camera.from_fov(width, 3 * width // 4, 70.0)
    near = np.array([[-0.8, -0.25, 0.0], [-0.6, 0.25, 1.7]])  # 0.6 m before the camera
    [there] = [frame_in_room(camera, pose_at(EYE, 0.0, 0.0), [near])]
    state = mapped([there])
    assert ghosts(state) > 50
    later = [frame_in_room(camera, pose_at(EYE, 0.0, 0.0), seed=i) for i in range(3)]
    assert ghosts(mapped(later, state)) <= 0.05 * ghosts(state)


def test_pixels_on_depth_edges_that_hang_in_the_air_are_gone_after_three_clean_looks():
    """A sensor mixes the depths before and behind an edge; from beside it frames see through."""
    box = np.array([[0.4, -0.5, 0.0], [0.9, 0.5, 1.3]])
    [frame] = looks(1, boxes=[box])
    depth = np.array(frame.depth)
    step = np.abs(np.diff(depth, axis=1)) > 0.3
    mixed = 0.5 * (depth[:, 1:] + depth[:, :-1])
    depth[:, 1:][step] = mixed[step]
    flying = r3jax.Frame(frame.rgb, depth, frame.T_world_camera, CAMERA)
    later = [
        frame_in_room(CAMERA, pose_at((-1.4, y, 1.2), -8.0 * np.sign(y), -8.0), [box], seed=i)
        for y in (-1.3, 1.3)
        for i in range(3)
    ]
    state = r3jax.integrate(new_map(), flying, drop_edges=False)
    # The same frames without the mixture: what they lack hangs in the air.
    true = set(map(tuple, centers(mapped([frame, *later], new_map(remove_moved=False)))))
    hanging = set(map(tuple, centers(state))) - true
    xyz = np.array(sorted(hanging))
    # Within two voxels of a surface, and the noise of the depth, they are not told from it.
    hanging = set(map(tuple, xyz[~near_surfaces(xyz, [box], within=0.2)]))
    left = hanging & set(map(tuple, centers(mapped(later, state))))
    assert len(hanging) > 50
    assert len(left) <= 0.1 * len(hanging)


def test_a_person_in_a_mask_leaves_nothing():
    [seen], [empty] = looks(1, boxes=[PERSON]), looks(1)
    mask = np.asarray(seen.depth) < np.asarray(empty.depth) - 0.01
    frame = r3jax.Frame.from_arrays(seen.rgb, seen.depth, seen.T_world_camera, CAMERA, ignore=mask)
    assert mask.sum() > 500
    assert ghosts(mapped([frame])) == 0


@given(st.integers(0, 10**6))
@settings(max_examples=5)
def test_what_is_there_stays(seed):
    """Of true surfaces, with noise of 1 % and boxes that hide each other, 0.2 % may go."""
    random = np.random.default_rng(seed)
    low = random.uniform([-1.5, -1.5, 0.0], [1.5, 1.0, 1.0], (4, 3))
    boxes = [np.stack([one, one + random.uniform(0.1, 0.8, 3)]) for one in low]
    poses = [
        pose_at(
            random.uniform([-2.2, -1.7, 0.3], [2.2, 1.7, 2.2]),
            *random.uniform([-180, -40], [180, 40]),
        )
        for _ in range(12)
    ]
    frames = [frame_in_room(CAMERA, T, boxes, 0.01, i) for i, T in enumerate(poses)]
    all_ever = mapped(frames, new_map(remove_moved=False))
    kept = mapped(frames)
    is_true = near_surfaces(np.asarray(all_ever.center).T, boxes)
    before = np.asarray(all_ever.present) & is_true
    lost = before & ~np.asarray(kept.present)
    assert before.sum() > 2000
    assert lost.sum() <= 0.002 * before.sum()


def near_surfaces(points: np.ndarray, boxes: list[np.ndarray], within: float = 0.044) -> np.ndarray:
    """True for points this close to a wall or the outside of a box [m]."""
    to_wall = np.minimum(np.abs(points - ROOM[0]), np.abs(points - ROOM[1])).min(axis=1)
    is_near = to_wall <= within
    for low, high in boxes:
        outside = np.maximum(np.maximum(low - points, points - high), 0.0)
        inside = np.minimum(points - low, high - points).min(axis=1)
        distance = np.where(inside > 0.0, inside, np.linalg.norm(outside, axis=1))
        is_near |= distance <= within
    return is_near


def test_a_cable_that_was_seen_from_near_by_stays():
    """From afar hardly a pixel hits it; the pixels beside it see through its voxels."""
    cable = np.array([[0.5, -1.5, 1.2], [0.504, 1.5, 1.204]])
    near = [
        frame_in_room(CAMERA, pose_at((-0.2, 0.1 * i, 1.2), 0.0, 0.0), [cable]) for i in range(3)
    ]
    state = r3jax.empty_map(1 << 15, remove_moved=True)
    for frame in near:
        state = r3jax.integrate(state, frame, drop_edges=False)
    before = ghosts(state)
    assert before > 10
    far = [
        frame_in_room(CAMERA, pose_at((-2.2, 0.1 * i, 1.2), 0.0, 0.0), [cable]) for i in range(6)
    ]
    assert ghosts(mapped(far, state)) == before


@pytest.mark.parametrize("share", [0.1, 0.5])
def test_a_pane_that_some_pixels_measure_stays(share):
    pane = np.array([[0.6, -1.0, 0.4], [0.62, 1.0, 2.0]])
    solid, through = looks(8, boxes=[pane]), looks(8)
    random = np.random.default_rng(0)
    frames = []
    for a, b in zip(solid, through, strict=True):
        depth = np.where(random.random(a.depth.shape) < share, a.depth, b.depth)
        frames.append(r3jax.Frame(a.rgb, depth, a.T_world_camera, CAMERA))
    first = mapped(solid[:1])
    before = set(map(tuple, centers(first)[np.abs(centers(first)[:, 0] - 0.6) < 0.03]))
    after = set(map(tuple, centers(mapped(frames, first))))
    inner = {xyz for xyz in before if abs(xyz[1]) < 0.6 and 0.6 < xyz[2] < 1.8}
    assert len(inner) > 100
    assert len(inner - after) <= 0.05 * len(inner)


def test_holes_tell_nothing():
    state = mapped(looks(1, boxes=[PERSON]))
    blind = [r3jax.Frame(f.rgb, np.zeros_like(f.depth), f.T_world_camera, CAMERA) for f in looks(5)]
    assert ghosts(mapped(blind, state)) == ghosts(state)


def test_what_is_removed_comes_back_without_its_past():
    back = frame_in_room(CAMERA, pose_at((2.2, 0.0, 1.2), 180.0, -5.0), [PERSON])
    gone = mapped([*looks(1, boxes=[PERSON]), *looks(3)])
    again, fresh = mapped([back], gone), mapped([back])
    at = PERSON.mean(axis=0) * [0.0, 1.0, 1.0] + [PERSON[1, 0], 0.0, 0.0]
    rows = [int(r3jax.lookup(state, jnp.asarray(at, jnp.float32))) for state in (again, fresh)]
    for name in ("count", "visited", "resolution", "mean", "m2"):
        a, b = (
            np.asarray(getattr(s, name))[..., row]
            for s, row in zip((again, fresh), rows, strict=True)
        )
        np.testing.assert_array_equal(a, b, err_msg=name)
    assert float(again.count[rows[0]]) == 1.0


def test_a_larger_table_and_a_union_leave_removed_rows_behind():
    state = mapped([*looks(1, boxes=[PERSON]), *looks(3)])
    assert int(state.num_present) < int(state.num_occupied)
    grown = r3jax.grow(state, 1 << 16)
    assert int(grown.num_occupied) == int(grown.num_present) == int(state.num_present)
    assert grown.misses is not None
    assert int(np.asarray(grown.misses).sum()) == int(np.asarray(state.misses).sum())
    union = r3jax.merge(new_map(), state)
    assert int(union.num_occupied) == int(state.num_present)


def test_a_row_takes_one_byte_more():
    assert new_map().bytes_per_row == new_map(remove_moved=False).bytes_per_row + 1


@given(seed=st.integers(0, 10**6), holes=st.sampled_from([0.0, 0.2]))
@settings(max_examples=10)
def test_kernels_remove_what_the_formulas_remove(seed, holes):
    found = expected = r3jax.empty_map(CAPACITY, 0.05, 40, remove_moved=True)
    for i in range(4):
        frame = frame_of(seed + i // 2, holes)  # walls come and go
        found = kernels(found, frame, REACH, jnp.asarray(False))
        expected = formulas(expected, frame, REACH, jnp.asarray(False))
    present = np.asarray(expected.present)
    assert (np.asarray(found.present) == present).mean() > 0.999
    assert (np.asarray(found.misses) == np.asarray(expected.misses)).mean() > 0.999


def test_kernels_and_formulas_agree_on_a_person():
    frames = [*looks(2, boxes=[PERSON], noise=0.01), *looks(4, noise=0.01)]
    found = expected = new_map()
    for frame in frames:
        found = kernels(found, frame, jnp.float32(5.0), jnp.asarray(True))
        expected = formulas(expected, frame, jnp.float32(5.0), jnp.asarray(True))
    assert int(expected.num_present) < int(expected.num_occupied) - 100
    differ = np.asarray(found.present) != np.asarray(expected.present)
    assert differ.sum() <= 2
    keep = jnp.asarray(~differ) & expected.present
    rows = jnp.flatnonzero(keep)
    assert_same_map(
        found.take(rows, jnp.ones(len(rows), bool)), expected.take(rows, jnp.ones(len(rows), bool))
    )
