"""Settings of the trainer, with the numbers of Kerbl et al. (2023) as defaults.

All rates and weights are traced: a sweep over them compiles once.
"""

import dataclasses
from typing import Any, NamedTuple

import equinox as eqx

from r3jax.errors import InputError
from r3jax.splatting.backend import RasterConfig


class Schedule(NamedTuple):
    """The schedule of a training, with all numbers resolved."""

    sh_every: int
    """Iterations between two degrees of the harmonics."""

    refine_from: int
    """First iteration after which the Gaussians are refined."""

    refine_until: int
    """They are refined before this iteration only."""

    refine_every: int
    """Iterations between two refinements."""

    reset_every: int
    """Iterations between two resets of the opacities (vanilla)."""

    def refines_after(self, step: int) -> bool:
        """Returns True if the Gaussians are refined after iteration `step` (the first is 1)."""
        inside = self.refine_from < step < self.refine_until
        return inside and step % self.refine_every == 0

    def resets_after(self, step: int) -> bool:
        """Returns True if the opacities are reset after iteration `step`."""
        return 0 < step < self.refine_until and step % self.reset_every == 0


class TrainConfig(eqx.Module):
    """Settings of a training."""

    iterations: int = 30_000
    """Steps of the optimizer."""

    strategy: str = eqx.field(static=True, default="vanilla")
    """`vanilla`: clone, split, prune and reset (Kerbl et al. 2023). `mcmc`: relocation and noise
    within a fixed budget (Kheradmand et al. 2024)."""

    num_gaussians: int = eqx.field(static=True, default=20_000)
    """Initial number of Gaussians."""

    capacity: int | None = eqx.field(static=True, default=None)
    """Maximum number of Gaussians. None: twice `num_gaussians`."""

    sh_degree: int = eqx.field(static=True, default=3)
    """Highest degree of the harmonics, 0 to 3."""

    views_per_step: int = eqx.field(static=True, default=1)
    """Batch size: views per step."""

    background: str = eqx.field(static=True, default="black")
    """Background color; `random` draws a new color each step."""

    raster: RasterConfig = RasterConfig()
    """Backend, and the initial budget of intersections, which training raises as needed."""

    seed: int = 0
    """Random seed of the order of views, the noise and the background."""

    lambda_dssim: float = eqx.field(default=0.2, converter=float)
    """Weight of 1 - SSIM; the rest is the mean absolute error."""

    rate_means: float = eqx.field(default=1.6e-4, converter=float)
    """Initial learning rate of the centers [scene extents]."""

    rate_means_last: float = eqx.field(default=1.6e-6, converter=float)
    """Final learning rate of the centers, reached by exponential decay."""

    rate_quats: float = eqx.field(default=1e-3, converter=float)
    """Learning rate of the rotations."""

    rate_log_scales: float = eqx.field(default=5e-3, converter=float)
    """Learning rate of the log scales."""

    rate_opacities: float = eqx.field(default=5e-2, converter=float)
    """Learning rate of the opacity logits."""

    rate_sh: float = eqx.field(default=2.5e-3, converter=float)
    """Learning rate of the constant harmonic; the others have a twentieth of it."""

    sh_every: int | None = eqx.field(static=True, default=None)
    """Iterations between two degrees of the harmonics. None: 1000, but at most a tenth of the
    run."""

    refine_from: int | None = eqx.field(static=True, default=None)
    """First iteration after which to refine. None: 500, but at most a tenth of the run."""

    refine_until: int | None = eqx.field(static=True, default=None)
    """Iteration at which refinement ends. None: 15000 (`mcmc`: 25000), but at most half (five
    sixths) of the run."""

    refine_every: int = eqx.field(static=True, default=100)
    """Iterations between two refinements."""

    reset_every: int = eqx.field(static=True, default=3000)
    """Iterations between two resets of the opacities. Not scaled with the run: opacities need some
    hundred steps to recover, so runs under 6000 iterations have none."""

    gradient_threshold: float = eqx.field(default=2e-4, converter=float)
    """Clone or split above this mean gradient by the center [per half image]."""

    percent_dense: float = eqx.field(default=0.01, converter=float)
    """Split larger Gaussians, clone smaller ones [scene extents]."""

    prune_opacity: float = eqx.field(default=0.005, converter=float)
    """Prune (`mcmc`: relocate) less opaque Gaussians."""

    prune_size: float = eqx.field(default=0.1, converter=float)
    """Prune larger Gaussians after the first reset [scene extents]."""

    reset_opacity: float = eqx.field(default=0.01, converter=float)
    """A reset lowers opacities to this."""

    growth: float = eqx.field(default=0.05, converter=float)
    """`mcmc`: share of new Gaussians at each refinement."""

    noise: float = eqx.field(default=5e5, converter=float)
    """`mcmc`: noise on the centers per learning rate of the centers."""

    opacity_weight: float = eqx.field(default=0.01, converter=float)
    """`mcmc`: weight of the mean opacity in the loss."""

    scale_weight: float = eqx.field(default=0.01, converter=float)
    """`mcmc`: weight of the mean scale in the loss."""

    def __check_init__(self) -> None:
        """Refuses invalid settings."""
        for name in ("iterations", "num_gaussians", "views_per_step", "refine_every"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} must be at least 1, got {getattr(self, name)}")
        if not 0 <= self.seed < 1 << 31:
            raise InputError(f"seed must lie between 0 and 2^31 - 1, got {self.seed}")
        if self.iterations * self.views_per_step >= 1 << 31:
            raise InputError(
                f"{self.iterations} iterations of {self.views_per_step} views each are more than "
                "2^31 renderings: lower iterations or views_per_step"
            )
        for name in ("sh_every", "reset_every"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise InputError(f"{name} must be at least 1, got {value}")
        if not 0 <= self.sh_degree <= 3:
            raise InputError(f"sh_degree must be 0, 1, 2 or 3, got {self.sh_degree}")
        if self.rows < self.num_gaussians:
            raise InputError(
                f"capacity {self.rows} has no room for the {self.num_gaussians} Gaussians of the "
                "start: raise capacity or lower num_gaussians"
            )
        if self.strategy not in ("vanilla", "mcmc"):
            raise InputError(f"strategy must be vanilla or mcmc, got {self.strategy!r}")
        if self.background not in ("black", "white", "random"):
            raise InputError(f"background must be black, white or random, got {self.background!r}")
        for name, value in vars(self).items():
            if isinstance(value, float) and not 0.0 <= value < float("inf"):
                raise InputError(f"{name} must be finite and not negative, got {value}")
        if min(self.rate_means, self.rate_means_last) <= 0.0:
            raise InputError(
                "rate_means and rate_means_last must be positive: one decays to the "
                "other exponentially"
            )

    @property
    def rows(self) -> int:
        """The capacity of the scene."""
        return 2 * self.num_gaussians if self.capacity is None else self.capacity

    def schedule(self) -> Schedule:
        """Returns the schedule of this run: that of the paper for 30000 iterations or more."""
        tenth = max(1, self.iterations // 10)
        last, share = (15_000, (1, 2)) if self.strategy == "vanilla" else (25_000, (5, 6))
        until = min(last, self.iterations * share[0] // share[1])
        return Schedule(
            sh_every=min(1000, tenth) if self.sh_every is None else self.sh_every,
            refine_from=min(500, tenth) if self.refine_from is None else self.refine_from,
            refine_until=until if self.refine_until is None else self.refine_until,
            refine_every=self.refine_every,
            reset_every=self.reset_every,
        )

    def as_record(self) -> dict[str, Any]:
        """Returns all settings as plain numbers and strings."""
        return dataclasses.asdict(self)
