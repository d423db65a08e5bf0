"""Every term against 240 voxels that an independent program worked out in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import r3jax
from r3jax.geometry.sphere import fibonacci_lattice

TERMS = {
    "kappa": "kappa",
    "bias": "bias",
    "delta": "delta",
    "noise": "noise",
    "resolution": "resolution",
    "value": "renderability",
}


def terms_of_case(case: dict) -> r3jax.Renderability:
    """One voxel at the origin (float32 is finest there) is observed n times, then queried."""
    state = r3jax.empty_map(capacity=2)
    center = jnp.full(3, 0.5, dtype=jnp.float32) * state.voxel_size

    def observe(state, seen):
        index, direction, rgb, distance = seen
        # Points that are not finite are no observation: how the cases' padding is left out.
        point = jnp.where(index < case["n"], center, jnp.nan)
        position = center + direction * distance
        return r3jax.integrate_points(state, point[None], rgb[None], position, focal=1.0), None

    seen = (
        jnp.arange(case["observed_distance"].shape[0], dtype=jnp.int32),
        case["observed_direction"],
        case["observed_rgb"],
        case["observed_distance"],
    )
    state = jax.lax.scan(observe, state, seen)[0]
    row = r3jax.lookup(state, center[None])[0]
    query = center + case["query_direction"] * case["query_distance"]
    terms = r3jax.voxel_renderability(state, query, focal=1.0)
    # A voxel never seen has no row; any row of its empty map says the same.
    return jax.tree.map(lambda term: term[jnp.minimum(row, state.capacity - 1)], terms)


@pytest.fixture(scope="module")
def golden(shared):
    with np.load(shared("golden", "renderability_terms.npz")) as archive:
        return {name: archive[name] for name in archive.files}


@pytest.fixture(scope="module")
def computed(golden):
    num = len(golden["n"])
    names = [name for name in golden if name == "n" or name.startswith(("observed", "query"))]
    cases = {name: jnp.asarray(golden[name]) for name in names}
    assert all(len(case) == num for case in cases.values())
    return jax.jit(jax.vmap(terms_of_case))(cases)


def test_the_cases_are_varied(golden):
    assert len(golden["n"]) == 240
    assert (golden["n"] == 0).any()
    assert (golden["n"] == 1).any()
    assert set(np.unique(golden["kappa"])) == {1.0, 2.0}


@pytest.mark.parametrize("field", TERMS)
def test_term_agrees(golden, computed, field):
    expected, actual = golden[TERMS[field]], np.asarray(getattr(computed, field))
    worst = int(np.argmax(np.abs(actual - expected)))
    case = f"case {worst} with n = {golden['n'][worst]}"
    np.testing.assert_allclose(actual, expected, atol=1e-4, rtol=0, err_msg=f"worst: {case}")


def test_the_lattice_is_the_same(golden):
    np.testing.assert_allclose(fibonacci_lattice(64), golden["bins"], atol=1e-12)
