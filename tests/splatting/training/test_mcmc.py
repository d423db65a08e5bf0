"""Relocation against the formula in float64, noise against its covariance, and the books."""

import math

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from r3jax.splatting.scene import DEAD_LOGIT, GaussianScene
from r3jax.splatting.training import density
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.training.optimizer import Moments

ROWS = 40
CONFIG = TrainConfig(num_gaussians=ROWS, strategy="mcmc")
KEY = jax.random.key(3)


def some_scene(opacities, seed: int = 0) -> GaussianScene:
    """Rows of the given opacities (0: unused), all else random."""
    rng = np.random.default_rng(seed)
    opacity = np.asarray(opacities, dtype=np.float64)
    rows = len(opacity)
    logits = np.log(np.maximum(opacity, 1e-9) / (1.0 - opacity))
    fields = (
        rng.normal(size=(rows, 3)),
        rng.normal(size=(rows, 4)),
        rng.normal(-2.0, 0.8, (rows, 3)),
        np.where(opacity > 0.0, logits, DEAD_LOGIT),
        rng.normal(size=(rows, 4, 3)),
    )
    return GaussianScene(*(jnp.asarray(field, dtype=jnp.float32) for field in fields))


def some_moments(scene: GaussianScene) -> Moments:
    ones = jax.tree.map(jnp.ones_like, scene)
    return Moments(ones, jax.tree.map(jnp.ones_like, scene), jnp.asarray(7))


def row(tree, index):
    return jax.tree.map(lambda x: np.asarray(x[index]), tree)


def share64(opacity: float, number: int) -> tuple[float, float]:
    """Equation 9, term by term."""
    share = 1.0 - (1.0 - opacity) ** (1.0 / number)
    line = sum(
        math.comb(i - 1, k) * (-1.0) ** k * share ** (k + 1) / math.sqrt(k + 1)
        for i in range(1, number + 1)
        for k in range(i)
    )
    return share, opacity / line


def test_formula() -> None:
    opacities = np.array([0.006, 0.1, 0.5, 0.9, 0.99, 0.9999])
    numbers = np.array([1, 2, 3, 10, 51])
    grid = [(o, n) for o in opacities for n in numbers]
    expected = np.array([share64(o, int(n)) for o, n in grid])
    share, factor = density.shared(
        jnp.asarray([o for o, _ in grid], dtype=jnp.float32),
        jnp.asarray([n for _, n in grid], dtype=jnp.int32),
    )
    # 1 - opacity has a relative error of 6e-8 / 1e-4 in float32.
    np.testing.assert_allclose(share, expected[:, 0], rtol=2e-4)
    np.testing.assert_allclose(factor, expected[:, 1], rtol=2e-4)


def test_same_picture() -> None:
    """Through the middle N copies hide what one did, and along a line they do so in all."""
    x = np.linspace(-12.0, 12.0, 20001)
    for opacity, number in ((0.3, 2), (0.8, 5), (0.97, 30)):
        o = jnp.asarray([opacity], dtype=jnp.float32)
        share, factor = density.shared(o, jnp.asarray([number]))
        share, factor = float(share[0]), float(factor[0])
        assert abs(1.0 - (1.0 - share) ** number - opacity) < 1e-5
        before = opacity * np.exp(-0.5 * x**2)
        after = 1.0 - (1.0 - share * np.exp(-0.5 * (x / factor) ** 2)) ** number
        np.testing.assert_allclose(np.trapezoid(after, x), np.trapezoid(before, x), rtol=1e-4)


def test_noise() -> None:
    """rate x 5e5 x gate x R S^2 R^T times the same normal draws, in float64."""
    scene = some_scene([0.001, 0.005, 0.02, 0.1, 0.9, 0.0])
    rate = 3e-7
    after = density.perturbed(scene, jnp.asarray(rate), CONFIG, key=KEY)
    normal = np.asarray(jax.random.normal(KEY, (6, 3)), dtype=np.float64)
    R = Rotation.from_quat(np.asarray(scene.quats), scalar_first=True).as_matrix()
    S2 = np.exp(2.0 * np.asarray(scene.log_scales, dtype=np.float64))
    covariance = np.einsum("nij,nj,nkj->nik", R, S2, R)
    opacity = np.array([0.001, 0.005, 0.02, 0.1, 0.9, 0.0])
    gate = 1.0 / (1.0 + np.exp(-100.0 * ((1.0 - opacity) - 0.995)))
    gate[opacity == 0.0] = 0.0
    moved = 5e5 * rate * gate[:, None] * np.einsum("nij,nj->ni", covariance, normal)
    found = np.asarray(after.means, dtype=np.float64) - np.asarray(scene.means)
    np.testing.assert_allclose(found, moved, rtol=1e-3, atol=1e-6)
    assert np.abs(moved[0]).max() > 1e-4  # the test would notice


def test_respawn() -> None:
    """Rows 2 and 3 become copies of row 0, the only solid one: then three share its opacity."""
    scene = some_scene([0.9, 0.0, 0.003, 0.001])
    rows = jnp.array([False, False, True, True])
    only_first = jnp.array([0.9, 0.0, 0.0, 0.0])
    after, moments = density.respawn(scene, some_moments(scene), rows, CONFIG, key=KEY)
    share, factor = share64(float(only_first[0]), 3)
    for index in (0, 2, 3):
        copy, source = row(after, index), row(scene, 0)
        np.testing.assert_allclose(jax.nn.sigmoid(copy.opacity_logits), share, rtol=1e-3)
        scales = np.exp(source.log_scales) * factor
        np.testing.assert_allclose(np.exp(copy.log_scales), scales, rtol=1e-3)
        for name in ("means", "quats", "sh"):
            np.testing.assert_array_equal(getattr(copy, name), getattr(source, name))
        for kind in (moments.mean, moments.square):
            assert not any(np.any(x) for x in jax.tree.leaves(row(kind, index)))
    jax.tree.map(np.testing.assert_array_equal, row(after, 1), row(scene, 1))
    kept = row(some_moments(scene).mean, 1)
    jax.tree.map(np.testing.assert_array_equal, row(moments.mean, 1), kept)


def test_regularization() -> None:
    scene = some_scene([0.9, 0.2, 0.0, 0.0])
    alive = np.exp(np.asarray(scene.log_scales[:2], dtype=np.float64))
    expected = 0.01 * 0.55 + 0.01 * alive.mean()
    np.testing.assert_allclose(density.regularization(scene, CONFIG), expected, rtol=1e-4)


opacities = st.lists(st.sampled_from([0.0, 0.004, 0.3, 0.9]), min_size=ROWS, max_size=ROWS)
refine = jax.jit(density.relocate)


@given(opacities)
def test_faint_ones_move_the_number_grows_by_a_twentieth_and_nothing_overflows(values):
    scene = some_scene(values)
    after, _, info = refine(scene, some_moments(scene), CONFIG, key=KEY)
    before, faint = int(scene.is_alive.sum()), values.count(0.004)
    wanted = int(np.float32(0.05) * np.float32(before))
    solid = before - faint
    if solid == 0:  # nothing to move to
        assert [int(x) for x in info] == [0, 0, 0]
        np.testing.assert_array_equal(after.means, scene.means)
        return
    born = min(wanted, ROWS - before)
    assert [int(x) for x in info] == [born, faint, 0]
    assert int(after.is_alive.sum()) == before + int(info.born)
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(after))
    # Everything in use now stands where something solid stood before.
    stood = np.asarray(scene.means)[np.asarray(values) > 0.1]
    for mean in np.asarray(after.means)[np.asarray(after.is_alive)]:
        assert (mean == stood).all(axis=1).any()


def test_gaussians_are_drawn_in_proportion_to_their_opacity():
    values = np.array([0.8, 0.4, 0.2, 0.0] + [1e-7] * 2000)
    scene = some_scene(values)
    rows = jnp.asarray(values == 1e-7)
    after, _ = density.respawn(scene, some_moments(scene), rows, CONFIG, key=KEY)
    moved, stood = np.asarray(after.means)[np.asarray(rows)], np.asarray(scene.means)
    counts = np.array([(moved == stood[i]).all(axis=1).sum() for i in range(4)])
    assert counts.sum() == 2000
    # Five standard deviations of the binomial.
    expected = 2000 * np.array([4, 2, 1, 0]) / 7
    assert np.all(np.abs(counts - expected) <= 5.0 * np.sqrt(expected * (1 - expected / 2000)))
