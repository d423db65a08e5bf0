"""The interface of rasterizer backends, and the choice among them."""

import importlib.util
from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.kernels.native.platform import can_call_kernels
from r3jax.splatting.config import RasterConfig
from r3jax.splatting.scene import GaussianScene


class Composite(eqx.Module):
    """The result of a backend: the Gaussians composited on black."""

    rgb: Float[Array, "H W 3"]
    """Sum of weight x color."""

    depth_sum: Float[Array, "H W"]
    """Sum of weight x z-depth [m]."""

    alpha: Float[Array, "H W"]
    """Sum of the weights."""

    num_intersections: Int[Array, ""]
    """Number of (tile, Gaussian) pairs of the view."""

    overflow: Int[Array, ""]
    """Number of pairs beyond the budget, which were dropped."""


@runtime_checkable
class Rasterize(Protocol):
    """A backend: differentiable by the scene, the pose, the intrinsics and `center_offsets`."""

    def __call__(
        self,
        scene: GaussianScene,
        camera: Camera,
        T_world_camera: Float[Array, "4 4"],
        center_offsets: Float[Array, "n 2"],
        config: RasterConfig,
    ) -> Composite:
        """Composites the scene on black; one view, to be vmapped over poses."""
        ...


def find_backend(name: str) -> Rasterize:
    """Finds a backend by name; `auto` is the fastest on this machine.

    `numba` becomes `xla`, with a warning, if kernels cannot run.

    Raises:
        ValueError: there is no such backend.
        ImportError: its packages are not installed; the message names the extra.
    """
    if name == "auto":
        name = _fastest()
    if name == "numba" and not can_call_kernels():
        name = "xla"
    if name == "numba":
        from r3jax.splatting.backends.numba import rasterize
    elif name == "xla":
        from r3jax.splatting.backends.xla import rasterize
    elif name == "splax":
        from r3jax.splatting.backends.splax import rasterize
    elif name == "reference":
        from r3jax.splatting.backends.reference import rasterize
    else:
        raise InputError(
            f"there is no rasterizer backend {name!r}: choose auto, numba, xla, splax or reference"
        )
    return rasterize


def _fastest() -> str:
    platform = jax.default_backend()
    if platform == "cpu":
        return "numba"
    if platform in ("gpu", "cuda") and importlib.util.find_spec("splax") is not None:
        return "splax"
    return "xla"
