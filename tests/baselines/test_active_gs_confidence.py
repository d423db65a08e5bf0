"""Active-GS's confidence against float64, hand-worked cases, and its laws while the map grows."""

import functools

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import ndimage

import r3jax
from r3jax.baselines import confidence
from r3jax.baselines.confidence import aligned, no_sightings, pixel_normals, see
from r3jax.frame import Frame
from r3jax.geometry.cameras import Camera, look_at
from r3jax.geometry.voxels import unpack
from r3jax.kernels.constants import JOINED as CHUNK
from r3jax.mapping.join import grow

pytestmark = pytest.mark.full

CAMERA = Camera.from_fov(128, 12, 80.0)  # wide enough for pairs of pixels one and two apart
VOXEL, CAPACITY, RANGE = 0.1, 1 << 12, 5.0
FOCAL = 64.0 / np.tan(np.deg2rad(40.0))
REACHES = (1, 2)
POSITIONS = np.array([[0.0, 0.0, 1.0], [0.5, -0.4, 1.2], [3.0, 0.6, 0.8], [0.0, 0.0, 1.0]])
TARGETS = np.array([[2.0, 0.1, 1.1], [2.1, 0.4, 0.9], [1.2, 0.0, 1.0], [2.0, 0.3, 1.0]])


def slopes() -> tuple[np.ndarray, np.ndarray]:
    """u and v of the pixels' rays (u, v, 1)."""
    column, row = np.meshgrid(np.arange(128) + 0.5, np.arange(12) + 0.5)
    return (column - 64.0) / FOCAL, (row - 6.0) / FOCAL


def points_of(pose: np.ndarray, depth: np.ndarray) -> np.ndarray:
    u, v = slopes()
    rays = np.stack([u, v, np.ones_like(u)], axis=-1)
    return (rays * depth[..., None]) @ pose[:3, :3].T + pose[:3, 3]


@functools.cache
def frames() -> tuple[Frame, ...]:
    """A crooked room in the way, with a post, noise, holes, and things out of range."""
    random = np.random.default_rng(7)
    taken = []
    for position, target in zip(POSITIONS, TARGETS, strict=True):
        pose = np.asarray(look_at(position, target), np.float64)
        direction = points_of(pose, np.ones((12, 128))) - position
        walls = [((1.0, 0.3, 0.1), 2.5), ((-1.0, 0.2, 0.0), 0.3), ((0.0, 1.0, 0.0), 1.6),
                 ((0.0, -1.0, 0.2), 1.7)]  # fmt: skip
        hits = [(h - position @ np.array(n)) / (direction @ np.array(n)) for n, h in walls]
        depth = np.min(np.where(np.array(hits) > 0.0, hits, np.inf), axis=0)
        depth[:, 50:52] = np.minimum(depth[:, 50:52], 0.9)
        depth *= 1.0 + 0.004 * random.normal(size=depth.shape)
        depth[random.random(depth.shape) < 0.02] = 0.0
        depth[2:5, 100:104], depth[3, 20:23], depth[8:, 90:93] = 0.0, np.inf, 5.2
        depth = depth.astype(np.float32)
        # Points on a border of voxels would be a coin toss between float32 and float64.
        in_voxels = points_of(pose, np.where(np.isfinite(depth), depth, 0.0)) / VOXEL
        on_border = np.abs(in_voxels - np.round(in_voxels)).min(axis=-1) < 1e-4
        rgb = np.full((12, 128, 3), 0.5, np.float32)
        taken.append(Frame(rgb, np.where(on_border, 0.0, depth), pose, CAMERA))
    return tuple(taken)


@functools.cache
def maps() -> tuple[r3jax.MapState, ...]:
    """The map after each of the frames."""
    state, after = r3jax.empty_map(CAPACITY, VOXEL), []
    for frame in frames():
        state = r3jax.integrate(state, frame, RANGE)
        after.append(state)
    assert int(state.dropped) == 0
    return tuple(after)


def run(module, count: int = 4, start=None):
    seen = module.no_sightings() if start is None else start
    for frame, state in list(zip(frames(), maps(), strict=True))[:count]:
        seen = module.see(seen, state, frame, jnp.float32(RANGE))
    return seen


def rows_of(state: r3jax.MapState) -> dict[tuple, int]:
    index = np.stack([np.asarray(x) for x in unpack(state.key[0], state.key[1])], axis=1)
    return {tuple(index[i]): int(i) for i in np.flatnonzero(np.asarray(state.occupied))}


# ---- the oracle ----------------------------------------------------------------------------


def expected_normals(depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Vectors of all pixels, pixel by pixel and pair by pair, [H, W, 3] float64."""
    u, v = slopes()
    inverse = np.where(valid, 1.0 / np.where(valid, depth, 1.0), 0.0)
    vectors = np.zeros((*depth.shape, 3))
    for row, column in np.argwhere(valid):
        q = inverse[row, column]
        gradient = []
        for step in ((0, 1), (1, 0)):
            rises, runs = [], []
            for k in REACHES:
                ends = [(row + s * k * step[0], column + s * k * step[1]) for s in (-1, 1)]
                if not all(0 <= i < 12 and 0 <= j < 128 and valid[i, j] for i, j in ends):
                    continue
                low, high = (inverse[end] for end in ends)
                if abs(low + high - 2 * q) <= 0.06 * q + VOXEL * q * q:
                    rises.append(high - low)
                    runs.append(2.0 * k)
            fit = np.linalg.lstsq(np.array(runs)[:, None], np.array(rises), rcond=None)[0]
            gradient.append(FOCAL * fit[0] if rises else 0.0)
        a, b = gradient
        c = q - a * u[row, column] - b * v[row, column]
        vectors[row, column] = -np.array([a, b, c]) / q
    return vectors


@functools.cache
def expected(count: int) -> dict[tuple, dict]:
    """What is known of every voxel of the map after so many frames, from the list of views."""
    views: dict[tuple, list] = {}
    known = [set(rows_of(state)) for state in maps()]
    for frame, voxels in list(zip(frames(), known, strict=True))[:count]:
        depth, pose = (np.asarray(x, np.float64) for x in (frame.depth, frame.T_world_camera))
        valid = (depth > 0.0) & (depth <= RANGE)
        vectors = expected_normals(depth, valid) @ pose[:3, :3].T
        place = np.floor(points_of(pose, np.where(valid, depth, 1.0)) / VOXEL).astype(int)
        totals: dict[tuple, np.ndarray] = {}
        for i, j in np.argwhere(valid):
            voxel = tuple(place[i, j])
            totals[voxel] = totals.get(voxel, 0.0) + vectors[i, j]
        for voxel in set(totals) & voxels:
            offset = pose[:3, 3] - (np.array(voxel) + 0.5) * VOXEL
            normal = totals[voxel] / np.linalg.norm(totals[voxel])
            distance = np.linalg.norm(offset)
            views.setdefault(voxel, []).append((offset / distance, distance, normal))
    found = {}
    for voxel, seen in views.items():
        total = 0.0
        for t, (direction, distance, _) in enumerate(seen):
            normal = np.mean([n for _, _, n in seen[: t + 1]], axis=0)
            cosine = normal @ direction / np.linalg.norm(normal)
            total += max(0.0, 1.0 - distance / RANGE) * max(0.0, cosine)
        spread = np.linalg.norm(np.mean([d for d, _, _ in seen], axis=0))
        found[voxel] = {
            "views": len(seen),
            "cosine_sum": total,
            "confidence": float(np.clip(np.exp(1.0 - spread) * total, 0.0, 1.0)),
        }
    return found


# ---- laws, also run on mutants ---------------------------------------------------------------


def test_oracle() -> None:
    for count in (1, 4):
        seen = run(confidence, count)
        rows = rows_of(maps()[count - 1])
        truth = expected(count)
        assert set(truth) <= set(rows)
        for name in ("views", "cosine_sum", "confidence"):
            found = np.asarray(getattr(seen, name))
            np.testing.assert_allclose(
                [found[rows[voxel]] for voxel in truth],
                [one[name] for one in truth.values()],
                atol=2e-4,
                err_msg=name,
            )
        assert np.asarray(seen.views).sum() == sum(one["views"] for one in truth.values())
        unseen = np.asarray(seen.views) == 0
        assert not np.asarray(seen.confidence)[unseen].any()


def test_growth() -> None:
    """A map that grows between frames changes no bit of any voxel's sightings."""
    module = confidence
    before = run(module, 3)
    larger = grow(maps()[2], 4 * CAPACITY)
    moved = module.aligned(before, larger)
    assert moved.views.shape == (4 * CAPACITY,)
    assert_same(before, maps()[2], moved, larger)
    again = r3jax.integrate(larger, frames()[3], RANGE)
    last = module.see(before, again, frames()[3], jnp.float32(RANGE))
    assert_same(run(module, 4), maps()[3], last, again)


def assert_same(a, map_a, b, map_b) -> None:
    rows_a, rows_b = rows_of(map_a), rows_of(map_b)
    assert rows_a.keys() == rows_b.keys()
    from_a, from_b = (np.array([rows[voxel] for voxel in rows_a]) for rows in (rows_a, rows_b))
    assert np.any(from_a != from_b)
    for name in ("key", "views", "direction_sum", "cosine_sum", "normal_sum"):
        first, second = (np.asarray(getattr(x, name)) for x in (a, b))
        np.testing.assert_array_equal(first[..., from_a], second[..., from_b], err_msg=name)
    assert np.asarray(a.views).sum() == np.asarray(b.views).sum() > 0


def test_planes() -> None:
    """Without noise every pixel of a plane with pixels all round it finds its normal."""
    u, v = slopes()
    for plane in ([0.0, 0.0, -1.0], [0.7, 0.2, -0.6], [-0.2, -0.9, -0.25], [0.97, 0.0, -0.25]):
        normal = np.array(plane) / np.linalg.norm(plane)
        depth = -1.5 / (normal[0] * u + normal[1] * v + normal[2])
        valid = (depth > 0.2) & (depth < 20.0)
        is_inner = np.asarray(ndimage.binary_erosion(valid), dtype=bool)
        found = units(depth, valid)[is_inner[valid]]
        assert len(found) > 300
        np.testing.assert_allclose(found, np.tile(normal, (len(found), 1)), atol=3e-3)


def test_edges_and_holes() -> None:
    """Walls square to the camera stay so beside steps of depth and beside holes."""
    depth = np.where(np.arange(128)[None, :] < 60, 1.0, 2.0) * np.ones((12, 1))
    depth[7:] += 1.5
    valid = np.random.default_rng(0).random(depth.shape) < 0.7
    depth[~valid] = 0.0
    found = units(depth, valid)
    np.testing.assert_allclose(found, np.tile([0.0, 0.0, -1.0], (len(found), 1)), atol=1e-5)


def units(depth: np.ndarray, valid: np.ndarray) -> np.ndarray:
    vectors = confidence.pixel_normals(
        CAMERA, jnp.asarray(depth, jnp.float32), jnp.asarray(valid), jnp.float32(VOXEL)
    )
    vectors = np.asarray(vectors, np.float64).reshape(3, 12, 128).transpose(1, 2, 0)
    u, v = slopes()
    on_ray = np.sum(vectors * np.stack([u, v, np.ones_like(u)], axis=-1), axis=-1)
    np.testing.assert_allclose(on_ray[valid], -1.0, atol=1e-4)
    return vectors[valid] / np.linalg.norm(vectors[valid], axis=-1, keepdims=True)


def test_range() -> None:
    """A voxel of the map is not sighted by a pixel that measures it beyond the range."""
    module, middle = confidence, np.full(3, 0.5 * VOXEL)
    near, far = (wall_frame(middle - [d, 0.0, 0.0], middle, d) for d in (4.0, 5.2))
    state = r3jax.integrate(r3jax.empty_map(CAPACITY, VOXEL), near, RANGE)
    seen = module.see(module.no_sightings(), state, near, jnp.float32(RANGE))
    again = module.see(seen, state, far, jnp.float32(RANGE))
    np.testing.assert_array_equal(again.views, seen.views)
    assert np.asarray(seen.views).sum() > 10


def test_the_frames_reach_both_sides_of_every_branch():
    values = np.array([one["confidence"] for one in expected(4).values()])
    assert (values == 1.0).any()
    assert (values < 0.3).any()
    assert {one["views"] for one in expected(4).values()} == {1, 2, 3, 4}
    assert len(set(rows_of(maps()[3])) - set(expected(4))) < len(expected(4))
    frame = frames()[1]
    valid = (np.asarray(frame.depth) > 0.0) & (np.asarray(frame.depth) <= RANGE)
    flat = expected_normals(np.asarray(frame.depth, np.float64), valid)
    u, v = slopes()
    assert np.abs(np.sum(flat * np.stack([u, v, u * 0 + 1], -1), -1)[valid] + 1.0).max() < 1e-9


# ---- by hand ---------------------------------------------------------------------------------


def wall_frame(position: np.ndarray, target: np.ndarray, depth: float) -> Frame:
    rgb = np.full((12, 128, 3), 0.5, np.float32)
    pose = np.asarray(look_at(position, target))
    return Frame(rgb, np.full((12, 128), depth, np.float32), pose, CAMERA)


def confidence_of(*looks: tuple[np.ndarray, float]) -> float:
    """Confidence of the voxel round the origin, seen square on from these places."""
    state, seen = r3jax.empty_map(CAPACITY, VOXEL), no_sightings()
    middle = np.full(3, 0.5 * VOXEL)
    for position, depth in looks:
        frame = wall_frame(position + middle, middle, depth)
        state = r3jax.integrate(state, frame, RANGE)
        seen = see(seen, state, frame, jnp.float32(RANGE))
    return float(seen.confidence[rows_of(state)[0, 0, 0]])


def test_confidence_worked_out_by_hand():
    ahead, aside = np.array([-2.0, 0.0, 0.0]), np.array([0.0, -2.0, 0.0])
    far = np.array([-4.0, 0.0, 0.0])
    assert confidence_of((ahead, 2.0)) == pytest.approx(1.0 - 2.0 / 5.0, abs=1e-5)
    assert confidence_of((far, 4.0)) == pytest.approx(0.2, abs=1e-5)
    assert confidence_of((far, 4.0), (far, 4.0), (far, 4.0)) == pytest.approx(0.6, abs=1e-5)
    assert confidence_of((ahead, 2.0), (ahead, 2.0)) == 1.0  # 1.2, clipped
    # Square on from two sides: the normal turns half way; 4 m: 0.2 + 0.2 cos 45, spread cos 45.
    corner = confidence_of((far, 4.0), (2.0 * aside, 4.0))
    half = np.sqrt(0.5)
    assert corner == pytest.approx(np.exp(1.0 - half) * 0.2 * (1.0 + half), abs=1e-5)


def test_opposite_directions_widen_the_spread():
    """From both sides the mean direction is 0: e times the sum. The normals cancel out."""
    far = np.array([-4.0, 0.0, 0.0])
    both = confidence_of((far, 4.0), (-far, 4.0))
    assert both == pytest.approx(np.e * 0.2, abs=1e-3)
    assert both > confidence_of((far, 4.0), (far, 4.0)) > confidence_of((far, 4.0))


def test_a_noisy_wall_is_believed_to_be_flat():
    """1 % noise at 3 m moves neighbors by four times the distance between them."""
    camera = Camera.from_fov(512, 64, 60.0)
    tilt = np.array([0.5, 0.0, -np.sqrt(0.75)])
    u = (np.arange(512) + 0.5 - 256) / float(camera.fx)
    depth = np.tile(-2.5 / (tilt[0] * u + tilt[2]), (64, 1))
    depth *= 1.0 + 0.01 * np.random.default_rng(0).normal(size=depth.shape)
    every = jnp.ones(depth.shape, bool)
    vectors = pixel_normals(camera, jnp.asarray(depth, jnp.float32), every, jnp.float32(0.05))
    # Eight pixels across a voxel of 5 cm at 3 m.
    blocks = np.asarray(vectors).reshape(3, 8, 8, 64, 8).sum(axis=(2, 4)).reshape(3, -1)
    angle = np.rad2deg(np.arccos(np.clip(tilt @ blocks / np.linalg.norm(blocks, axis=0), -1, 1)))
    assert np.median(angle) < 15.0
    assert np.linalg.norm(np.cross(tilt, (blocks / np.linalg.norm(blocks, axis=0)).mean(1))) < 0.05


@settings(max_examples=15)
@given(st.lists(st.integers(0, 3), min_size=2, max_size=6))
def test_another_view_never_takes_away(order):
    state, seen = maps()[3], no_sightings()
    for number in order:
        after = see(seen, state, frames()[number], jnp.float32(RANGE))
        if seen.views.shape == after.views.shape:
            assert np.all(np.asarray(after.cosine_sum) >= np.asarray(seen.cosine_sum))
            assert np.all(np.asarray(after.views) >= np.asarray(seen.views))
        seen = after
    spread = np.linalg.norm(np.asarray(seen.direction_sum), axis=0)
    assert np.all(spread <= np.asarray(seen.views) * (1.0 + 1e-5))
    assert np.all((np.asarray(seen.confidence) >= 0.0) & (np.asarray(seen.confidence) <= 1.0))


def test_a_map_built_in_another_order_finds_the_sightings_again():
    """Same voxels, same capacity, other rows; what the map has not is forgotten."""
    seen = run(confidence, 3)
    rows = maps()[2]
    assert aligned(seen, rows) is seen
    other = r3jax.empty_map(CAPACITY, VOXEL)
    for frame in reversed(frames()[:3]):
        other = r3jax.integrate(other, frame, RANGE)
    moved = aligned(seen, other)
    assert_same(seen, rows, moved, other)
    nothing = aligned(seen, r3jax.empty_map(64, VOXEL))
    assert not np.asarray(nothing.views).any()


def test_a_frame_that_touches_more_voxels_than_join_at_once():
    """Every voxel is sighted once, however many chunks that takes."""
    camera = Camera.from_fov(128, 128, 90.0)
    depth = np.random.default_rng(1).uniform(1.0, 4.5, (128, 128)).astype(np.float32)
    frame = Frame(np.full((128, 128, 3), 0.5, np.float32), depth, np.eye(4), camera)
    state = r3jax.integrate(r3jax.empty_map(1 << 15, 0.05), frame, RANGE, drop_edges=False)
    seen = see(no_sightings(), state, frame, jnp.float32(RANGE))
    assert int(state.num_occupied) > CHUNK
    np.testing.assert_array_equal(seen.views, np.asarray(state.occupied, np.float32))
