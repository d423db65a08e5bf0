"""Unexplored cells in view, counted and weighed by distance: single cells, U_G, lots."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.mapping.occupancy import OccupancyGrid
from r3jax.planning.candidates import candidates_along
from r3jax.planning.decision import net_utility
from r3jax.planning.policies import unseen
from r3jax.planning.policies.unseen import Unseen, UnseenDepth
from tests.mutants import Modules, Mutant, assert_caught, each
from tests.planning import walls

KEY = jax.random.key(0)
PLACES = np.array([walls.SEEN_FROM, [-1.0, 0.4, 1.25], walls.SEEN_FROM, [-1.0, -2.0, 0.5]])
AXES = np.array([[0.0, 1.0, 0.0], [0.3, 1.0, 0.2], [-1.0, -0.7, 0.0], [0.4, 1.0, 0.2]])
CANDIDATES = candidates_along(PLACES, AXES)
POSES = CANDIDATES.T_world_camera
POLICIES = {"Unseen": "cells", "UnseenDepth": "depth"}


def box_where(unexplored: list[tuple[int, int, int]]) -> OccupancyGrid:
    """All free but single cells."""
    grid = walls.box(unexplored_from_y=9.0)
    log_odds = np.array(grid.log_odds)
    for cell in unexplored:
        log_odds[cell] = 0.0
    return OccupancyGrid(jnp.asarray(log_odds), grid.origin, grid.cell_size)


def score(modules: Modules, name: str, grid: OccupancyGrid, key=KEY):
    where = walls.situation(walls.wall(), grid)
    policy = getattr(modules["unseen"], name)(walls.config(len(POSES)))
    scored, utilities = policy.score(where, CANDIDATES, key=key)
    assert scored is CANDIDATES
    return where, utilities


def law_single_cells(modules: Modules) -> None:
    """Two unexplored cells, and which of the four views see them; the range is 4 m."""
    cells = [(12, 20, 6), (16, 21, 7)]
    grid = box_where(cells)
    origin, size = np.asarray(grid.origin, np.float64), 0.2
    depth, count = np.zeros(4), np.zeros(4)
    for cell in cells:
        offset = origin + (np.array(cell) + 0.5) * size - PLACES
        inside = np.einsum("cji,cj->ci", POSES[:, :3, :3], offset)
        slope = np.tan(np.deg2rad(30.0)) * inside[:, 2]
        is_seen = (np.abs(inside[:, :2]) < slope[:, None]).all(axis=1)
        is_seen &= np.linalg.norm(offset, axis=1) <= 4.0
        count += is_seen
        depth += is_seen * np.linalg.norm(offset, axis=1) / 4.0
    assert set(count) == {0.0, 1.0, 2.0}
    for name, which in POLICIES.items():
        _, utilities = score(modules, name, grid)
        np.testing.assert_array_equal(utilities["cells"], count)
        np.testing.assert_allclose(utilities["depth"], depth, rtol=1e-6)
        np.testing.assert_array_equal(utilities["utility"], utilities[which])


def law_counts_are_exploration(modules: Modules) -> None:
    """The count is U_G of `ours`, exactly."""
    where, utilities = score(modules, "Unseen", walls.box(unexplored_from_y=1.0))
    expected = walls.cells_in_view(where, POSES)
    assert (expected > 20).sum() >= 2
    np.testing.assert_array_equal(utilities["utility"], expected)
    assert np.all(utilities["depth"] <= expected)


def law_hopeless_cells_do_not_count(modules: Modules) -> None:
    """What is shut off by matter is out of every view."""
    grid = walls.box(unexplored_from_y=1.0)
    log_odds = np.array(grid.log_odds)
    log_odds[:, 17] = 3.0  # y = 0.9 to 1.1: a wall that the voxel map does not know
    shut = OccupancyGrid(jnp.asarray(log_odds), grid.origin, grid.cell_size)
    _, utilities = score(modules, "Unseen", shut)
    assert not utilities["cells"].any()


def law_lots_where_nothing_is_unseen(modules: Modules) -> None:
    """All explored: chance decides, by the key, and not the path alone."""
    for name in POLICIES:
        everything = box_where([])
        _, first = score(modules, name, everything)
        _, again = score(modules, name, everything)
        _, other = score(modules, name, everything, key=jax.random.key(1))
        assert not first["cells"].any()
        assert not first["depth"].any()
        assert np.all((first["utility"] > 0.0) & (first["utility"] < 1.0))
        np.testing.assert_array_equal(first["utility"], again["utility"])
        assert len(set(first["utility"]) | set(other["utility"])) == 8


MUTANTS = [
    Mutant("unseen", "view.cell_distance / view", "view.cell_distance * view", law_single_cells),
    Mutant("unseen", "depth if weighted else cells", "depth", law_single_cells),
    Mutant("unseen", "weighted=True", "weighted=False", law_single_cells),
    Mutant(
        "greedy",
        "situation.scoring_grid,\n        situation.camera",
        "situation.grid,\n        situation.camera",
        law_hopeless_cells_do_not_count,
    ),
    Mutant("unseen", "if not utility.any()", "if utility.any()", law_counts_are_exploration),
    Mutant("unseen", "if not utility.any()", "if False", law_lots_where_nothing_is_unseen),
]
LAWS = [
    law_single_cells,
    law_counts_are_exploration,
    law_hopeless_cells_do_not_count,
    law_lots_where_nothing_is_unseen,
]


@pytest.mark.parametrize("law", LAWS, ids=lambda law: law.__name__)
def test_unexplored_cells(law):
    law({"unseen": unseen})


@each(MUTANTS)
def test_faults_are_noticed(mutant):
    assert_caught(
        (
            "r3jax.planning.greedy",
            "r3jax.planning.policies.unseen",
        ),
        mutant,
    )


@pytest.mark.parametrize("policy_class", [Unseen, UnseenDepth])
def test_path_lengths_weigh_as_for_ours(policy_class):
    utilities = {"utility": np.array([3.0, 1.0, 4.0]), "path": np.array([2.0, 0.5, np.inf])}
    policy = policy_class(walls.config(3))
    expected = net_utility(utilities["utility"], utilities["path"], 0.5)
    np.testing.assert_array_equal(policy.weigh(utilities), expected)
