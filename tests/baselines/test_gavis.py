"""GAVIS's field of visibility and entropy against plain NumPy, their laws, and a small room."""

import itertools
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import r3jax
from r3jax.baselines import gavis
from r3jax.baselines.gavis import Gavis, GavisConfig
from r3jax.geometry.cameras import Camera, look_at
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import MapState, empty_map
from r3jax.planning.candidates import candidates_along
from tests.planning import walls

BINS = 64
LATTICE = fibonacci_lattice(BINS)


# ---- visibility ------------------------------------------------------------------------------


def words_of(bins: list[list[int]]) -> np.ndarray:
    """Bit masks of the bins from which each of n voxels was seen, [2, n]."""
    words = np.zeros((2, len(bins)), np.uint32)
    for voxel, seen in enumerate(bins):
        for k in seen:
            words[k // 32, voxel] |= np.uint32(1 << (k % 32))
    return words


def visibility(module, bins: list[list[int]], directions: np.ndarray, kappa: float) -> np.ndarray:
    """V of n voxels in n directions [n, 3]."""
    share = module.unseen_share(
        jnp.asarray(words_of(bins)),
        jnp.asarray(directions.T, jnp.float32),
        BINS,
        jnp.asarray(kappa, jnp.float32),
    )
    return 1.0 - np.asarray(share, np.float64)


def expected_visibility(seen: list[int], direction: np.ndarray, kappa: float) -> float:
    says = [np.exp(kappa * (LATTICE[k] @ direction - 1.0)) for k in set(seen)]
    return 1.0 - np.prod([1.0 - v for v in says])


def paper_bound(seen: list[int], direction: np.ndarray, kappa: float, photos: int) -> float:
    """1 - (1 - sum of V / |P|)^|P|, what the paper has in place of the product."""
    says = [np.exp(kappa * (LATTICE[k] @ direction - 1.0)) for k in set(seen)]
    return 1.0 - (1.0 - sum(says) / photos) ** photos


def draw_directions(seed: int, num: int) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(num, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_visibility() -> None:
    """Random voxels, directions and kappa against float64."""
    random = np.random.default_rng(3)
    for kappa in (0.0, 0.7, 4.0, 30.0):
        bins = [random.integers(0, BINS, size=n).tolist() for n in (0, 1, 1, 2, 3, 8, 20, 64)]
        directions = draw_directions(int(10 * kappa), len(bins))
        directions[1] = LATTICE[bins[1][0]]  # exactly as seen
        found = visibility(gavis, bins, directions, kappa)
        truth = [
            expected_visibility(seen, d, kappa) for seen, d in zip(bins, directions, strict=True)
        ]
        np.testing.assert_allclose(found, truth, atol=2e-6)
        assert found[0] == 0.0
        assert found[1] > 1.0 - 1e-5


SEEN = st.lists(st.integers(0, BINS - 1), max_size=12)
KAPPA = st.floats(0.0, 40.0)


@given(SEEN, SEEN, KAPPA, st.integers(0, 10_000))
def test_visibility_is_bounded_and_more_photos_never_lower_it(seen, more, kappa, seed):
    (d,) = draw_directions(seed, 1)
    before, after = (_visibility_now(x, d, kappa) for x in (seen, seen + more))
    assert 0.0 <= before <= after <= 1.0


@given(st.permutations(list(range(0, BINS, 9))), KAPPA, st.integers(0, 10_000))
def test_the_order_of_the_photos_does_not_matter(order, kappa, seed):
    (d,) = draw_directions(seed, 1)
    assert _visibility_now(order, d, kappa) == _visibility_now(sorted(order), d, kappa)


@given(SEEN, KAPPA, st.integers(0, 10_000))
def test_a_turn_of_everything_leaves_it(seen, kappa, seed):
    """The lattice has one symmetry: half a turn about a level axis, which reverses its order."""
    (d,) = draw_directions(seed, 1)
    half = 0.5 * (np.arctan2(LATTICE[0, 1], LATTICE[0, 0]) + np.arctan2(*LATTICE[-1, [1, 0]]))
    axis = np.array([np.cos(half), np.sin(half), 0.0])
    turn = 2.0 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(LATTICE @ turn, LATTICE[::-1], atol=1e-9)
    turned = _visibility_now([BINS - 1 - k for k in seen], turn @ d, kappa)
    np.testing.assert_allclose(turned, _visibility_now(seen, d, kappa), atol=1e-5)


@given(SEEN, KAPPA, st.integers(0, 10_000), st.integers(0, 40))
def test_it_is_what_the_paper_bounds_from_below(seen, kappa, seed, blind):
    """However many photos see nothing of the voxel: they are counted by the bound alone."""
    (d,) = draw_directions(seed, 1)
    found = _visibility_now(seen, d, kappa)
    photos = max(1, len(set(seen)) + blind)
    assert found >= paper_bound(seen, d, kappa, photos) - 1e-5
    if len(set(seen)) == 1:  # one photo and no other: the same
        np.testing.assert_allclose(found, paper_bound(seen, d, kappa, 1), atol=1e-5)


def _visibility_now(seen, direction, kappa) -> float:
    return float(visibility(gavis, [list(seen)], np.array([direction]), kappa)[0])


# ---- rays ------------------------------------------------------------------------------------

CAMERA = Camera(24, 16, 18.0, 16.0, 13.0, 7.0)
"""Neither square nor centered."""

CELL, RANGE, STEPS = 0.25, 1.8, 8


def beliefs_of(module, kappa: float = 4.0, opacity: float = 0.3, color: float = 5.0):
    return module.Beliefs(*(jnp.float32(x) for x in (kappa, opacity, color)))


def room(seed: int) -> tuple[OccupancyGrid, np.ndarray]:
    """Cells of which half are unexplored, and which."""
    random = np.random.default_rng(seed)
    log_odds = random.choice([-3.0, 0.0, 3.0], size=(11, 9, 7), p=[0.3, 0.5, 0.2])
    grid = OccupancyGrid(
        jnp.asarray(log_odds, jnp.float32),
        jnp.asarray([-1.3, -1.1, -0.9], jnp.float32),
        jnp.float32(CELL),
    )
    return grid, log_odds == 0.0


def scene_of_rays(module, seed: int, views: int = 2):
    random = np.random.default_rng(seed)
    shape = (views, 4, 6)
    hit = random.random(shape) < 0.6
    depth = np.where(hit, random.uniform(0.2, 2.5, shape), np.inf)
    offset = random.normal(size=(views, 3, 4, 6))
    bins = [random.integers(0, BINS, random.integers(0, 4)).tolist() for _ in range(views * 24)]
    visited = words_of(bins).reshape(2, views, 4, 6).swapaxes(0, 1)
    ends = module.RayEnds(
        jnp.asarray(hit),
        jnp.asarray(depth, jnp.float32),
        jnp.asarray(offset, jnp.float32),
        jnp.asarray(visited),
    )
    poses = np.stack(
        [
            np.asarray(look_at(random.uniform(-0.5, 0.5, 3), random.uniform(-1.0, 1.0, 3)))
            for _ in range(views)
        ]
    )
    return ends, bins, poses.astype(np.float64)


def expected_entropy(ends, bins, poses, grid, is_unexplored) -> np.ndarray:
    """Ray by ray and step by step, in float64."""
    origin = np.asarray(grid.origin, np.float64)
    values = []
    for v, pose in enumerate(poses):
        total = 0.0
        for i in range(4):
            for j in range(6):
                # Every fourth pixel of every fourth row of the buffer.
                ray = np.array([(4 * j + 0.5 - 13.0) / 18.0, (4 * i + 0.5 - 7.0) / 16.0, 1.0])
                end = min(float(ends.depth[v, i, j]) * np.linalg.norm(ray), RANGE)
                unit = pose[:3, :3] @ ray / np.linalg.norm(ray)
                passes = 1.0
                for step in range(STEPS):
                    t = (step + 0.5) * CELL
                    cell = np.floor((pose[:3, 3] + t * unit - origin) / CELL).astype(int)
                    is_inside = np.all((cell >= 0) & (cell < is_unexplored.shape))
                    if t < end and is_inside and is_unexplored[tuple(cell)]:
                        passes *= 1.0 - 0.3
                known = passes
                if ends.hit[v, i, j]:
                    offset = np.asarray(ends.offset[v, :, i, j], np.float64)
                    seen = bins[v * 24 + i * 6 + j]
                    known *= expected_visibility(seen, offset / np.linalg.norm(offset), 4.0)
                u = 1.0 - known
                parts = [p * np.log(p) for p in (u, known) if p > 1e-12]
                total += 5.0 * u - sum(parts)
        values.append(total / 24.0)
    return np.array(values)


def test_rays() -> None:
    module = gavis
    for seed in range(4):
        grid, is_unexplored = room(seed)
        ends, bins, poses = scene_of_rays(module, seed)
        found = module.entropy_of_views(
            ends, grid, CAMERA, jnp.asarray(poses, jnp.float32), jnp.float32(RANGE),
            beliefs_of(module), num_bins=BINS, num_steps=STEPS,
        )  # fmt: skip
        truth = expected_entropy(ends, bins, poses, grid, is_unexplored)
        np.testing.assert_allclose(np.asarray(found), truth, rtol=2e-4)
        assert len(np.unique(truth)) == len(poses)


def test_entropy() -> None:
    """0 for a ray that is known for certain, h for one that is not known at all."""
    module = gavis
    found = module.entropy(jnp.asarray([[0.0, 0.5, 1.0]], jnp.float32), beliefs_of(module))
    np.testing.assert_allclose(found[0], [0.0, np.log(2.0) + 2.5, 5.0], rtol=1e-6)


@given(st.floats(0.0, 1.0), st.integers(0, 30), st.floats(0.0, 1.0), st.booleans())
def test_more_unknown_cells_and_less_visibility_make_a_ray_less_known(unseen, cells, opacity, hit):
    share = lambda unseen, cells: float(
        gavis.unknown_share(
            jnp.full((1, 1), hit), jnp.full((1, 1), unseen), jnp.full((1, 1), float(cells)),
            beliefs_of(gavis, opacity=opacity),
        )[0, 0]
    )  # fmt: skip
    found = share(unseen, cells)
    assert 0.0 <= found <= 1.0 + 1e-6
    assert share(unseen, cells + 1) >= found - 1e-6
    assert share(min(1.0, unseen + 0.1), cells) >= found - 1e-6
    assert hit or share(0.0, cells) == found  # what ends nowhere has no voxel to be seen


# ---- the policy ------------------------------------------------------------------------------


def config(**changes) -> GavisConfig:
    return GavisConfig(num_candidates=5, num_frontier=0, scoring=walls.SCORING, **changes)


LOOKS = {
    "again": (walls.SEEN_FROM, (1.0, 0.0, 0.0)),
    "aslant": ((1.2, -1.1, 1.25), (0.6, 0.8, 0.0)),
    "from the side": ((1.8, 0.9, 1.25), (0.2, -1.0, 0.0)),
    "free space only": (walls.SEEN_FROM, (-1.0, -0.7, 0.0)),
    "the unknown": (walls.SEEN_FROM, (-0.4, 1.0, 0.0)),
}


def worth(map_state=None, unexplored_from_y: float = 1.0, **changes) -> dict[str, float]:
    """Utility of each of the looks at the wall, and at the unknown beside it."""
    state = walls.wall() if map_state is None else map_state
    where = walls.situation(state, walls.box(unexplored_from_y))
    places, axes = (np.array(part) for part in zip(*LOOKS.values(), strict=True))
    policy = Gavis(config(**changes))
    _, utilities = policy.score(where, candidates_along(places, axes), key=jax.random.key(0))
    return dict(zip(LOOKS, utilities["utility"], strict=True))


def test_what_no_photo_shows_is_worth_most():
    found = worth(unexplored_from_y=9.0)  # nothing is unexplored: the wall alone
    assert found["free space only"] == found["the unknown"] == 0.0
    assert found["again"] < found["aslant"]
    with_cells = worth()
    assert with_cells["the unknown"] > with_cells["again"] + 1.0
    # Its field of view reaches past the corner of what is known.
    assert with_cells["free space only"] <= with_cells["the unknown"]


def test_the_papers_ablations_are_settings():
    """Without virtual particles the unknown is worth nothing; isotropic, one look shows all."""
    assert worth(cell_opacity=0.0)["the unknown"] == 0.0
    isotropic = worth(unexplored_from_y=9.0, kappa=0.0)
    np.testing.assert_allclose(list(isotropic.values()), 0.0, atol=1e-5)


def test_a_map_that_holds_nothing_is_explored():
    found = worth(empty_map(1 << 10, walls.VOXEL))
    assert max(found, key=found.get) == "the unknown"


def wall_seen_from(places: Sequence[np.ndarray]) -> MapState:
    """The wall of `walls.wall`, in one look from each of the places."""
    state = walls.wall()
    points = np.asarray(state.center.T)[np.asarray(state.occupied)]
    for place in places:
        state = r3jax.integrate_points(
            state, points, np.full_like(points, 0.5), place.astype(np.float32)
        )
    return state


def test_the_order_of_the_looks_does_not_matter_and_their_number_does():
    places = [np.array([1.2, -1.1, 1.25]), np.array([1.5, 1.0, 0.4]), np.array([0.5, 0.2, 2.4])]
    first, *others = (worth(wall_seen_from(order), 9.0) for order in itertools.permutations(places))
    for other in others:
        np.testing.assert_array_equal(list(first.values()), list(other.values()))
    once = worth(wall_seen_from(places[:1]), 9.0)
    assert first["aslant"] < once["aslant"] < worth(unexplored_from_y=9.0)["aslant"]


@pytest.mark.parametrize(
    ("setting", "value"),
    [("kappa", -1.0), ("kappa", np.inf), ("cell_opacity", 1.5), ("color_entropy", np.nan)],
)
def test_impossible_settings_are_named(setting, value):
    with pytest.raises(ValueError, match=setting):
        config(**{setting: value})
