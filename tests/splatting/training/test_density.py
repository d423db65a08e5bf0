"""Clone, split, prune and reset: cases by hand, and laws on random states."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene
from r3jax.splatting.training import density
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.density import (
    DensityStatistics,
    empty_statistics,
    refine,
    reset_opacities,
)
from r3jax.splatting.training.optimizer import Moments

ROWS = 8
EXTENT = jnp.asarray(2.0)
CONFIG = TrainConfig(num_gaussians=ROWS)  # split above 2 cm, prune above 20 cm here
KEY = jax.random.key(0)
STRONG, WEAK = 3e-4, 1e-4  # mean gradients round the threshold of 2e-4


def some_scene(sizes, opacities) -> GaussianScene:
    """Rows of the given sizes [m] and opacities (0: unused), all else distinct."""
    rng = np.random.default_rng(0)
    rows = len(sizes)
    log_scales = np.log(np.asarray(sizes))[:, None] + np.array([[0.0, -0.1, -0.2]])
    opacity = np.asarray(opacities, dtype=np.float64)
    logits = np.log(np.maximum(opacity, 1e-9) / (1.0 - opacity))
    fields = (
        rng.normal(size=(rows, 3)),
        rng.normal(size=(rows, 4)),
        log_scales,
        np.where(opacity > 0.0, logits, DEAD_LOGIT),
        rng.normal(size=(rows, 4, 3)),
    )
    return GaussianScene(*(jnp.asarray(field, dtype=jnp.float32) for field in fields))


def some_moments(scene: GaussianScene) -> Moments:
    mean = jax.tree.map(jnp.ones_like, scene)
    return Moments(mean, jax.tree.map(lambda x: 2.0 * jnp.ones_like(x), scene), jnp.asarray(7))


def statistics(mean_gradients) -> DensityStatistics:
    """Every row seen by three views."""
    gradient = jnp.asarray(mean_gradients, dtype=jnp.float32) * 3.0
    return DensityStatistics(gradient=gradient, count=jnp.full(len(mean_gradients), 3.0))


def row(tree, index: int):
    return jax.tree.map(lambda x: np.asarray(x[index]), tree)


def assert_rows_equal(a, b) -> None:
    jax.tree.map(np.testing.assert_array_equal, a, b)


def run(sizes, opacities, gradients, prunes_large=False):
    scene = some_scene(sizes, opacities)
    after, moments, info = density.refine(
        scene, some_moments(scene), statistics(gradients), EXTENT, prunes_large, CONFIG, key=KEY
    )
    return scene, after, moments, info


def test_clone() -> None:
    """Row 1 is small and pulled: an exact copy goes to row 3, the first unused one."""
    sizes = [0.01, 0.01, 0.01, 1.0, 1.0, 1.0, 1.0, 1.0]
    scene, after, moments, info = run(
        sizes, [0.5, 0.6, 0.7] + [0.0] * 5, [WEAK, STRONG, 0.0] + [STRONG] * 5
    )
    assert [int(x) for x in info] == [1, 0, 0]
    for index in (0, 1, 2, 4, 5, 6, 7):
        assert_rows_equal(row(after, index), row(scene, index))
    assert_rows_equal(row(after, 3), row(scene, 1))
    # The original keeps its moments, the clone has none.
    assert_rows_equal(row(moments.mean, 1), row(some_moments(scene).mean, 1))
    assert not any(np.any(x) for x in jax.tree.leaves(row((moments.mean, moments.square), 3)))


def test_split() -> None:
    """Row 0 is large and pulled: it is replaced by two children, in rows 0 and 2."""
    sizes = [0.1, 0.1] + [1.0] * 6
    scene, after, moments, info = run(sizes, [0.5, 0.6] + [0.0] * 6, [STRONG, WEAK] + [0.0] * 6)
    assert [int(x) for x in info] == [1, 0, 0]
    for index in (1, 3, 4, 5, 6, 7):
        assert_rows_equal(row(after, index), row(scene, index))
    parent = row(scene, 0)
    for index in (0, 2):
        child = row(after, index)
        np.testing.assert_allclose(np.exp(child.log_scales), np.exp(parent.log_scales) / 1.6, 1e-5)
        assert_rows_equal(
            (child.quats, child.opacity_logits, child.sh),
            (parent.quats, parent.opacity_logits, parent.sh),
        )
        assert 0.0 < np.linalg.norm(child.means - parent.means) < 0.1 * 4.5
        for kind in (moments.mean, moments.square):
            assert not any(np.any(x) for x in jax.tree.leaves(row(kind, index)))
    assert np.any(after.means[0] != after.means[2])


def test_prune() -> None:
    """Faint rows go; huge ones only when asked, and not if a split makes them small enough."""
    sizes = [0.01, 0.25, 0.25, 0.4, 0.01, 0.15, 0.01, 0.01]
    opacities = [0.004, 0.5, 0.5, 0.5, 0.006, 0.5, 0.0, 0.0]
    gradients = [STRONG, WEAK, STRONG, STRONG, WEAK, WEAK, 0.0, 0.0]
    _, after, _, info = run(sizes, opacities, gradients)
    assert int(info.pruned) == 1
    assert int(after.is_alive.sum()) == 6 - 1 + 2
    _, after, _, info = run(sizes, opacities, gradients, prunes_large=True)
    # Rows 0 (faint), 1 (0.25 m, not split) and 3 (0.4 / 1.6 = 0.25 m); row 2 splits to 0.16 m.
    assert int(info.pruned) == 3
    assert int(info.born) == 1
    assert float(jnp.exp(after.log_scales.max(axis=1))[after.is_alive].max()) < 0.2


def test_full() -> None:
    """One unused row for three that want it: the most pulled gets it, two are counted."""
    sizes, opacities = [0.01] * 7 + [1.0], [0.5] * 7 + [0.0]
    gradients = [0.0, STRONG, 0.0, 9.0 * STRONG, 2.0 * STRONG, 0.0, 0.0, 0.0]
    scene, after, _, info = run(sizes, opacities, gradients)
    assert [int(x) for x in info] == [1, 0, 2]
    assert_rows_equal(row(after, 7), row(scene, 3))
    for index in range(7):
        assert_rows_equal(row(after, index), row(scene, index))


def test_statistics() -> None:
    """Gradients in pixels become gradients per half image; unseen rows are not counted."""
    pull = jnp.array([[3e-6, 0.0], [0.0, 1e-6], [0.0, 0.0], [0.0, 0.0]])
    in_view = jnp.array([True, False, True, False])
    seen = density.observe(empty_statistics(4), pull, in_view, 200, 100)
    seen = density.observe(seen, 2.0 * pull, in_view, 200, 100)
    np.testing.assert_allclose(seen.gradient, [9e-4, 1.5e-4, 0.0, 0.0], rtol=1e-5)
    np.testing.assert_array_equal(seen.count, [2.0, 2.0, 2.0, 0.0])
    np.testing.assert_allclose(seen.mean_gradient, [4.5e-4, 7.5e-5, 0.0, 0.0], rtol=1e-5)


jitted_refine = jax.jit(refine)


@st.composite
def states(draw):
    """Scenes with any rows unused, faint, small or large, and any gradients."""
    pick = lambda *values: st.lists(st.sampled_from(values), min_size=ROWS, max_size=ROWS)
    sizes, opacities = draw(pick(0.01, 0.1, 0.5)), draw(pick(0.0, 0.003, 0.5))
    return some_scene(sizes, opacities), draw(pick(0.0, WEAK, STRONG, 2.0 * STRONG))


@given(states(), st.booleans())
def test_the_books_balance_and_bystanders_keep_every_bit(state, prunes_large):
    scene, gradients = state
    before = some_moments(scene)
    after, moments, info = jitted_refine(
        scene, before, statistics(gradients), EXTENT, jnp.asarray(prunes_large), CONFIG, key=KEY
    )
    alive = int(scene.is_alive.sum()) + int(info.born) - int(info.pruned)
    assert int(after.is_alive.sum()) == alive <= ROWS
    assert int(info.dropped) == 0 or alive == ROWS
    opaque = np.asarray(jax.nn.sigmoid(scene.opacity_logits)) > 0.005
    huge = prunes_large & np.asarray(scene.log_scales.max(axis=1) > np.log(0.2))
    bystander = opaque & ~huge & (np.asarray(gradients) < 2e-4)
    for old, new in ((scene, after), (before.mean, moments.mean), (before.square, moments.square)):
        assert_rows_equal(row(new, bystander), row(old, bystander))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after))


def test_a_reset_lowers_opacities_and_forgets_their_moments_alone():
    scene = some_scene([0.1] * 4, [0.5, 0.01, 0.003, 0.0])
    before = some_moments(scene)
    after, moments = reset_opacities(scene, before, CONFIG)
    opacity = jax.nn.sigmoid(after.opacity_logits)
    np.testing.assert_allclose(opacity, [0.01, 0.01, 0.003, 0.0], rtol=1e-4)
    np.testing.assert_array_equal(after.is_alive, scene.is_alive)
    for kind, old in ((moments.mean, before.mean), (moments.square, before.square)):
        assert not np.any(kind.opacity_logits)
        restored = eqx.tree_at(lambda s: s.opacity_logits, kind, old.opacity_logits)
        assert_rows_equal(restored, old)
    restored = eqx.tree_at(lambda s: s.opacity_logits, after, scene.opacity_logits)
    assert_rows_equal(restored, scene)
