"""Spherical harmonics: orthonormal, and equal to SciPy's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.special import sph_harm_y

from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.splatting import projection as harmonics_module
from r3jax.splatting.projection import harmonics, view_colors

NUM = 4096


def directions() -> np.ndarray:
    """[3, NUM], evenly spread, float32."""
    return np.asarray(fibonacci_lattice(NUM), dtype=np.float32).T


def basis() -> np.ndarray:
    """[16, NUM]."""
    return np.stack(harmonics_module.harmonics(*map(jnp.asarray, directions()), degree=3))


def test_orthonormal() -> None:
    """The integral of the product of two basis functions is 1 or 0."""
    values = basis().astype(np.float64)
    gram = values @ values.T * (4.0 * np.pi / NUM)
    np.testing.assert_allclose(gram, np.eye(16), atol=2e-3)


def test_equals_scipy() -> None:
    """Real harmonics with the Condon-Shortley phase, ordered by degree, then order."""
    x, y, z = directions().astype(np.float64)
    polar, azimuth = np.arccos(np.clip(z, -1, 1)), np.arctan2(y, x)
    values = basis()
    for degree in range(4):
        for order in range(-degree, degree + 1):
            value = sph_harm_y(degree, abs(order), polar, azimuth)
            if order < 0:
                expected = np.sqrt(2.0) * value.imag
            elif order == 0:
                expected = value.real
            else:
                expected = np.sqrt(2.0) * value.real
            found = values[degree * degree + degree + order]
            np.testing.assert_allclose(found, expected, atol=3e-6)


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
def test_lower_degrees_are_prefixes(degree):
    d = [jnp.asarray(axis) for axis in directions()]
    full, part = harmonics(*d, degree=3), harmonics(*d, degree=degree)
    assert len(part) == (degree + 1) ** 2
    for one, other in zip(part, full, strict=False):
        np.testing.assert_array_equal(one, other)


def test_constant_color_from_everywhere():
    sh = jnp.zeros((2, 16, 3)).at[:, 0].set(jnp.asarray([0.3, -0.2, 4.0]) / 0.28209479177387814)
    means = jnp.asarray([[1.0, 2.0, 3.0], [-1.0, 0.5, 0.0]])
    colors = view_colors(sh, means, jnp.asarray([0.1, 0.0, -2.0]))
    np.testing.assert_allclose(colors, [[0.8, 0.8], [0.3, 0.3], [4.5, 4.5]], rtol=1e-6)


def test_a_camera_inside_a_gaussian_has_finite_gradients():
    means = jnp.ones((1, 3))
    sh = jnp.ones((1, 16, 3)) * 0.1

    def brightness(means, center):
        return view_colors(sh, means, center).sum()

    value, gradient = jax.value_and_grad(brightness)(means, jnp.ones(3))
    assert np.isfinite(value)
    assert np.isfinite(gradient).all()
