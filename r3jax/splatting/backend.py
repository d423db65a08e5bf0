"""The settings of the rasterizer, the interface of its backends, and the choice among them."""

import dataclasses
import importlib.util
from typing import Literal, Protocol, runtime_checkable

import equinox as eqx
import jax
from jaxtyping import Array, Float, Int

from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera
from r3jax.kernels.native.platform import can_call_kernels
from r3jax.splatting.scene import GaussianScene

Backend = Literal["auto", "numba", "xla", "splax", "reference"]


class RasterConfig(eqx.Module):
    """Settings of the rasterizer; static, so that other values recompile."""

    backend: Backend = eqx.field(static=True, default="auto")
    """`auto`: `numba` on CPUs, `splax` on NVIDIA GPUs if installed, `xla` elsewhere. `reference` is
    the slow oracle of the tests."""

    max_intersections: int | None = eqx.field(static=True, default=None)
    """Budget of (tile, Gaussian) pairs. None: 8 per Gaussian, raised automatically outside jit.
    Pairs beyond it are counted in `Rendering.overflow`, and the images are NaN."""

    tiles_per_batch: int = eqx.field(static=True, default=16)
    """`xla`: tiles composited at a time."""

    gaussians_per_chunk: int = eqx.field(static=True, default=64)
    """`xla`: Gaussians composited at a time in each tile."""

    def budget(self, num_gaussians: int) -> int:
        """Returns the budget of intersections for this number of Gaussians."""
        if self.max_intersections is not None:
            return self.max_intersections
        return _fitting_budget(max(8 * num_gaussians, 1 << 14), headroom=1.0)

    def with_room(self, needed: int) -> "RasterConfig":
        """Returns the settings with a budget that holds this number of intersections."""
        return dataclasses.replace(self, max_intersections=_fitting_budget(needed))


def _fitting_budget(needed: int, headroom: float = 1.25) -> int:
    """Rounds a budget up to one of a few distinct numbers, so that few compile."""
    wanted = max(int(headroom * needed), 1 << 10)
    step = 1 << (wanted.bit_length() - 3)
    return -(-wanted // step) * step


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
