"""Every pure verb lowers for GPUs and TPUs, on machines without them, to programs of XLA alone."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import export

import r3jax
from r3jax.geometry.cameras import Camera, look_at
from r3jax.kernels.bridge import HANDLERS
from r3jax.kernels.native import platform
from r3jax.mapping.occupancy import frontier
from r3jax.scoring.renderability import term_images
from r3jax.scoring.simulated import imagine_view, simulate_view

pytestmark = pytest.mark.full

CAMERA = Camera(16, 12, 12.0, 12.0, 8.0, 6.0)
MAP = r3jax.empty_map(64, 0.1)
GRID = r3jax.empty_grid(np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]]))
POSE = look_at(jnp.array([0.1, 0.2, 0.3]), jnp.array([1.0, 1.0, 0.5]))
POINT = jnp.array([0.5, 0.5, 0.5])
FRAME = r3jax.Frame(jnp.full((12, 16, 3), 0.5), jnp.ones((12, 16)), POSE, CAMERA)
CONFIG = r3jax.ScoringConfig(zbuffer_size=16, panorama_size=16, panorama_bins=20)
SEEN = (MAP, CAMERA, POSE, CONFIG)
VALUED = (MAP, GRID, CAMERA, POSE, CONFIG)

VERBS = {
    "integrate": (r3jax.integrate, (MAP, FRAME)),
    "integrate_points": (
        lambda m, p: r3jax.integrate_points(m, p, p, POINT), (MAP, jnp.full((5, 3), 0.5)),
    ),
    "integrate_depth": (r3jax.integrate_depth, (GRID, FRAME)),
    "merge": (r3jax.merge, (MAP, MAP)),
    "lookup": (r3jax.lookup, (MAP, POINT)),
    "frontier": (frontier, (GRID,)),
    "renderability": (r3jax.renderability, SEEN),
    "renderability_image": (r3jax.renderability_image, SEEN),
    "term_images": (term_images, SEEN),
    "voxel_renderability": (r3jax.voxel_renderability, (MAP, POINT)),
    "voxel_difficulty": (r3jax.voxel_difficulty, (MAP,)),
    "expected_error": (r3jax.expected_error, SEEN),
    "view_utility": (r3jax.view_utility, VALUED),
    "explain_view": (r3jax.explain_view, VALUED),
    "panorama": (r3jax.panorama, (MAP, GRID, CAMERA, POINT, CONFIG)),
    "simulate_view": (simulate_view, SEEN),
    "imagine_view": (imagine_view, VALUED),
}  # fmt: skip


@pytest.fixture(autouse=True)
def other_devices(monkeypatch):
    """As if there were other devices: programs keep the choice of the platform."""
    monkeypatch.setattr(platform, "is_cpu_only", lambda: False)
    # What was traced before has the kernels only; what is traced here must not stay.
    jax.clear_caches()
    yield
    jax.clear_caches()


def lowered(name: str, *platforms: str) -> str:
    verb, arguments = VERBS[name]
    leaves, treedef = jax.tree.flatten(arguments)
    flat = jax.jit(lambda *leaves: jax.tree.leaves(verb(*jax.tree.unflatten(treedef, leaves))))
    # Calls of machine code are named below; their name is what is looked for.
    allowed = [export.DisabledSafetyCheck.custom_call(f"r3jax_{name}") for name in HANDLERS]
    exported = export.export(flat, platforms=platforms, disabled_checks=allowed)(*leaves)
    return exported.mlir_module()


@pytest.mark.parametrize("name", VERBS)
def test_no_call_of_machine_code_is_left_for_other_platforms(name):
    assert "@r3jax_" not in lowered(name, "cuda", "tpu")


def test_for_a_cpu_there_is_one():
    if not platform.can_call_kernels():
        pytest.skip(platform.missing_for_kernels())
    assert "@r3jax_pixels" in lowered("renderability", "cpu")
