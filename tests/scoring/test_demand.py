"""What views repair: float64 sums voxel by voxel, the laws of facility location, the audit's gains.

What is seen from where is the package's own (`test_visibility` holds it against rays).
"""

import functools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from r3jax.audit.diagnosis import ask
from r3jax.audit.diagnosis import demand_of as audit_demand_of
from r3jax.audit.gains import view_gains
from r3jax.geometry.cameras import look_at
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_points
from r3jax.scoring import batch
from r3jax.scoring import demand as real
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.views import panorama_view, pinhole_view
from r3jax.scoring.visibility import seen_in
from r3jax.scoring.voxels import voxels_of
from tests.mutants import Modules, Mutant, assert_caught, each, load
from tests.scoring.test_foresight import CAMERA, CAPACITY, poses_of, seen_map

pytestmark = pytest.mark.full

NUM = 3  # standpoints; one shape: one compile
FOCAL = jnp.float32(26.0)  # of who asks, not that of the views
CONFIG = ScoringConfig(max_range=2.5, panorama_size=64, panorama_bins=40)
REAL: Modules = {"demand": real}
seeds = st.integers(0, 1000)


def places_of(seed: int) -> jax.Array:
    """Standpoints before the wall, one of them close to it."""
    rng = np.random.default_rng([seed, 3])
    far = rng.uniform([-1.0, -1.2, -0.8], [0.8, 1.2, 0.8], (NUM - 1, 3))
    return jnp.asarray(np.concatenate([far, [[1.75, rng.uniform(-0.7, 0.0), -0.2]]]), jnp.float32)


@functools.cache
def actions(module) -> SimpleNamespace:
    """The functions of a module, or of a mutant of it, compiled once for all examples."""
    return SimpleNamespace(
        demand=jax.jit(lambda v, places: module.demand_of(v, places, FOCAL, CONFIG)),
        gain=jax.jit(lambda v, d, pose: module.gain_of(v, d, CAMERA, pose, CONFIG)),
        after=jax.jit(lambda v, d, pose: module.cover_after(v, d, CAMERA, pose, CONFIG)),
        value=jax.jit(module.value_of),
    )


def start(modules: Modules, seed: int):
    do, voxels = actions(modules["demand"]), voxels_of(seen_map(seed))
    return do, voxels, do.demand(voxels, places_of(seed))


@jax.jit
def panorama_mask(voxels, position):
    return seen_in(voxels, panorama_view(position, CONFIG), CONFIG)[1].mask


@jax.jit
def pinhole_mask(voxels, pose):
    return seen_in(voxels, pinhole_view(CAMERA, pose, CONFIG), CONFIG)[1].mask


def kernel(cosine, delta, ratio):
    """K of the docstring, term by term."""
    b = np.clip(cosine, 0.0, 1.0) ** 2
    return b * delta ** (2.0 * (1.0 - b)) * np.minimum(ratio, 1.0) ** (1.0 - delta * b)


class Oracle:
    """The same in float64 NumPy, a standpoint and a voxel at a time."""

    def __init__(self, voxels, places, focal=float(FOCAL)):
        self.voxels, self.places, self.focal = voxels, np.float64(places), focal
        self.centers = np.float64(voxels.center).T
        self.delta = np.float64(voxels.delta)
        self.lattice = fibonacci_lattice(64)
        words = np.asarray(voxels.visited)
        bits = [words[k // 32] >> np.uint32(k % 32) & np.uint32(1) for k in range(64)]
        self.visited = np.stack(bits, axis=1).astype(bool)
        self.seen = np.stack([np.asarray(panorama_mask(voxels, p)) for p in places])
        self.cover = np.full(self.seen.shape, np.inf)
        size = np.zeros(self.seen.shape)
        for s, i in zip(*np.nonzero(self.seen), strict=True):
            r, distance = self.towards(i, self.places[s])
            cosine = (self.lattice[self.visited[i]] @ r).max()
            ratio = np.float64(voxels.resolution[i]) * distance / self.focal
            self.cover[s, i] = kernel(cosine, self.delta[i], ratio)
            size[s, i] = 1.0 / max(distance, 1.0) ** 2
        self.worth = size * self.seen.any(axis=0).sum() / size.sum()

    def towards(self, i, place):
        offset = place - self.centers[i]
        distance = np.linalg.norm(offset)
        return offset / distance, distance

    def cover_after(self, position, shown):
        """After a view from a position that shows some voxels."""
        after = self.cover.copy()
        for s, i in zip(*np.nonzero(self.seen & shown), strict=True):
            q, distance = self.towards(i, position)
            q = self.lattice[np.argmax(self.lattice @ q)]
            r, asked = self.towards(i, self.places[s])
            ratio = (float(CAMERA.focal) / distance) / (self.focal / asked)
            after[s, i] = max(after[s, i], kernel(q @ r, self.delta[i], ratio))
        return after

    def value(self, cover):
        return np.where(self.seen, self.worth * np.where(self.seen, cover, 0.0), 0.0).sum(axis=0)


def law_oracle(modules: Modules, seed: int = 0) -> None:
    do, voxels, demand = start(modules, seed)
    oracle = Oracle(voxels, places_of(seed))
    np.testing.assert_allclose(demand.cover, oracle.cover, atol=2e-4)
    np.testing.assert_allclose(
        float(jnp.sum(do.value(voxels, demand))), oracle.value(oracle.cover).sum(), rtol=1e-4
    )
    np.testing.assert_allclose(do.value(voxels, demand), oracle.value(oracle.cover), atol=1e-3)
    for pose in poses_of(seed):
        shown = np.asarray(pinhole_mask(voxels, pose))
        after = oracle.cover_after(np.float64(pose)[:3, 3], shown)
        np.testing.assert_allclose(do.after(voxels, demand, pose).cover, after, atol=2e-4)
        expected = (oracle.value(after) - oracle.value(oracle.cover)).sum()
        assert float(do.gain(voxels, demand, pose)) == pytest.approx(expected, rel=1e-3, abs=1e-3)
        assert expected > 0.1
    # Some voxels are asked for by none, by one, by several.
    assert set(oracle.seen[:, np.asarray(voxels.present)].sum(axis=0)) >= {0, 1, 2}


@pytest.mark.parametrize("seed", [0, 1, 2, 5])
def test_cover_value_and_gain_follow_their_formulas(seed):
    law_oracle(REAL, seed)


def law_worths(modules: Modules, seed: int = 0) -> None:
    """Worths sum to 1 per voxel asked for, on average; near the wall they are capped."""
    do, voxels, demand = start(modules, seed)
    full = eqx.tree_at(
        lambda d: d.cover, demand, jnp.where(jnp.isfinite(demand.cover), 1.0, jnp.inf)
    )
    importance = np.asarray(do.value(voxels, full))
    asked = np.isfinite(np.asarray(demand.cover)).any(axis=0)
    assert importance[asked].mean() == pytest.approx(1.0, rel=1e-5)
    assert (importance[~asked] == 0.0).all()
    assert importance.max() <= NUM * float(demand.scale) * (1 + 1e-5)


@given(seeds)
def test_a_voxel_is_worth_one_on_average(seed):
    law_worths(REAL, seed)


def law_facility_location(modules: Modules, seed: int = 0) -> None:
    """F(A) = value after the views of A: grows, by less the more views there are."""
    do, voxels, none = start(modules, seed)
    rng = np.random.default_rng(seed)
    view, *others = [poses_of(seed + 1000 * k)[0] for k in rng.permutation(4)]
    smaller = none
    for other in others:
        larger = do.after(voxels, smaller, other)
        assert (np.asarray(larger.cover) >= np.asarray(smaller.cover)).all()
        before, after = (float(do.gain(voxels, d, view)) for d in (smaller, larger))
        assert 0.0 <= after <= before * (1 + 1e-5) + 1e-4
        smaller = larger
    # What a view adds is the difference of values.
    taken = do.after(voxels, smaller, view)
    value = [float(jnp.sum(do.value(voxels, d))) for d in (smaller, taken)]
    assert value[1] - value[0] == pytest.approx(after, rel=1e-3, abs=2e-3)


@given(seeds)
def test_the_value_of_views_is_monotone_and_submodular(seed):
    law_facility_location(REAL, seed)


def law_once(modules: Modules, seed: int = 0) -> None:
    """The same view twice: the second time adds nothing; and the order of views is no matter."""
    do, voxels, demand = start(modules, seed)
    first, second = poses_of(seed)
    once = do.after(voxels, demand, first)
    assert 0.0 <= float(do.gain(voxels, once, first)) < 1e-4
    np.testing.assert_array_equal(do.after(voxels, once, first).cover, once.cover)
    np.testing.assert_array_equal(
        do.after(voxels, once, second).cover,
        do.after(voxels, do.after(voxels, demand, second), first).cover,
    )


@given(seeds)
def test_a_repeated_view_adds_nothing_and_the_order_does_not_matter(seed):
    law_once(REAL, seed)


def test_what_nobody_can_see_is_worth_nothing():
    do, voxels, demand = start(REAL, 0)
    hidden = np.asarray(voxels.present) & ~np.isfinite(np.asarray(demand.cover)).any(axis=0)
    assert hidden.sum() > 3
    assert (np.asarray(do.value(voxels, demand))[hidden] == 0.0).all()
    nobody = eqx.tree_at(lambda d: d.cover, demand, jnp.full((NUM, CAPACITY), jnp.inf))
    assert float(do.gain(voxels, nobody, poses_of(0)[0])) == 0.0


def plate():
    """A small plate, seen once, aslant: from a standpoint 3 m away all of it looks as large."""
    y, z = (a.ravel() for a in np.meshgrid(np.arange(-0.2, 0.2, 0.05), np.arange(-0.2, 0.2, 0.05)))
    points = np.stack([np.full_like(y, 3.05), y, z], axis=1).astype(np.float32)
    state = empty_map(CAPACITY, 0.1)
    for gray in (0.4, 0.55, 0.5):
        rgb = np.full_like(points, gray)
        state = integrate_points(state, points, rgb, np.float32([1.9, 1.9, 0.2]), CAMERA.focal)
    return state


def test_one_standpoint_gains_what_the_audit_says():
    """Where views lie on one side of what is asked for, kappa's box stays empty; none is too far:
    then, with one standpoint that asks, both mean the same."""
    config = ScoringConfig(lambda1=0.0, panorama_size=64)
    state, place = plate(), jnp.zeros((1, 3))
    eyes = [[0.7, 1.1, 0.1], [1.1, 1.2, -0.4], [1.6, 1.5, 0.8], [1.2, 1.1, 1.2]]
    poses = np.stack([np.asarray(look_at(np.array(e), np.array([3.0, 0.0, 0.0]))) for e in eyes])
    grid = OccupancyGrid(-3.0 * jnp.ones((3, 3, 3)), jnp.zeros(3), jnp.float32(0.2))
    asked = audit_demand_of(state, np.zeros((1, 3)), config)
    answers = ask(state, asked, CAMERA.focal, config)
    expected = view_gains(state, grid, asked, answers, CAMERA, poses, config)
    assert expected.min() > 0.5
    voxels = voxels_of(state)
    demand = real.demand_of(voxels, place, CAMERA.focal, config)
    gain = jax.jit(lambda pose: real.gain_of(voxels, demand, CAMERA, pose, config))
    found = np.array([float(gain(jnp.asarray(pose))) for pose in poses])
    distance = np.linalg.norm(np.asarray(voxels.center)[:, np.asarray(voxels.present)], axis=0)
    worth = float(demand.scale) / distance**2
    assert worth.max() / worth.min() < 1.02
    assert (found >= expected * worth.min() - 1e-3).all()
    assert (found <= expected * worth.max() + 1e-3).all()


def test_panoramas_sum_gains_by_direction_and_cells_as_before():
    state, places = seen_map(0), places_of(0)
    odds = np.random.default_rng(2).choice([-3.0, 0.0, 3.0], (5, 6, 4)).astype(np.float32)
    origin, cell = jnp.asarray([-1.5, -1.0, -0.8]), jnp.float32(0.4)
    grid = OccupancyGrid(jnp.asarray(odds), origin, cell)
    positions = np.float32([[0.1, 0.2, 0.0], [-0.4, -0.3, 0.3], [0.6, 0.5, -0.2]])

    def bins(weight, standpoints):
        config = eqx.tree_at(lambda c: c.lambda1, CONFIG, jnp.float32(weight))
        found = batch.score_positions(
            state, grid, CAMERA, positions, config, standpoints=standpoints
        )
        return np.asarray(found.bin_scores, np.float64)

    gains, cells = bins(0.0, places), bins(3.0, None) - bins(0.0, None)
    voxels = voxels_of(state)
    oracle = Oracle(voxels, places, float(CAMERA.focal))
    for gain, position in zip(gains, positions, strict=True):
        after = oracle.cover_after(position, np.asarray(panorama_mask(voxels, position)))
        gained = oracle.value(after) - oracle.value(oracle.cover)
        which = np.argmax((oracle.centers - position) @ fibonacci_lattice(40).T, axis=1)
        expected = np.bincount(which, gained, minlength=40)
        np.testing.assert_allclose(gain, expected, atol=1e-3)
        assert expected.sum() > 0.2
    assert (cells.sum(axis=1) > 10.0).all()
    np.testing.assert_allclose(bins(3.0, places) - gains, cells, atol=1e-3)


def test_other_numbers_do_not_compile_again():
    voxels, traces = voxels_of(seen_map(0)), []

    @jax.jit
    def gain(demand, pose, config):
        traces.append(None)
        return real.gain_of(voxels, demand, CAMERA, pose, config)

    demand, found = actions(real).demand(voxels, places_of(0)), []
    for reach, seed in ((2.5, 0), (1.4, 0), (2.5, 1)):
        config = eqx.tree_at(lambda c: c.max_range, CONFIG, jnp.float32(reach))
        found.append(float(gain(demand, poses_of(seed)[0], config)))
    assert len(traces) == 1
    assert len(set(found)) == 3


CHAIN = ("r3jax.scoring.directions", "r3jax.scoring.demand")
MUTANTS = [
    Mutant("demand", "worth * jnp.maximum(offer - cover[s], 0.0)", "worth * (offer - cover[s])",
           law_facility_location),
    Mutant("demand", "].max(best", "].set(best", law_facility_location),
    Mutant("demand", "worth * jnp.maximum(offer - cover[s], 0.0)", "worth * offer", law_once),
    Mutant("demand", "(1.0 - delta * bias)", "(1.0 - bias)", law_oracle),
    Mutant("demand", "KAPPA * (1.0 - bias) * log_delta", "(1.0 - bias) * log_delta", law_oracle),
    Mutant("demand", "jnp.minimum(log_ratio, 0.0)", "log_ratio", law_oracle),
    Mutant("demand", "_kernel(cosine * cosine,", "_kernel(cosine,", law_oracle),
    Mutant("demand", "ahead = jnp.maximum(along, 0.0)", "ahead = along", law_oracle),
    Mutant("demand", "focal / (distance * demand.focal)", "1.0 / distance", law_oracle),
    Mutant("demand", "0.5 * jnp.log(squared)", "jnp.log(squared)", law_oracle),
    Mutant("demand", "[:, bins]\n", "[:, 63 - bins]\n", law_oracle),
    Mutant("demand", "part.resolution * distance / focal", "part.resolution / focal", law_oracle),
    Mutant("demand", "return 1.0 / jnp.square(jnp.maximum(distance, NEAREST))",
           "return 1.0 / jnp.square(distance)", law_worths),
    Mutant("demand", "demand.scale / jnp.maximum(squared, NEAREST * NEAREST)",
           "demand.scale / squared", law_oracle),
    Mutant("demand", "num_asked / jnp", "1.0 / jnp", law_worths),
    Mutant("demand", "jnp.full(num, jnp.inf)", "jnp.zeros(num)", law_oracle),
    Mutant("directions", "jnp.maximum(best, jnp.where(is_visited, cosine, -1.0))",
           "jnp.maximum(best, cosine)", law_oracle),
]  # fmt: skip


@pytest.mark.mutant
def test_laws_hold_without_a_fault():
    modules = load(CHAIN)
    for law in (law_oracle, law_worths, law_facility_location, law_once):
        law(modules)


@each(MUTANTS)
def test_mutant_is_caught(mutant):
    assert_caught(CHAIN, mutant)
