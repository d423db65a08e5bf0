"""Settings of the rasterizer."""

from typing import Literal

import equinox as eqx

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
        return fitting_budget(max(8 * num_gaussians, 1 << 14), headroom=1.0)


def fitting_budget(needed: int, headroom: float = 1.25) -> int:
    """Rounds a budget up to one of a few distinct numbers, so that few compile."""
    wanted = max(int(headroom * needed), 1 << 10)
    step = 1 << (wanted.bit_length() - 3)
    return -(-wanted // step) * step
