"""Training that grows: other views and newborn Gaussians on the way."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.splatting.scene import empty_scene
from r3jax.splatting.training.initialize import initialize
from r3jax.splatting.training.train import Addition, Growth, fit, where_new, with_newborn
from r3jax.splatting.training.train_step import start_state
from tests.splatting.ball import ball_views, config


@pytest.fixture(scope="module")
def views():
    return ball_views()


def test_the_same_views_again_change_no_bit(views):
    settings = config(iterations=30)
    asked = []

    def add(step, scene):
        asked.append((step, int(scene.is_alive.sum())))
        return Addition(views)

    grown = fit(views, settings, growth=Growth(10, add))
    plain = fit(views, settings)
    jax.tree.map(np.testing.assert_array_equal, grown.scene, plain.scene)
    assert [step for step, _ in asked] == [10, 20]  # not at the end: nothing would come of it


def test_other_views_are_trained_on_from_there(views):
    half = views.take(np.array([0, 1, 2, 3] * 2))
    other = views.take(np.array([4, 5, 6, 7] * 2))
    grown = fit(half, config(iterations=30), growth=Growth(20, lambda step, scene: Addition(other)))
    plain = fit(half, config(iterations=30))
    np.testing.assert_array_equal(grown.history.loss[:20], plain.history.loss[:20])
    assert np.all(grown.history.loss[20:] != plain.history.loss[20:])


def test_newborn_gaussians_take_unused_rows(views):
    scene = initialize(views, 50, 60, 1)
    count = int(scene.is_alive.sum())
    state = start_state(scene)
    ones = lambda tree: jax.tree.map(jnp.ones_like, tree)
    state = eqx.tree_at(
        lambda s: (s.moments.mean, s.moments.square), state,
        (ones(state.moments.mean), ones(state.moments.square)),
    )  # fmt: skip
    born = initialize(views, 5, 8, 1)
    num = int(born.is_alive.sum())
    after = with_newborn(state, born)
    is_new = np.asarray(after.scene.is_alive) & ~np.asarray(scene.is_alive)
    assert is_new.sum() == num
    np.testing.assert_array_equal(after.scene.means[is_new], born.means[:num])
    np.testing.assert_array_equal(after.scene.sh[is_new], born.sh[:num])
    old = np.asarray(scene.is_alive)
    np.testing.assert_array_equal(after.scene.means[old], scene.means[old])
    assert not np.asarray(after.moments.mean.means)[is_new].any()
    assert np.all(np.asarray(after.moments.mean.means)[old] == 1.0)
    assert int(after.dropped) == 0
    full = with_newborn(after, initialize(views, 50, 50, 1))
    assert int(full.scene.is_alive.sum()) == 60
    lost = int(initialize(views, 50, 50, 1).is_alive.sum()) - (60 - count - num)
    assert int(full.dropped) == lost > 0


def test_only_what_is_new_is_born(views):
    scene = initialize(views.take(np.array([0, 1])), 200, 200, 0)
    assert not where_new(scene, scene).is_alive.any()
    assert where_new(scene, empty_scene(10, 0)) is scene
    moved = eqx.tree_at(lambda s: s.means, scene, scene.means + 100.0)
    np.testing.assert_array_equal(where_new(moved, scene).is_alive, scene.is_alive)
    half = eqx.tree_at(lambda s: s.means, scene, scene.means.at[::2].add(100.0))
    found = np.asarray(where_new(half, scene).is_alive)
    np.testing.assert_array_equal(found[::2], np.asarray(scene.is_alive)[::2])
    assert not found[1::2].any()


def test_growth_leaves_no_checkpoints(views, tmp_path):
    with pytest.raises(ValueError, match="folder"):
        fit(views, config(), folder=tmp_path, growth=Growth(5, lambda s, x: Addition(views)))
