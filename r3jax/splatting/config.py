"""Settings of the rasterizer, and the constants that every backend shares."""

from typing import Literal

import equinox as eqx

TILE = 16
"""Edge of a tile [px]."""

NEAR = 0.01
"""Gaussians whose center is nearer than this are not drawn [m]."""

DILATION = 0.3
"""Added to the diagonal of every projected covariance [px^2], so that nothing is thinner than a
pixel (Kerbl et al. 2023)."""

ALPHA_MIN = 1.0 / 255.0
"""A Gaussian whose alpha at a pixel is below this is skipped there."""

ALPHA_MAX = 0.99
"""Alpha is cut off here, so that the transmittance never reaches 0."""

TRANSMITTANCE_MIN = 1e-4
"""Compositing stops before the transmittance would fall to this."""

FRUSTUM_MARGIN = 0.3
"""The Jacobian of the projection is taken at most this share of half the image outside it."""

Backend = Literal["auto", "numba", "xla", "splax", "reference"]


class RasterConfig(eqx.Module):
    """How to rasterize; all of it static: another value recompiles."""

    backend: Backend = eqx.field(static=True, default="auto")
    """`numba` on CPUs, `splax` on NVIDIA GPUs where it is installed, `xla` everywhere else;
    `reference` is the slow oracle of the tests."""

    max_intersections: int | None = eqx.field(static=True, default=None)
    """Budget of (tile, Gaussian) pairs. None: 8 a Gaussian, raised by itself outside jit. What
    does not fit is counted in `Rendering.overflow`, and the images are NaN."""

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
