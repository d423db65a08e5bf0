"""How any setting of any config reaches a cell, its run and its record."""

import dataclasses

import jax
import numpy as np
import pytest

from experiments.settings import find_setting, known_settings, with_settings
from r3jax.apps.benchmark.cells import Cell, Conditions
from r3jax.exploration.clock import compilations
from r3jax.geometry.cameras import Camera
from r3jax.mapping.state import empty_map
from r3jax.mapping.update import integrate_points
from tests.apps.benchmark.tiny import CONDITIONS
from tests.planning.rooms import center, grid_of, pose_at

KNOWN = known_settings(Conditions())
CELL = Cell("flat", "a" * 64, "r3", 0, CONDITIONS, "b" * 64, 100)

ODD = {
    "policy.kappa": "one", "policy.delta": "pairwise", "training.strategy": "mcmc",
    "training.background": "white", "loop.until": "psnr:20", "training.sh_degree": 1,
    "loop.gaze": "ahead",
}  # fmt: skip


OF_AHEAD = {"horizon", "num_spread", "beam", "branching", "view_seconds"}
"""Settings of one policy alone."""


def changed(setting):
    """Another value that can work."""
    if setting.name in ODD:
        return ODD[setting.name]
    if setting.kind is bool:
        return not setting.default
    return 2 * setting.default if setting.default else setting.kind(7)


@pytest.mark.parametrize("name", KNOWN)
def test_every_setting_makes_another_cell_and_its_default_the_same(name):
    here = known_settings(CONDITIONS)[name]
    assert here.sentence
    assert find_setting(name, KNOWN) == KNOWN[name]
    cell = CELL
    if here.field in OF_AHEAD:
        with pytest.raises(ValueError, match=f"policy 'r3' has no setting {here.field}"):
            with_settings(CELL, {name: changed(here)})
        cell = dataclasses.replace(CELL, policy="r3-ahead")
    other = with_settings(cell, {name: changed(here)})
    assert other.name != cell.name
    assert with_settings(cell, {name: here.default}).name == cell.name
    assert with_settings(other, {name: here.default}).name == cell.name


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"policy.kappa": "ball"}, "kappa"),
        ({"policy.num_candidates": 2, "policy.num_frontier": 3}, "num_frontier"),
        ({"map.voxel_size": 0.0}, "voxel_size"),
        ({"training.gaussians": 500}, "capacity 400"),
    ],
)
def test_a_point_that_cannot_work_is_refused_before_anything_is_run(values, message):
    with pytest.raises(ValueError, match=message):
        with_settings(CELL, values)


@pytest.mark.full
@pytest.mark.parametrize("name", ["r3", "r3-pano"])
def test_a_sweep_over_numbers_compiles_once(name):
    free = np.zeros((12, 12, 10), dtype=bool)
    free[2:10, 2:10, 2:8] = True
    grid, pose, key = grid_of(free), pose_at(center(5, 5, 4)), jax.random.key(0)
    walls = np.stack([center(x, y, z) for x in (1, 10) for y in range(10) for z in range(8)])
    state = integrate_points(
        empty_map(1 << 10), walls, np.full(walls.shape, 0.5, np.float32), pose[:3, 3]
    )

    def decide(**given):
        few = {"num_candidates": 6, "num_frontier": 2, "scoring.panorama_size": 32}
        policy = CONDITIONS.policy(
            name, few | {k.replace("_of_", "."): v for k, v in given.items()}
        )
        memory = policy.init(Camera.from_fov(24, 24, 60.0), grid, key=key)
        decision, _, _ = policy.decide(memory, state, grid, pose, key=key)
        return decision

    first = decide(scoring_of_lambda1=1.0)
    decide(scoring_of_lambda1=16.0)  # what is compiled a step later, too
    before = compilations.count
    others = [decide(scoring_of_lambda1=x, lambda2=y) for x, y in [(4.0, 0.1), (999.5, 0.0)]]
    decide(radius=0.8, scoring_of_tolerance=1.0, scoring_of_max_range=3.0)
    assert compilations.count == before
    utility = [d.utilities["utility"] for d in (first, *others)]
    assert np.all(utility[2] > utility[1])
    assert np.all(utility[1] > utility[0])
