"""One step of training, and one refinement: pure functions of the state, jitted.

The loss is 0.8 L1 + 0.2 D-SSIM (Kerbl et al. 2023, eq. 7).

Shape symbols: n rows of the scene, v views, b views per step; H, W image size; c planes.
"""

import functools
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PRNGKeyArray

from r3jax.geometry.cameras import invert_pose, project, transform
from r3jax.kernels import calls
from r3jax.kernels.constants import NEAR_PLANE, SSIM_C1, SSIM_C2, TAPS, WINDOW_RADIUS
from r3jax.kernels.native.platform import by_platform
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.training import density
from r3jax.splatting.training.config import Schedule, TrainConfig
from r3jax.splatting.training.density import DensityStatistics, empty_statistics
from r3jax.splatting.training.optimizer import Moments, empty_moments, guarded_update, mean_rate
from r3jax.splatting.views import PosedImage, Views

DONE, OVERFLOWN, DIVERGED = 0, 1, 2
"""Outcomes of a step. The state only advances with the first."""

_ORDER, _BACKGROUND, _NOISE, _REFINE = range(4)
"""What a key is for."""


class TrainState(eqx.Module):
    """All that changes during training."""

    scene: GaussianScene
    """The Gaussians."""

    moments: Moments
    """Adam's."""

    statistics: DensityStatistics
    """Since the last refinement."""

    step: Int[Array, ""]
    """Steps done."""

    dropped: Int[Array, ""]
    """Gaussians that were to be born and found no unused row. Never decreases."""


class StepInfo(eqx.Module):
    """What a step has to report."""

    outcome: Int[Array, ""]
    """DONE; OVERFLOWN: the budget of intersections is too small; DIVERGED: the loss, a
    gradient or a parameter is not finite. The state is unchanged but for DONE."""

    loss: Float[Array, ""]
    """Before the step."""

    psnr: Float[Array, ""]
    """PSNR of this step's views, before the step [dB]."""

    num_gaussians: Int[Array, ""]
    """Rows in use."""

    num_intersections: Int[Array, ""]
    """Needed by the most demanding of this step's views."""


class _ViewReport(eqx.Module):
    """What the loss of one view reports besides its value."""

    mse: Float[Array, ""]
    num_intersections: Int[Array, ""]
    overflow: Int[Array, ""]


_Sums = tuple[Float[Array, ""], GaussianScene, DensityStatistics, _ViewReport]
"""Loss, gradient, statistics and report of the views so far."""


def start_state(scene: GaussianScene) -> TrainState:
    """Returns the state before the first step."""
    return TrainState(
        scene=scene,
        moments=empty_moments(scene),
        statistics=empty_statistics(scene.capacity),
        step=jnp.zeros((), dtype=jnp.int32),
        dropped=jnp.zeros((), dtype=jnp.int32),
    )


def _key(config: TrainConfig, purpose: int, number: Int[Array, ""]) -> PRNGKeyArray:
    """Derives a key from the seed and the step alone, so that a resumed run draws the same."""
    return jax.random.fold_in(jax.random.fold_in(jax.random.key(config.seed), purpose), number)


def view_index(config: TrainConfig, number: Int[Array, ""], count: int) -> Int[Array, ""]:
    """Returns the `number`-th view to be shown, from a new random order in every epoch."""
    order = jax.random.permutation(_key(config, _ORDER, number // count), count)
    return order[number % count]


@functools.partial(jax.jit, donate_argnames=("state",))
def train_step(
    state: TrainState,
    views: Views,
    extent: Float[Array, ""],
    config: TrainConfig,
    schedule: Schedule,
) -> tuple[TrainState, StepInfo]:
    """Takes one step of the optimizer.

    Args:
        state: the previous state; its buffers are donated.
        views: all training views.
        extent: of the cameras [m].
        config: traced but for its structure; `config.raster` holds the budget.
        schedule: traced.

    Returns:
        The state after, and what happened. Where a view needs more than the budget, or the loss
        or a gradient is not finite, the state is that from before, step number included: to
        repeat the step with a larger budget is to lose nothing.
    """
    loss, gradient, statistics, report = _gradients(state, views, config)
    if config.strategy == "mcmc":
        extra, slope = jax.value_and_grad(density.regularization)(state.scene, config)
        loss, gradient = loss + extra, jax.tree.map(jnp.add, gradient, slope)
    rate = mean_rate(config, extent, state.step + 1)
    scene, moments, is_done = guarded_update(
        state.scene,
        gradient,
        state.moments,
        rate,
        state.step // schedule.sh_every,
        config,
        (report.overflow == 0) & jnp.isfinite(loss),
    )
    keep: Callable[[Array, Array], Array] = lambda new, old: jnp.where(is_done, new, old)
    if config.strategy == "mcmc":
        noisy = density.perturbed(scene, rate, config, key=_key(config, _NOISE, state.step))
        scene = jax.tree.map(keep, noisy, scene)
    bad = jnp.where(report.overflow > 0, OVERFLOWN, DIVERGED)
    info = StepInfo(
        outcome=jnp.where(is_done, DONE, bad),
        loss=loss,
        psnr=psnr_of(report.mse),
        num_gaussians=jnp.sum(state.scene.is_alive, dtype=jnp.int32),
        num_intersections=report.num_intersections,
    )
    statistics = jax.tree.map(keep, statistics, state.statistics)
    step = keep(state.step + 1, state.step)
    return TrainState(scene, moments, statistics, step, state.dropped), info


def _gradients(
    state: TrainState, views: Views, config: TrainConfig
) -> tuple[Float[Array, ""], GaussianScene, DensityStatistics, _ViewReport]:
    """Averages loss and gradient over this step's views, which are taken one after the other."""
    num = config.views_per_step
    background = _background(config, state.step)

    def add_view(carry: _Sums, slot: Int[Array, ""]) -> tuple[_Sums, None]:
        total, gradient, statistics, report = carry
        view = views.view(view_index(config, state.step * num + slot, len(views)))
        (loss, found), (slope, pull) = jax.value_and_grad(_view_loss, argnums=(0, 1), has_aux=True)(
            state.scene, jnp.zeros((state.scene.capacity, 2)), view, background, config
        )
        statistics = density.observe(
            statistics, pull, _in_view(state.scene, view), views.width, views.height
        )
        report = _ViewReport(
            mse=report.mse + found.mse / num,
            num_intersections=jnp.maximum(report.num_intersections, found.num_intersections),
            overflow=report.overflow + found.overflow,
        )
        gradient = jax.tree.map(lambda a, b: a + b / num, gradient, slope)
        return (total + loss / num, gradient, statistics, report), None

    zero = jnp.zeros((), dtype=jnp.int32)
    start = (
        jnp.zeros(()),
        jax.tree.map(jnp.zeros_like, state.scene),
        state.statistics,
        _ViewReport(mse=jnp.zeros(()), num_intersections=zero, overflow=zero),
    )
    if num == 1:
        return add_view(start, zero)[0]
    return jax.lax.scan(add_view, start, jnp.arange(num))[0]


def _view_loss(
    scene: GaussianScene,
    center_offsets: Float[Array, "n 2"],
    view: PosedImage,
    background: Float[Array, " 3"],
    config: TrainConfig,
) -> tuple[Float[Array, ""], _ViewReport]:
    rendering = render(
        scene,
        view.camera,
        view.T_world_camera,
        background,
        config.raster,
        center_offsets=center_offsets,
    )
    loss, mse = loss_and_error(rendering.rgb, view.rgb, config.lambda_dssim)
    return loss, _ViewReport(mse, rendering.num_intersections, rendering.overflow)


def _in_view(scene: GaussianScene, view: PosedImage) -> Bool[Array, " n"]:
    """Checks whether the centers lie in the image."""
    pixels, z = project(view.camera, transform(invert_pose(view.T_world_camera), scene.means))
    size = jnp.array([view.camera.width, view.camera.height], dtype=jnp.float32)
    inside = (pixels > 0.0) & (pixels < size[None, :])
    return scene.is_alive & (z > NEAR_PLANE) & inside.all(axis=1)


def _background(config: TrainConfig, step: Int[Array, ""]) -> Float[Array, " 3"]:
    if config.background == "random":
        return jax.random.uniform(_key(config, _BACKGROUND, step), (3,))
    return jnp.full(3, 1.0 if config.background == "white" else 0.0)


@functools.partial(jax.jit, donate_argnames=("state",))
def refine_step(
    state: TrainState, extent: Float[Array, ""], config: TrainConfig, schedule: Schedule
) -> tuple[TrainState, density.Refinement]:
    """Refines the Gaussians by the strategy of the config, and begins new statistics."""
    key = _key(config, _REFINE, state.step)
    if config.strategy == "mcmc":
        found = density.relocate(state.scene, state.moments, config, key=key)
    else:
        was_reset = state.step > schedule.reset_every
        found = density.refine(
            state.scene, state.moments, state.statistics, extent, was_reset, config, key=key
        )
    scene, moments, refinement = found
    statistics = empty_statistics(scene.capacity)
    dropped = state.dropped + refinement.dropped
    return TrainState(scene, moments, statistics, state.step, dropped), refinement


@functools.partial(jax.jit, donate_argnames=("state",))
def reset_step(state: TrainState, config: TrainConfig) -> TrainState:
    """Resets the opacities."""
    scene, moments = density.reset_opacities(state.scene, state.moments, config)
    return TrainState(scene, moments, state.statistics, state.step, state.dropped)


def loss_and_error(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Computes the loss of an image, and the mean squared error of its clipped colors.

    The loss can be differentiated by `rgb`.
    """
    return by_platform(cpu=_by_kernels, default=_by_formulas)(rgb, target, lambda_dssim)


def _by_formulas(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    error = jnp.mean((jnp.clip(rgb, 0.0, 1.0) - target) ** 2)
    return photometric_loss(rgb, target, lambda_dssim), error


@jax.custom_vjp
def _by_kernels(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    return _by_kernels_forward(rgb, target, lambda_dssim)[0]


def _by_kernels_forward(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> tuple[tuple[Float[Array, ""], Float[Array, ""]], tuple[Array, Array]]:
    weight = jnp.asarray(lambda_dssim, dtype=jnp.float32)
    numbers, gradient = calls.image_loss(rgb, target, weight)
    return (numbers[0], numbers[1]), (gradient, weight)


def _by_kernels_backward(
    residuals: tuple[Array, Array], by_results: tuple[Float[Array, ""], Float[Array, ""]]
) -> tuple[Array, Array, Array]:
    gradient, weight = residuals
    return by_results[0] * gradient, jnp.zeros_like(gradient), jnp.zeros_like(weight)


_by_kernels.defvjp(_by_kernels_forward, _by_kernels_backward)


def photometric_loss(
    rgb: Float[Array, "H W 3"],
    target: Float[Array, "H W 3"],
    lambda_dssim: Float[Array, ""] | float,
) -> Float[Array, ""]:
    """Computes (1 - lambda) L1 + lambda (1 - SSIM)."""
    l1 = jnp.mean(jnp.abs(rgb - target))
    return (1.0 - lambda_dssim) * l1 + lambda_dssim * (1.0 - structural_similarity(rgb, target))


def structural_similarity(
    rgb: Float[Array, "H W 3"], target: Float[Array, "H W 3"]
) -> Float[Array, ""]:
    """Computes the mean SSIM in [-1, 1] with an 11 x 11 Gaussian window and zero padding.

    The zeros beyond the edge and the biased variances are those of the 3DGS trainer; the SSIM
    that evaluates (evaluation) follows scikit-image instead.
    """
    x, y = jnp.moveaxis(rgb, -1, 0), jnp.moveaxis(target, -1, 0)
    blurred = blur(jnp.concatenate([x, y, x * x, y * y, x * y]))
    mean_x, mean_y, xx, yy, xy = (blurred[3 * i : 3 * i + 3] for i in range(5))
    variances = (xx - mean_x * mean_x) + (yy - mean_y * mean_y)
    covariance = xy - mean_x * mean_y
    luminance = (2.0 * mean_x * mean_y + SSIM_C1) / (mean_x * mean_x + mean_y * mean_y + SSIM_C1)
    return jnp.mean(luminance * (2.0 * covariance + SSIM_C2) / (variances + SSIM_C2))


@jax.custom_vjp
def blur(planes: Float[Array, "c H W"]) -> Float[Array, "c H W"]:
    """Filters each plane with the Gaussian window, zeros beyond the edges.

    Separable, as shifted sums: XLA's convolutions are 60 times slower on CPUs.
    """
    height, width = planes.shape[1:]
    padded = jnp.pad(
        planes, [(0, 0), (WINDOW_RADIUS, WINDOW_RADIUS), (WINDOW_RADIUS, WINDOW_RADIUS)]
    )
    rows = jnp.asarray(sum(w * padded[:, :, i : i + width] for i, w in enumerate(TAPS)))
    return jnp.asarray(sum(w * rows[:, i : i + height] for i, w in enumerate(TAPS)))


# The window is symmetric, so the blur is its own transpose; autodiff of the shifts is slower.
blur.defvjp(lambda planes: (blur(planes), None), lambda _, gradient: (blur(gradient),))


def psnr_of(mse: Float[Array, "*n"]) -> Float[Array, "*n"]:
    """Computes the PSNR [dB] from a mean squared error of colors in [0, 1]."""
    return -10.0 * jnp.log10(jnp.maximum(mse, 1e-10))
