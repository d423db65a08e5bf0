"""Tiles: whatever the path, what is at hand and what is not are the map without tiles."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import r3jax
from r3jax.errors import InputError
from r3jax.geometry.voxels import EMPTY_WORD
from r3jax.kernels.constants import JOINED
from r3jax.kernels.mapping.paging import (
    MOVES,
    STAYS,
    fill_rows,
    hash_of,
    place_keys,
    sort_rows,
)
from r3jax.mapping.join import grow, merge
from r3jax.mapping.state import MapState, empty_map
from r3jax.mapping.table import find, hash_key
from r3jax.mapping.tile_files import open_tile_folder
from r3jax.mapping.tiles import (
    Tiles,
    capacity_for,
    check_view,
    lattice_for,
    longest_ray,
    merge_worlds,
    page,
    whole_map,
)
from r3jax.mapping.update import integrate

CAPACITY, EDGE = 1 << 12, 8
CONFIG = r3jax.MappingConfig(voxel_size=0.25, cell_size=0.5, max_range=2.0, capacity=CAPACITY)
CAMERA = r3jax.Camera.from_fov(EDGE, EDGE, 80.0)
ENDLESS = np.array([[-np.inf] * 3, [np.inf] * 3])
LATTICE = lattice_for(CONFIG, CAMERA, ENDLESS)
ARRAYS = ("visited", "count", "mean", "m2", "resolution", "misses")


def no_tiles(folder=None) -> Tiles:
    return Tiles(LATTICE, (0, 0, 0), CAPACITY, folder=folder)


@pytest.fixture(scope="session", params=["memory", "disk"])
def folder(request, tmp_path_factory):
    """None, or a folder for all tiles: memory has room for none."""
    on_disk = request.param == "disk"
    return open_tile_folder(tmp_path_factory.mktemp("tiles"), 0) if on_disk else None


def first_map() -> MapState:
    return empty_map(CAPACITY, CONFIG.voxel_size, remove_moved=True)


def sorted_rows(state: MapState) -> dict[str, np.ndarray]:
    """All voxels in the order of their keys."""
    rows = np.flatnonzero(np.asarray(state.present))
    key = np.asarray(state.key)[:, rows]
    order = np.lexsort(key)
    found = {name: getattr(state, name) for name in ARRAYS}
    fields = {n: np.asarray(x)[..., rows][..., order] for n, x in found.items() if x is not None}
    return fields | {"key": key[:, order]}


def assert_same_map(a: MapState, b: MapState) -> None:
    a, b = sorted_rows(a), sorted_rows(b)
    for name in a:
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


def frame_at(position, seed: int) -> r3jax.Frame:
    """Noise, holes and the open; half of the frames look far, through what others have seen."""
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.3, 2.4, (EDGE, EDGE)) if seed % 2 else np.full((EDGE, EDGE), 1.9)
    depth[rng.random(depth.shape) < 0.1] = rng.choice([0.0, np.inf])
    ahead = np.array([[1, 0.1, 0], [-1, 0, 0.2], [0, 1, 0.1], [0.1, 0.1, -1]][seed % 4], np.float32)
    pose = r3jax.pose_along(jnp.asarray(position, jnp.float32), jnp.asarray(ahead))
    rgb = rng.random((EDGE, EDGE, 3)).astype(np.float32)
    return r3jax.Frame(jnp.asarray(rgb), jnp.asarray(depth, jnp.float32), pose, CAMERA)


def add(state: MapState, tiles: Tiles | None, position, seed: int):
    if tiles is not None:
        state, _, tiles = page(state, {}, tiles, np.asarray(position, np.float64))
    frame = frame_at(position, seed)
    return integrate(state, frame, CONFIG.max_range, False), tiles


PATHS = st.lists(
    st.tuples(*(st.integers(-8, 8) for _ in range(3)), st.integers(0, 11)), min_size=1, max_size=8
)


@pytest.mark.full
@settings(max_examples=8)
@given(PATHS, PATHS)
def test_whatever_the_path_the_union_is_the_map_without_tiles(folder, first, second):
    """Jumps of any length, removals, a fork that shares its tiles, and the union of both ends."""
    whole, (state, tiles) = first_map(), (first_map(), no_tiles(folder))
    for *place, seed in first:
        whole, _ = add(whole, None, place, seed)
        state, tiles = add(state, tiles, place, seed)
    assert_same_map(whole_map(state, tiles), whole)
    fork_whole, fork = whole, (state, tiles)
    for *place, seed in second:
        fork_whole, _ = add(fork_whole, None, place, seed)
        fork = add(*fork, place, seed)
    assert_same_map(whole_map(*fork), fork_whole)
    assert_same_map(whole_map(state, tiles), whole)
    assert folder is None or not tiles.voxels.memory
    nothing = {"log_odds": np.zeros(LATTICE.shape, np.float32)}
    both, _, tiles = merge_worlds([(state, nothing, tiles), (fork[0], nothing, fork[1])])
    # Tables of at least one chunk: XLA rounds shorter ones in another way.
    assert_same_map(whole_map(both, tiles), merge(grow(whole, JOINED), grow(fork_whole, JOINED)))


@settings(max_examples=5)
@given(PATHS)
def test_no_voxel_is_in_two_places_and_none_at_hand_is_out_of_the_block(folder, path):
    state, tiles = first_map(), no_tiles(folder)
    for *place, seed in path:
        state, tiles = add(state, tiles, place, seed)
        block = set(LATTICE.block(tiles.middle))
        assert not block & set(tiles.voxels)
        center = np.asarray(state.center)[:, np.asarray(state.present)].astype(np.float64)
        assert {tuple(t) for t in LATTICE.tiles_of(center).T.tolist()} <= block


def test_a_table_that_was_moved_has_no_rows_of_removed_voxels():
    state, tiles = first_map(), no_tiles()
    state, tiles = add(state, tiles, (0.0, 0.0, 0.0), 1)
    removed = replace(state, count=jnp.where(jnp.arange(CAPACITY) % 2 == 0, 0.0, state.count))
    moved, _, tiles = page(removed, {}, tiles, np.array([5.0, 0.0, 0.0]))
    assert int(moved.num_occupied) == int(moved.num_present)
    assert int(moved.num_present) + tiles.num_voxels == int(removed.num_present) > 0


def test_what_leaves_takes_at_most_34_bytes_a_voxel():
    state, tiles = first_map(), no_tiles()
    for seed in range(9):
        state, tiles = add(state, tiles, (0.0, 0.0, 0.0), seed)
    _, _, tiles = page(state, {}, tiles, np.array([500.0, 0.0, 0.0]))
    num, boxes = tiles.num_voxels, 48 * len(tiles.voxels)
    assert num == int(state.num_present) > 100
    assert tiles.nbytes - boxes <= 34 * num


def test_a_crowded_block_gets_a_larger_table_and_a_sparse_one_the_first_again():
    state = first_map()
    for x in range(60):
        state, _ = add(state, None, (0.1 * x, 0.03 * x, 0.0), 2 * x + 1)
    assert int(state.num_present) > 0.7 * 256
    small = Tiles(LATTICE, (99, 0, 0), 256)
    near, _, tiles = page(state, {}, small, np.array([2.0, 0.0, 0.0]))
    assert near.capacity > 256
    assert int(near.dropped) == 0
    away, _, tiles = page(near, {}, tiles, np.array([300.0, 0.0, 0.0]))
    assert away.capacity == 256
    assert_same_map(whole_map(away, tiles), state)


@given(st.lists(st.tuples(*(st.integers(-20, 20) for _ in range(3))), min_size=1, max_size=6))
def test_cells_come_back_as_they_left(path):
    """Against a dictionary of all cells of the world."""
    tiles, layers = no_tiles(), {"log_odds": np.zeros(LATTICE.shape, np.float32)}
    layers["looks"] = np.zeros(LATTICE.shape, np.int32)
    known: dict[tuple[int, ...], tuple[float, int]] = {}
    state = empty_map(2, CONFIG.voxel_size)
    rng = np.random.default_rng(len(path))
    for position in path:
        state, layers, tiles = page(state, layers, tiles, np.array(position, np.float64))
        layers = {name: x.copy() for name, x in layers.items()}
        first = (np.array(tiles.middle) - 2) * np.array(LATTICE.cells)
        for cell in rng.integers(0, LATTICE.shape, (4, 3)):
            value = (float(np.float32(rng.normal())), int(rng.integers(1, 9)))
            layers["log_odds"][tuple(cell)], layers["looks"][tuple(cell)] = value
            known[tuple((cell + first).tolist())] = value
        expected = {name: np.zeros_like(x) for name, x in layers.items()}
        for cell, (odds, looks) in known.items():
            at = np.array(cell) - first
            if np.all((at >= 0) & (at < LATTICE.shape)):
                expected["log_odds"][tuple(at)], expected["looks"][tuple(at)] = odds, looks
        for name, x in layers.items():
            np.testing.assert_array_equal(x, expected[name])


def test_the_block_stays_while_the_robot_does():
    state, tiles = first_map(), no_tiles()
    edge = float(LATTICE.edge[0])
    for x in (0.1, edge + 0.3, 0.2, -0.3):
        same = page(state, {}, tiles, np.array([x, 0.5, 0.5]))
        assert same[0] is state
        assert same[2] is tiles


@pytest.mark.parametrize("wide", [60.0, 90.0, 110.0])
def test_the_block_holds_all_that_a_frame_can_reach(wide):
    """A range is a depth: in the corner of an image a point is farther away."""
    camera = r3jax.Camera.from_fov(64, 48, wide)
    lattice = lattice_for(r3jax.MappingConfig(), camera, ENDLESS)
    corner = 5.0 * longest_ray(camera)
    assert corner > 5.0 * np.hypot(1.0, np.tan(np.deg2rad(wide / 2.0)))
    assert np.all(2.0 * lattice.edge - 0.5 > corner)


def test_an_axis_that_fits_is_not_cut():
    floor = np.array([[-np.inf, -np.inf, 0.0], [np.inf, np.inf, 2.6]])
    lattice = lattice_for(r3jax.MappingConfig(), r3jax.Camera.from_fov(64, 64, 60.0), floor)
    assert lattice.num == (5, 5, 1)
    assert lattice.shape[2] == 15
    assert np.array_equal(lattice.tiles_of(np.array([[7.0], [-3.0], [99.0]]))[2], [0])


def test_capacity_follows_from_range_and_voxels():
    camera = r3jax.Camera.from_fov(64, 64, 60.0)
    sizes = []
    for config in (r3jax.MappingConfig(), r3jax.MappingConfig(voxel_size=0.1)):
        lattice = lattice_for(config, camera, ENDLESS)
        sizes.append(capacity_for(lattice, config.voxel_size))
    assert sizes == [1 << 20, 1 << 18]


@pytest.mark.parametrize(("height", "rows"), [(2.6, 1 << 20), (5.4, 1 << 21), (9.9, 1 << 22)])
def test_a_box_of_several_stories_has_room_for_all_of_them(height, rows):
    config, box = r3jax.MappingConfig(), ENDLESS.copy()
    box[:, 2] = 0.0, height
    lattice = lattice_for(config, r3jax.Camera.from_fov(64, 64, 60.0), box)
    assert capacity_for(lattice, config.voxel_size) == rows


def test_far_positions_and_wider_cameras_are_refused():
    with pytest.raises(InputError, match="subtract an origin"):
        page(first_map(), {}, no_tiles(), np.array([1e6, 0.0, 0.0]))
    with pytest.raises(InputError, match="widest"):
        check_view(no_tiles(), r3jax.Camera.from_fov(8, 8, 120.0), 2.0, 0.25)


@given(st.lists(st.tuples(st.integers(0, 2**32 - 1), st.integers(0, 2**31 - 1)), min_size=8,
                max_size=8))  # fmt: skip
def test_the_host_hashes_as_the_table_does(keys):
    keys = np.array(keys, np.uint32).T
    found = [hash_of(low, high) for low, high in keys.T]
    np.testing.assert_array_equal(found, np.asarray(hash_key(*jnp.asarray(keys))))


@given(st.integers(0, 10**6), st.integers(0, 44))
@settings(max_examples=20)
def test_keys_placed_on_the_host_are_found_in_the_table(seed, num):
    """Beside rows that stay, up to the load at which tables grow."""
    rng = np.random.default_rng(seed)
    index = rng.choice(1000, 44, replace=False)
    keys = np.stack([index, index * 3]).astype(np.uint32)
    table = np.full((2, 64), EMPTY_WORD, np.uint32)
    stay, come = np.split(keys, [44 - num], axis=1)
    table[:, place_keys(stay, np.zeros(64, bool))] = stay
    # As when a block moves: rows that the first probe finds stay, all others are placed again.
    block = np.array([[0] * 3, [2**21] * 3], np.uint32)
    kinds = sort_rows(table, table[1] != EMPTY_WORD, *block)
    moved = np.flatnonzero(kinds == MOVES)
    others = np.concatenate([table[:, moved], come], axis=1)
    rows, after = place_keys(others, kinds == STAYS), np.zeros_like(table)
    for old, values, new in zip(table, come, after, strict=True):
        fill_rows(old, kinds, moved, values, rows, np.uint32(EMPTY_WORD), new)
    found = find(jnp.asarray(after), jnp.asarray(keys), jnp.ones(44, bool))
    np.testing.assert_array_equal(after[:, np.asarray(found)], keys)
    assert (after[1] != EMPTY_WORD).sum() == 44
