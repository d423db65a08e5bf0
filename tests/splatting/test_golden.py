"""Every backend agrees with a case that another program worked out in float64."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.render import render
from tests.splatting.clouds import Golden, read_golden

BACKENDS = [
    "reference",
    "xla",
    "numba",
    pytest.param(
        "splax",
        marks=pytest.mark.skipif(
            importlib.util.find_spec("splax") is None, reason="splax is not installed"
        ),
    ),
]


@pytest.fixture(scope="module")
def golden(shared) -> Golden:
    return read_golden(shared("golden", "splats.npz"))


@pytest.fixture(scope="module", params=BACKENDS)
def outcome(golden, request):
    """Loss, rendering and gradients of one backend."""
    expected = golden.expected
    weights = [jnp.asarray(expected[f"weight_{name}"]) for name in ("rgb", "alpha", "depth")]
    config = RasterConfig(backend=request.param, max_intersections=1 << 14)

    def loss(scene, pose):
        image = render(scene, golden.camera, pose, jnp.asarray(expected["background"]), config)
        parts = (image.rgb, image.alpha, image.depth * image.alpha)
        return sum(jnp.sum(p * w) for p, w in zip(parts, weights, strict=True)), image

    step = jax.jit(jax.value_and_grad(loss, argnums=(0, 1), has_aux=True))
    return step(golden.scene, golden.T_world_camera)


def test_images(golden, outcome):
    (_, image), _ = outcome
    safe = golden.expected["safe_pixels"]
    assert safe.mean() > 0.9
    assert int(image.overflow) == 0
    for name, found in (
        ("rgb", image.rgb),
        ("alpha", image.alpha),
        ("depth_accumulated", image.depth * image.alpha),
    ):
        difference = np.abs(np.asarray(found) - golden.expected[name])[safe]
        assert difference.max() < 1e-4, name


def test_loss(golden, outcome):
    (loss, _), _ = outcome
    np.testing.assert_allclose(float(loss), float(golden.expected["loss"]), rtol=1e-4)


@pytest.mark.parametrize("name", ["means", "quats", "log_scales", "opacity_logits", "sh"])
def test_gradients(golden, outcome, name):
    _, (scene_gradient, _) = outcome
    found, expected = np.asarray(getattr(scene_gradient, name)), golden.expected[f"grad_{name}"]
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, rtol=1e-3, atol=1e-4 * scale)
    assert np.linalg.norm(found - expected) < 1e-3 * np.linalg.norm(expected)


def test_pose_gradient(golden, outcome):
    """The golden gradient is by the world-to-camera matrix; both are compared along rigid moves."""
    _, (_, by_pose) = outcome
    T = golden.expected["T_world_camera"].astype(np.float64)
    inverse = np.linalg.inv(T)
    by_inverse = golden.expected["grad_view"].astype(np.float64)
    expected_by_pose = -inverse.T @ by_inverse @ inverse.T
    moves = [T @ generator for generator in rigid_generators()]
    expected = np.array([np.sum(expected_by_pose * move) for move in moves])
    found = np.array([np.sum(np.asarray(by_pose) * move) for move in moves])
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def rigid_generators() -> list[np.ndarray]:
    """Derivatives of the three shifts and the three turns at the identity, [4, 4] each."""
    generators = []
    for axis in range(3):
        shift = np.zeros((4, 4))
        shift[axis, 3] = 1.0
        turn = np.zeros((4, 4))
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turn[first, second], turn[second, first] = -1.0, 1.0
        generators += [shift, turn]
    return generators
