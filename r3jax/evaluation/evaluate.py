"""Evaluates a scene of Gaussians on test views: renders each and compares it with the true image.

Shape symbols: v views; H, W size of every image.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, UInt8

from r3jax.errors import InputError
from r3jax.evaluation.image_metrics import in_batches, psnr, ssim, to_8_bits
from r3jax.evaluation.scores import ViewRow
from r3jax.splatting.backend import RasterConfig
from r3jax.splatting.render import render
from r3jax.splatting.scene import GaussianScene
from r3jax.splatting.views import Views

_PIXELS_AT_A_TIME = 1 << 18
"""Pixels whose metrics are computed at once. More fall out of a CPU's cache: with four times as
many, SSIM takes three times as long per image."""

ImageMetric = Callable[[Float[Array, "b H W 3"], Float[Array, "b H W 3"]], np.ndarray]
"""Rendered and true images in [0, 1] to one number each, such as `lpips.Lpips`."""


@dataclass(frozen=True)
class Evaluation:
    """The result of an evaluation."""

    rows: tuple[ViewRow, ...]
    """One per view, in their order."""

    renders: np.ndarray
    """The renders that were evaluated, [v, H, W, 3] uint8."""


def evaluate(
    scene: GaussianScene,
    views: Views,
    config: RasterConfig | None = None,
    *,
    background: Float[Array, " 3"] | None = None,
    lpips: ImageMetric | None = None,
    renderability: Sequence[float] | None = None,
    numbers: Sequence[int] | None = None,
    on_view: Callable[[int], None] | None = None,
) -> Evaluation:
    """Renders every view, rounds it to 8 bits and compares it with the true image.

    Args:
        scene: the scene.
        views: true images with poses, depth and intrinsics, of one size.
        config: the rasterizer; a budget of intersections left open is raised as needed.
        background: RGB behind everything, the one of the training; black by default.
        lpips: the perceptual metric (`lpips.load_lpips`); left out by default.
        renderability: of each view, to stand in its row; see `r3jax.renderability`.
        numbers: numbers of the views for the rows; 0, 1, ... by default.
        on_view: called with the number of views rendered so far.

    Returns:
        A row for each view, and the renders.

    Raises:
        ValueError: no views, images smaller than the metrics' windows, `renderability` or
            `numbers` that are not one per view, parameters or renders that are not finite, a
            fixed budget that does not suffice.
    """
    count = len(views)
    if count == 0:
        raise InputError("there are no views to evaluate")
    for name, given in (("renderability", renderability), ("numbers", numbers)):
        if given is not None and len(given) != count:
            raise InputError(f"{name} has {len(given)} entries for {count} views")
    _check_scene(scene)
    config = RasterConfig() if config is None else config
    background = jnp.zeros(3) if background is None else background
    names = list(range(count)) if numbers is None else [int(number) for number in numbers]

    renders, coverage = _render_all(scene, views, background, config, names, on_view)
    batch = max(1, _PIXELS_AT_A_TIME // (views.height * views.width))
    measured = views.depth > 0.0
    table = in_batches(_compare, batch, renders, views.rgb, measured)
    perceptual = [None] * count
    if lpips is not None:
        compare = functools.partial(_perceive, lpips)
        perceptual = in_batches(compare, batch, renders, views.rgb).tolist()
    rows = tuple(
        ViewRow(
            view=names[i],
            psnr=float(table[i, 0]),
            ssim=float(table[i, 1]),
            lpips=perceptual[i],
            psnr_measured=float(table[i, 2]),
            measured=float(table[i, 3]),
            coverage=float(coverage[i]),
            renderability=None if renderability is None else float(renderability[i]),
        )
        for i in range(count)
    )
    return Evaluation(rows, renders)


def _check_scene(scene: GaussianScene) -> None:
    """Refuses parameters that are not finite, which rasterizers would silently skip."""
    finite = np.ones(scene.capacity, dtype=bool)
    for values in jax.tree.leaves(scene):
        finite &= np.isfinite(np.asarray(values)).reshape(scene.capacity, -1).all(axis=1)
    if not finite.all():
        raise InputError(
            f"{np.sum(~finite)} of {scene.capacity} Gaussians have parameters that are not finite, "
            f"the first in row {np.argmin(finite)}: did the training diverge?"
        )


class _Drawn(eqx.Module):
    """One rendered view, ready to be compared."""

    rgb: UInt8[Array, "H W 3"]
    coverage: Float[Array, ""]
    num_broken: Int[Array, ""]
    num_intersections: Int[Array, ""]
    overflow: Int[Array, ""]


@jax.jit
def _draw(
    scene: GaussianScene,
    views: Views,
    index: Int[Array, ""],
    background: Float[Array, " 3"],
    config: RasterConfig,
) -> _Drawn:
    view = views.view(index)
    rendering = render(scene, view.camera, view.T_world_camera, background, config)
    broken = ~jnp.all(jnp.isfinite(rendering.rgb), axis=-1)
    return _Drawn(
        rgb=_to_bytes(rendering.rgb),
        coverage=jnp.mean(rendering.alpha),
        num_broken=jnp.sum(broken),
        num_intersections=rendering.num_intersections,
        overflow=rendering.overflow,
    )


def _render_all(
    scene: GaussianScene,
    views: Views,
    background: Float[Array, " 3"],
    config: RasterConfig,
    names: list[int],
    on_view: Callable[[int], None] | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Renders all views as bytes, [v, H, W, 3], and their coverage, [v]."""
    is_open = config.max_intersections is None
    renders = np.empty(views.rgb.shape, dtype=np.uint8)
    coverage = np.empty(len(views), dtype=np.float32)
    for i, name in enumerate(names):
        drawn = _draw(scene, views, jnp.asarray(i), background, config)
        while int(drawn.overflow) > 0:
            needed = int(drawn.num_intersections)
            if not is_open:
                raise InputError(
                    f"view {name} needs {needed} intersections, but max_intersections is "
                    f"{config.max_intersections}: raise it, or leave it open"
                )
            config = config.with_room(needed)
            drawn = _draw(scene, views, jnp.asarray(i), background, config)
        if int(drawn.num_broken) > 0:
            raise InputError(
                f"view {name} renders to values that are not finite at {int(drawn.num_broken)} "
                "pixels: look at the background and at the largest colors of the scene"
            )
        renders[i] = np.asarray(drawn.rgb)
        coverage[i] = float(drawn.coverage)
        if on_view is not None:
            on_view(i + 1)
    return renders, coverage


@jax.jit
def _compare(
    renders: UInt8[Array, "b H W 3"],
    truth: UInt8[Array, "b H W 3"],
    measured: Bool[Array, "b H W"],
) -> Float[Array, "b 4"]:
    """Computes PSNR, SSIM, PSNR of the measured pixels, and the share of the measured pixels."""
    x, y = _to_floats(renders), _to_floats(truth)
    share = jnp.mean(measured.astype(jnp.float32), axis=(-2, -1))
    return jnp.stack([psnr(x, y), ssim(x, y), psnr(x, y, measured), share], axis=-1)


def _perceive(
    lpips: ImageMetric,
    renders: UInt8[np.ndarray, "b H W 3"],
    truth: UInt8[Array, "b H W 3"],
) -> np.ndarray:
    return lpips(_to_floats(jnp.asarray(renders)), _to_floats(truth))


def _to_bytes(rgb: Float[Array, "*n 3"]) -> UInt8[Array, "*n 3"]:
    return jnp.round(to_8_bits(rgb) * 255.0).astype(jnp.uint8)


def _to_floats(rgb: UInt8[Array, "*n 3"]) -> Float[Array, "*n 3"]:
    return rgb.astype(jnp.float32) / 255.0
