"""Formulas in float64, derivatives against differences, and faults that the laws must notice."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.kernels.calls import Forms
from r3jax.mapping.state import MapState
from r3jax.scoring import terms
from r3jax.scoring.config import PAPER, Score

NUM = 64
SIZE = 0.05
POSITION = np.array([0.4, -0.7, 0.9])
FOCAL = 50.0
SEED = 5


def make_voxels():
    """Voxels in a row, seen from random bins with random consistency; the last is absent."""
    random = np.random.default_rng(SEED)
    words = random.integers(0, 1 << 32, (2, NUM)) & random.integers(0, 1 << 32, (2, NUM))
    words &= random.integers(0, 1 << 32, (2, NUM))
    index = np.stack([np.arange(NUM) - NUM // 2, np.full(NUM, 3), np.arange(NUM) % 7])
    packed = sum((row.astype(np.int64) + (1 << 20)) << 21 * i for i, row in enumerate(index))
    count = random.integers(1, 9, NUM).astype(np.float32)
    count[-1] = 0.0
    return MapState(
        key=jnp.asarray(np.stack([packed & 0xFFFFFFFF, packed >> 32]), jnp.uint32),
        visited=jnp.asarray(words, jnp.uint32),
        count=jnp.asarray(count),
        m2=jnp.asarray(random.uniform(0.0, 0.5, NUM) * np.maximum(count - 1, 0), jnp.float32),
        mean=jnp.zeros((3, NUM), jnp.float32),
        resolution=jnp.asarray(random.uniform(10.0, 80.0, NUM), jnp.float32),
        voxel_size=jnp.asarray(SIZE, jnp.float32),
        dropped=jnp.zeros((), jnp.int32),
        num_bins=64,
    )


def expected_terms(voxels, forms: Forms = PAPER.forms) -> dict[str, np.ndarray]:
    """The table of the design, voxel by voxel in float64."""
    words = np.asarray(voxels.visited)
    count, m2 = (np.asarray(x, np.float64) for x in (voxels.count, voxels.m2))
    best = np.asarray(voxels.resolution, np.float64)
    terms: dict[str, list[float]] = {name: [] for name in ("kappa", "bias", "delta", "value")}
    terms |= {"noise": [], "resolution": []}
    for i in range(NUM):
        bits = [k for k in range(64) if words[k // 32, i] >> np.uint32(k % 32) & np.uint32(1)]
        q = fibonacci_lattice(64)[bits]
        center = (np.array([i - NUM // 2, 3, i % 7]) + 0.5) * SIZE
        distance = np.linalg.norm(POSITION - center)
        r = (POSITION - center) / distance
        cosine = float(np.clip((q @ r).max(initial=0.0), 0.0, 1.0))
        e1 = np.cross([0.0, 0.0, 1.0], r)
        flat = q[q @ r > 0.0] @ np.stack([e1, np.cross(r, e1)], axis=1)
        is_inside = len(flat) > 0 and bool(((flat.min(0) <= 0) & (flat.max(0) >= 0)).all())
        power = 1.0 if is_inside or forms.kappa == "one" else 2.0
        variance = m2[i] / max(count[i] - 1, 1)
        form = 2 * variance if forms.delta == "pairwise" else np.sqrt(2 / 1.5 * variance)
        delta = float(np.clip(1 - form, 0, 1)) if count[i] > 1 else 1.0
        bias = cosine**power
        noise = delta ** (power * (1 - bias))
        resolution = min(1.0, best[i] / (FOCAL / distance)) ** (1 - delta * bias)
        is_there = count[i] > 0
        found = (power, bias, delta, bias * noise * resolution, noise, resolution)
        for name, value in zip(terms, found, strict=True):
            terms[name].append(value if is_there or name in ("kappa", "delta") else 0.0)
    return {name: np.array(values) for name, values in terms.items()}


def law_formulas(kappa: str = "box", delta: str = "trace") -> None:
    voxels, forms = make_voxels(), Forms(kappa, delta)
    position = jnp.asarray(POSITION, jnp.float32)
    found = terms.score_voxels(voxels, position, jnp.float32(FOCAL), Score(forms))
    for name, expected in expected_terms(voxels, forms).items():
        np.testing.assert_allclose(getattr(found, name), expected, atol=2e-5, err_msg=name)


@pytest.mark.parametrize("kappa", ["box", "one"])
@pytest.mark.parametrize("delta", ["trace", "pairwise"])
def test_terms_follow_their_formulas(kappa, delta):
    law_formulas(kappa, delta)


def test_the_examples_reach_both_sides_of_every_branch():
    terms = expected_terms(make_voxels())
    assert set(terms["kappa"]) == {1.0, 2.0}
    assert terms["resolution"].max() == 1.0
    assert terms["resolution"][:-1].min() < 0.9
    assert (terms["delta"] == 1.0).any()
    assert (terms["delta"] < 0.7).any()


def observed(colors: np.ndarray, directions: np.ndarray) -> r3jax.MapState:
    """A map of one voxel at (0, 0, 0), seen from 2 m away."""
    m = r3jax.empty_map(16, 0.0625)
    center = np.full((1, 3), 0.03125, dtype=np.float32)
    for color, direction in zip(colors, directions, strict=True):
        rgb = np.asarray(color, np.float32)[None]
        m = r3jax.integrate_points(m, center, rgb, center[0] + 2.0 * direction.astype(np.float32))
    return m


CENTER = np.full(3, 0.03125, dtype=np.float32)
AXIS = fibonacci_lattice(64)[20]
GRAY = np.full((2, 3), 0.5)
CLASHING = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])


@pytest.mark.parametrize(
    ("colors", "query"),
    [
        (GRAY, CENTER),  # the voxel's own center
        (GRAY, CENTER + AXIS),  # b = 1
        (CLASHING, CENTER + AXIS),  # delta = 0 and b = 1: 0 ** 0
        (CLASHING, CENTER + np.array([1.0, 0.0, 0.0])),  # delta = 0
        (GRAY, CENTER + np.array([0.0, 0.0, 1.0])),  # the pole of the tangent frame
        (GRAY, CENTER - AXIS),  # seen from behind: cosine 0
    ],
)
def test_gradients_are_finite_at_the_corners_of_the_formulas(colors, query):
    m = observed(colors, np.stack([AXIS, AXIS]))
    value = lambda p: jnp.sum(r3jax.voxel_renderability(m, p).value)
    gradient = jax.grad(value)(jnp.asarray(query, jnp.float32))
    assert np.isfinite(gradient).all()
    assert np.isfinite(float(value(jnp.asarray(query, jnp.float32))))


def test_the_derivative_of_a_voxel_is_its_difference_quotient():
    m = observed(np.array([[0.4, 0.5, 0.6], [0.5, 0.4, 0.7]]), np.stack([AXIS, -AXIS]))
    query = jnp.asarray(CENTER + 2.5 * np.array([0.6, 0.64, 0.48]), jnp.float32)
    value = jax.jit(lambda p: jnp.sum(r3jax.voxel_renderability(m, p).value))
    gradient = jax.grad(value)(query)
    step = 4e-3
    moves = jnp.eye(3) * step
    difference = [float(value(query + d) - value(query - d)) / (2 * step) for d in moves]
    assert np.abs(difference).max() > 0.01
    np.testing.assert_allclose(gradient, difference, atol=2e-3)


def test_rows_of_a_map_are_scored_as_they_stand():
    m = observed(GRAY, np.stack([AXIS, -AXIS]))
    row = int(r3jax.lookup(m, jnp.asarray(CENTER)))
    voxels = m
    assert np.flatnonzero(np.asarray(voxels.present)).tolist() == [row]
    np.testing.assert_allclose(voxels.center[:, row], CENTER)


def test_a_map_known_when_compiling_is_scored_alike():
    """XLA once took a loop over constant chunks for an empty one."""
    m = observed(GRAY, np.stack([AXIS, -AXIS]))
    query = jnp.asarray(CENTER + 2.0 * AXIS, jnp.float32)
    eager = r3jax.voxel_renderability(m, query).value
    compiled = jax.jit(lambda p: r3jax.voxel_renderability(m, p).value)(query)
    assert float(eager.max()) > 0.5
    np.testing.assert_allclose(compiled, eager, atol=1e-6)
