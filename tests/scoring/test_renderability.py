"""The laws that the closed forms obey."""

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import given
from hypothesis import strategies as st

import r3jax
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.geometry.voxels import pack
from r3jax.mapping.join import Statistics, join
from r3jax.mapping.update import observe_voxels
from r3jax.scoring.terms import seen_directions

CAPACITY = 4
CENTER = jnp.full(3, 0.025)
TERMS = ("kappa", "bias", "delta", "noise", "resolution", "value")


def _remember(directions, distances, colors, count):
    """A map of one voxel, seen `count` times; [24, ...] per case, the rest is padding."""
    state = r3jax.empty_map(CAPACITY)
    key = jnp.stack(pack(*jnp.zeros((3, 1), dtype=jnp.int32)))

    def look(i, state):
        valid = (i < count)[None]
        position = CENTER + directions[i] * distances[i]
        rgb = colors[i][:, None]
        seen: Statistics = observe_voxels(state, key, valid, rgb, position, jnp.ones(()))
        return join(state, seen)

    return jax.lax.fori_loop(0, directions.shape[0], look, state)


@jax.jit
def terms(directions, distances, colors, count, query_direction, query_distance):
    """The terms of the one voxel; a batch of cases."""

    def one(directions, distances, colors, count, query_direction, query_distance):
        state = _remember(directions, distances, colors, count)
        row = r3jax.lookup(state, CENTER)
        found = r3jax.voxel_renderability(state, CENTER + query_direction * query_distance)
        return jax.tree.map(lambda term: term[jnp.minimum(row, CAPACITY - 1)], found)

    return jax.vmap(one)(directions, distances, colors, count, query_direction, query_distance)


def _random_cases(seed: int, num: int = 16):
    rng = np.random.default_rng(seed)
    unit = lambda *shape: (lambda v: v / np.linalg.norm(v, axis=-1, keepdims=True))(
        rng.standard_normal((*shape, 3))
    )
    cast = lambda x: jnp.asarray(x, dtype=jnp.float32)
    return (
        cast(unit(num, 24)),
        cast(rng.uniform(0.3, 5.0, (num, 24))),
        cast(rng.uniform(0.0, 1.0, (num, 24, 3))),
        jnp.asarray(rng.integers(1, 24, num), dtype=jnp.int32),
        cast(unit(num)),
        cast(rng.uniform(0.3, 5.0, num)),
    )


@given(st.integers(0, 10_000))
def test_renderability_lies_between_0_and_1(seed):
    found = terms(*_random_cases(seed))
    for name in TERMS[1:]:
        value = np.asarray(getattr(found, name))
        assert ((value >= 0.0) & (value <= 1.0)).all(), name
    np.testing.assert_allclose(found.value, found.bias * found.noise * found.resolution, atol=1e-6)


@given(st.integers(0, 10_000))
def test_a_matte_voxel_seen_again_renders_well(seed):
    directions, distances, colors, count, _, _ = _random_cases(seed)
    matte = jnp.broadcast_to(colors[:, :1], colors.shape)
    found = terms(directions, distances, matte, count, directions[:, 0], distances[:, 0])
    # The bins are 64: the nearest center lies up to 18 degrees off.
    assert float(found.value.min()) > 0.85


@given(st.integers(0, 10_000))
def test_more_views_of_a_matte_voxel_never_hurt(seed):
    directions, distances, colors, count, query, far = _random_cases(seed)
    matte = jnp.broadcast_to(colors[:, :1], colors.shape)
    before = terms(directions, distances, matte, count, query, far)
    after = terms(directions, distances, matte, count + 1, query, far)
    for name in ("bias", "resolution"):
        assert (getattr(after, name) >= getattr(before, name) - 1e-6).all(), name
    assert (after.kappa <= before.kappa).all()


@given(st.integers(0, 10_000))
def test_the_scan_over_bins_equals_brute_force(seed):
    rng = np.random.default_rng(seed)
    visited = rng.random((64, 32)) < rng.uniform(0.02, 0.5, 32)
    direction = rng.standard_normal((3, 32))
    direction[:2, :2] = 0.0  # both poles
    direction[2, :2] = (1.0, -1.0)
    direction = (direction / np.linalg.norm(direction, axis=0)).astype(np.float32)
    words = np.packbits(visited.reshape(2, 32, 32), axis=1, bitorder="little")
    words = np.ascontiguousarray(words.transpose(0, 2, 1)).view(np.uint32)[..., 0]
    cosine, inside = jax.jit(seen_directions, static_argnums=2)(
        jnp.asarray(words), jnp.asarray(direction), 64
    )
    for i in range(32):
        r, q = direction[:, i].astype(np.float64), fibonacci_lattice(64)[visited[:, i]]
        product = q @ r
        np.testing.assert_allclose(cosine[i], max(product.max(initial=0.0), 0.0), atol=2e-6)
        first = np.cross((0, 0, 1), r) if abs(r[2]) < 1.0 - 1e-9 else np.array([1.0, 0.0, 0.0])
        ahead = q[product > 0.0]
        flat = np.stack([ahead @ first, ahead @ np.cross(r, first)])
        if flat.shape[1] == 0:
            assert inside[i] == 0.0
        elif np.abs(flat).min() > 1e-5:  # nothing on the edge, where rounding decides
            box = (flat.min(axis=1) <= 0.0) & (flat.max(axis=1) >= 0.0)
            assert bool(inside[i]) == box.all()
