"""The authors' own rule, on numbers worked out by hand and in a small hall against all voxels."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.baselines.r3con import R3con, R3conConfig
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.planning.registry import make_policy
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.panorama import panorama
from tests.planning.known_hall import CAMERA, EYE, SCORING, known, safe_mask
from tests.planning.rooms import pose_at

KEY = jax.random.key(4)


def candidates(**changes):
    """Three candidates and padding like the second: 0, 2, 1 cells; paths of 1, 2, 1 m."""
    plain = {
        "exploration": [0.0, 2.0, 1.0, 2.0],
        "rendering": [60.0, 100.0, 40.0, 100.0],
        "mean_lack": [0.5, 0.25, 0.8, 0.99],
        "utility": [60.0, 2100.0, 1040.0, 2100.0],
        "path": [1.0, 2.0, 1.0, np.inf],
    }
    return {name: np.array(changes.get(name, values)) for name, values in plain.items()}


def test_the_weight_of_the_path_is_the_greatest_mean_lack():
    """U of 3200, L of 4, w = 0.8: 60/3200 - 0.8/4, 2100/3200 - 1.6/4, 1040/3200 - 0.8/4."""
    total = R3con().weigh(candidates())
    np.testing.assert_allclose(total[:3], [-0.18125, 0.25625, 0.125])
    assert total[3] == -np.inf  # padding counts for nothing, not even its lack
    seen = R3con().weigh(candidates(mean_lack=[0.05, 0.1, 0.02, 0.99]))
    np.testing.assert_allclose(seen[1], 2100 / 3200 - 0.1 * 0.5)  # well rendered: paths are cheap


def test_what_cannot_be_reached_does_not_weigh_paths():
    total = R3con().weigh(candidates(path=[1.0, 2.0, np.inf, np.inf]))
    np.testing.assert_allclose(total[:2], [60 / 2160 - 0.5 / 3, 2100 / 2160 - 1.0 / 3])
    assert total[2] == -np.inf


def test_its_settings_are_the_authors():
    config = make_policy("r3con").config
    assert (config.num_candidates, config.radius, config.num_frontier) == (50, 2.0, 0)
    assert config.cell_weight == 1000.0
    with pytest.raises(ValueError, match="cell_weight"):
        R3conConfig(cell_weight=-1.0)


def here():
    """The middle of the safe cell that is nearest to where the hall was seen from [m]."""
    places = (np.argwhere(safe_mask()) + 0.5) * 0.2 + np.asarray(known()[1].origin, np.float64)
    return places[np.argmin(np.linalg.norm(places - EYE, axis=1))]


@pytest.fixture(scope="module")
def decided():
    state, grid = known()
    policy = make_policy("r3con", num_candidates=60, scoring=SCORING)
    first = policy.init(CAMERA, grid, key=KEY)
    decision, _, _ = policy.decide(first, state, grid, pose_at(here()), key=KEY)
    return policy, decision


def test_candidates_are_centers_of_other_cells_within_two_meters(decided):
    _, decision = decided
    grid = known()[1]
    cells = (decision.candidates[:, :3, 3] - np.asarray(grid.origin, np.float64)) / 0.2
    np.testing.assert_allclose(cells % 1.0, 0.5, atol=1e-3)
    assert np.linalg.norm(decision.candidates[:, :3, 3] - here(), axis=1).max() <= 2.0
    own = np.floor((here() - np.asarray(grid.origin)) / 0.2)
    assert not np.all(np.floor(cells) == own, axis=1).any()
    assert len(np.unique(np.floor(cells), axis=0)) == len(cells)


def test_utility_is_all_round_and_the_direction_comes_after(decided):
    """Against the panorama of the same place, whose bins are lambda1 cells and 1 - R."""
    policy, decision = decided
    state, grid = known()
    lattice = fibonacci_lattice(526)
    cone = lattice @ lattice.T >= np.cos(np.radians(35.0))  # the camera's 70 degrees, halved
    weighted = ScoringConfig(
        zbuffer_size=32, panorama_size=32, max_range=4.0, lambda1=policy.config.cell_weight
    )
    for k in (0, 7):
        place = jnp.asarray(decision.candidates[k, :3, 3], jnp.float32)
        bins = np.asarray(panorama(state, grid, CAMERA, place, weighted).bin_scores, np.float64)
        assert decision.utilities["utility"][k] == pytest.approx(bins.sum(), rel=1e-4)
        sums = cone @ bins
        best = sums[np.argmax(lattice @ decision.candidates[k, :3, 2])]
        assert best == pytest.approx(sums.max(), rel=1e-4)
        seen = decision.utilities["mean_lack"][k]
        assert 0.0 < seen <= 1.0


def test_what_sees_no_voxel_does_not_raise_the_weight_of_paths():
    state, grid = known()
    near = ScoringConfig(zbuffer_size=32, panorama_size=32, max_range=0.05)
    policy = make_policy("r3con", num_candidates=60, scoring=near)
    first = policy.init(CAMERA, grid, key=KEY)
    decision, _, _ = policy.decide(first, state, grid, pose_at(here()), key=KEY)
    assert np.all(decision.utilities["rendering"] == 0.0)
    assert np.all(decision.utilities["mean_lack"] == 0.0)


def test_parts_can_be_exchanged_one_by_one(decided):
    """A path weight given replaces the adaptive one; the cone's sum replaces that of all round."""
    total = R3con(R3conConfig(path_weight=0.5)).weigh(candidates())
    np.testing.assert_allclose(total[1], 2100 / 3200 - 0.5 * 0.5)
    with pytest.raises(ValueError, match="path_weight"):
        R3conConfig(path_weight=-1.0)
    state, grid = known()
    policy = make_policy("r3con", num_candidates=60, all_round=False, scoring=SCORING)
    first = policy.init(CAMERA, grid, key=KEY)
    narrow, _, _ = policy.decide(first, state, grid, pose_at(here()), key=KEY)
    wide = decided[1]
    np.testing.assert_array_equal(narrow.candidates, wide.candidates)  # it looks no other way
    lattice = fibonacci_lattice(526)
    weighted = ScoringConfig(zbuffer_size=32, panorama_size=32, max_range=4.0, lambda1=1000.0)
    for k in (0, 7):
        place = jnp.asarray(narrow.candidates[k, :3, 3], jnp.float32)
        bins = np.asarray(panorama(state, grid, CAMERA, place, weighted).bin_scores, np.float64)
        cone = lattice @ narrow.candidates[k, :3, 2] >= np.cos(np.radians(35.0))
        assert narrow.utilities["utility"][k] == pytest.approx(bins[cone].sum(), rel=2e-2)
        assert narrow.utilities["utility"][k] < wide.utilities["utility"][k]
