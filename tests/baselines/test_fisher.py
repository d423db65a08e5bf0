"""FisherRF's information against dense differentiation, and its scores and batches by hand."""

import dataclasses
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from r3jax.baselines import fisherrf
from r3jax.baselines.fisherrf import Form, greedy_batch, known_information, scores
from r3jax.geometry.cameras import look_at
from r3jax.splatting import projection
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.render import render
from tests.splatting.clouds import random_cloud, safe_pixels, view

COUNT = 50
BEHIND = (0.2, 0.5, 0.1)
CONFIG = RasterConfig(max_intersections=1 << 12)
PARTS = ("means", "log_scales", "opacity_logits", "sh")


def a_case():
    """A cloud and a view in which float32 has nothing to decide."""
    scene, (camera, pose) = random_cloud(3, COUNT, 1), view(16, 16)
    assert safe_pixels(scene, camera, pose).all()
    return scene, camera, jnp.asarray(pose)


def dense_information(scene, camera, pose, *, quirk: bool):
    """From the definition: dense Jacobians of every pixel's channel sum.

    By the parameters themselves; or, with the quirk, by sizes and opacities, whose squares are
    multiplied by the derivative of the activation once.
    """
    means, sizes, sh = scene.means, jnp.exp(scene.log_scales), scene.sh
    opacity = jax.nn.sigmoid(scene.opacity_logits)

    def channel_sums(means, log_scales, logits, sh):
        shown = dataclasses.replace(
            scene, means=means, log_scales=log_scales, opacity_logits=logits, sh=sh
        )
        config = RasterConfig(backend="reference")
        return render(shown, camera, pose, jnp.asarray(BEHIND), config).rgb.sum(axis=-1)

    def by_activated(means, sizes, opacity, sh):
        logits = jnp.log(opacity) - jnp.log1p(-opacity)
        return channel_sums(means, jnp.log(sizes), logits, sh)

    if quirk:
        jacobian = jax.jacfwd(by_activated, (0, 1, 2, 3))(means, sizes, opacity, sh)
        slopes = (1.0, sizes, opacity * (1.0 - opacity), 1.0)
    else:
        plain = (means, scene.log_scales, scene.opacity_logits, sh)
        jacobian = jax.jacfwd(channel_sums, (0, 1, 2, 3))(*plain)
        slopes = (1.0, 1.0, 1.0, 1.0)
    squares = [jnp.sum(g * g, axis=(0, 1)) for g in jacobian]
    return {n: np.asarray(s * q) for n, s, q in zip(PARTS, slopes, squares, strict=True)}


def test_information_is_the_sum_of_squared_dense_jacobians() -> None:
    scene, camera, pose = a_case()
    with pytest.MonkeyPatch.context() as patch:
        # Forward mode cannot pass a gradient that is written out.
        patch.setattr(projection, "_sum_harmonics", projection._sum_harmonics.fun)
        expected = {q: dense_information(scene, camera, pose, quirk=q) for q in (False, True)}
    for quirk in (False, True):
        form = Form(quirk=quirk, background=BEHIND)
        found, overflow = fisherrf.information(CONFIG, scene, camera, pose, form)
        assert int(overflow) == 0
        assert not np.asarray(found.quats).any()
        for name in PARTS:
            a, b = np.asarray(getattr(found, name)), expected[quirk][name]
            assert np.all(np.abs(a - b) <= 1e-3 * np.abs(b) + 1e-5 * b.max()), name


def test_opacities_of_one_say_nothing_and_disturb_nothing():
    """Long trainings end in them, and float32 knows no slope there."""
    scene, camera, pose = a_case()
    full = replace(scene, opacity_logits=scene.opacity_logits.at[0].set(40.0))
    for quirk in (False, True):
        found, _ = fisherrf.information(CONFIG, full, camera, pose, Form(quirk=quirk))
        assert float(found.opacity_logits[0]) == 0.0
        assert all(np.isfinite(part).all() for part in jax.tree.leaves(found))


def numbers(*values):
    """A scene-shaped tree of one Gaussian with these numbers in its mean."""
    scene = random_cloud(0, 1, 0)
    blank = jax.tree.map(jnp.zeros_like, scene)
    return replace(blank, means=jnp.asarray([values], jnp.float32))


def gains_by_hand() -> None:
    """H_v = 3, 1, 0 where H = 1, 0, 5 is known, with lambda = 0.5."""
    found, known = numbers(3.0, 1.0, 0.0), numbers(1.0, 0.0, 5.0)
    gain = fisherrf.gain
    assert float(gain(found, known, Form(damping=0.5))) == pytest.approx(3.0 / 1.5 + 1.0 / 0.5)
    d_opt = gain(found, known, Form(criterion="d-opt", damping=0.5))
    assert float(d_opt) == pytest.approx(np.log(3.0) + np.log(3.0), rel=1e-5)


def test_gains_worked_out_by_hand():
    gains_by_hand()
    assert Form().damping == 1e-6  # the authors' lambda
    # What was never seen counts a million times what was.
    assert float(fisherrf.gain(numbers(1, 0, 0), numbers(0, 0, 0), Form())) == pytest.approx(1e6)


@settings(max_examples=50, deadline=None)
@given(
    new=st.lists(st.floats(0, 1e3, width=32), min_size=3, max_size=3),
    old=st.lists(st.floats(0, 1e3, width=32), min_size=3, max_size=3),
    more=st.lists(st.floats(0, 1e3, width=32), min_size=3, max_size=3),
    criterion=st.sampled_from(["ratio", "d-opt"]),
)
def test_what_is_known_better_is_worth_less(new, old, more, criterion):
    form = Form(criterion=criterion, damping=1e-3)
    before = float(fisherrf.gain(numbers(*new), numbers(*old), form))
    known = numbers(*(a + b for a, b in zip(old, more, strict=True)))
    after = float(fisherrf.gain(numbers(*new), known, form))
    assert 0.0 <= after <= before * (1.0 + 1e-5)


def a_pool(num: int = 7):
    """Views of a cloud from all around."""
    angles = 2.0 * np.pi * np.arange(num) / num
    places = np.stack([2.0 * np.cos(angles), 2.0 * np.sin(angles), 0.3 + 0 * angles], axis=1)
    return np.stack([np.asarray(look_at(place, np.zeros(3))) for place in places])


def test_batches_are_those_of_brute_force() -> None:
    """By brute force: all H of all views at hand, ratios and sums in NumPy."""
    module = fisherrf
    scene, camera, pool = random_cloud(4, 20, 0), view(16, 16)[0], a_pool()
    form = Form(quirk=False)
    table = []
    for pose in pool:
        found, _ = module.information(CONFIG, scene, camera, jnp.asarray(pose), form)
        table.append(np.concatenate([np.ravel(x) for x in jax.tree.leaves(found)]))
    table = np.asarray(table, np.float64)
    known, expected = 3.0 * table[3] + table[0], []
    for _ in range(7):
        ratio = (table / (known + 1e-6)).sum(axis=1)
        ratio[expected] = -np.inf
        expected.append(int(np.argmax(ratio)))
        known = known + table[expected[-1]]
    assert module.greedy_batch(scene, camera, pool, pool[[3, 3, 3, 0]], 7, form) == expected


def test_a_larger_batch_begins_with_the_smaller_one_and_repeats_nothing():
    scene, camera, pool = random_cloud(4, 20, 0), view(16, 16)[0], a_pool()
    whole = greedy_batch(scene, camera, pool, pool[:2], 99, Form())
    assert sorted(whole) == list(range(len(pool)))
    assert greedy_batch(scene, camera, pool, pool[:2], 3, Form()) == whole[:3]


def test_known_information_is_a_sum_over_views():
    scene, camera, pool = random_cloud(4, 20, 0), view(16, 16)[0], a_pool()
    singles = [known_information(scene, camera, pool[i : i + 1], Form()) for i in range(7)]
    for total, *parts in zip(
        *(jax.tree.leaves(x) for x in (known_information(scene, camera, pool, Form()), *singles)),
        strict=True,
    ):
        np.testing.assert_allclose(total, np.sum(parts, axis=0), rtol=1e-4)
    empty = known_information(scene, camera, pool[:0], Form())
    assert not any(np.asarray(x).any() for x in jax.tree.leaves(empty))
    # A view that is known adds less than one for each parameter that it shows.
    found = scores(scene, camera, pool[:1], singles[0], Form())
    shown = sum(int((np.asarray(x) > 0).sum()) for x in jax.tree.leaves(singles[0]))
    assert 0.0 < found[0] < shown
