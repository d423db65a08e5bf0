"""The expected error of a view, pixel by pixel: from renderability and difficulty.

R measures how well a surface was seen, not how hard it is to render. With the difficulty C of a
voxel (`difficulty`) and D = 1 - R, the expected squared error of a pixel is

    e = a                        whatever is shown,
      + b C + c D^2 + d C D      where it shows a voxel,
      + f L                      where it shows none,

L the mean square of the map's colors, because a missing pixel's error is its brightness. No
coefficient is negative: the error never falls with difficulty, nor rises with R. The mean of e over
a view is its expected squared error, and so its PSNR; with other coefficients it is 1 - SSIM. They
were fitted on trained models (`docs/results/expected-error.md`).

Shape symbols: N rows of the map; h w size of the depth buffer; T terms; p pixels.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from r3jax.geometry.arguments import checked
from r3jax.geometry.cameras import Camera, nan_unless_valid
from r3jax.geometry.numerics import safe_power
from r3jax.geometry.voxels import pack, unpack
from r3jax.mapping.state import MapState, a_map
from r3jax.mapping.table import find
from r3jax.scoring.backend import rows_in_pixels
from r3jax.scoring.config import ScoringConfig, checked_view
from r3jax.scoring.formulas import voxels_of_rows
from r3jax.scoring.terms import score_voxels
from r3jax.visibility.views import pinhole_view

AROUND = np.array(
    [
        (x, y, z)
        for x in (-1, 0, 1)
        for y in (-1, 0, 1)
        for z in (-1, 0, 1)
        if (x, y, z) != (0, 0, 0)
    ]
)
"""Offsets of the 26 voxels that touch a voxel, [26, 3]."""


@checked(state=a_map)
@jax.jit
def voxel_difficulty(state: MapState) -> Float[Array, " N"]:
    """Computes the color contrast between every voxel and its neighbors.

    The root of the mean, over the seen ones among its 26 neighbors and the three channels, of the
    squared difference of the mean colors: 0 for a plain wall, 0.1 to 0.2 for a bookshelf, at most
    1. It needs no additional memory. Rows that describe no voxel, and voxels without a neighbor,
      have 0.
    """
    return difficulty_of_rows(state, jnp.arange(state.capacity, dtype=jnp.int32))


def difficulty_of_rows(state: MapState, row: Int[Array, " n"]) -> Float[Array, " n"]:
    """Computes `voxel_difficulty` of some rows; 0 for row N, which stands for no voxel."""
    is_there = row < state.capacity
    at = jnp.where(is_there, row, 0)
    is_there &= state.present[at]
    own = state.mean[:, at]
    x, y, z = unpack(state.key[0, at], state.key[1, at])

    def add(
        sums: tuple[Float[Array, " n"], Float[Array, " n"]], step: Int[Array, " 3"]
    ) -> tuple[tuple[Float[Array, " n"], Float[Array, " n"]], None]:
        squares, number = sums
        low, high = pack(x + step[0], y + step[1], z + step[2])
        beside = find(state.key, jnp.stack([low, high]), is_there)
        # Absent neighbors have row N: they read a count of 0, and add nothing.
        is_seen = state.count.at[beside].get(mode="fill", fill_value=0.0) > 0.0
        color = state.mean.at[:, beside].get(mode="fill", fill_value=0.0)
        difference = jnp.mean((color - own) ** 2, axis=0)
        squares = squares + jnp.where(is_seen, difference, 0.0)
        return (squares, number + is_seen.astype(jnp.float32)), None

    nothing = jnp.zeros(row.shape), jnp.zeros(row.shape)
    # One after the other: 26 searches at once would take 26 times the memory.
    (squares, number), _ = jax.lax.scan(add, nothing, jnp.asarray(AROUND, jnp.int32))
    # Exactly 0 on a plain wall, where the gradient of a plain root is infinite.
    return safe_power(squares / jnp.maximum(number, 1.0), jnp.asarray(0.5))


REACH = 4.0
"""Views show voxels up to this multiple of the sensor's range: what was measured from nearby is no
hole when it is seen from afar."""

TERMS = ("always", "unseen", "difficulty", "squared deficit", "difficulty x deficit")
"""Names of the terms, in the order of the coefficients."""

_PRIOR_BRIGHTNESS = 0.25
"""Mean square color of an empty map, with the weight of one voxel."""


class Fit(NamedTuple):
    """The calibration of one error."""

    coefficients: tuple[float, ...]
    """Of the terms, each at least 0."""

    low: float
    """10th percentile of the difference between truth and expectation."""

    high: float
    """90th percentile of the difference."""


SQUARED = Fit((0.0, 0.141, 0.0377, 0.00696, 0.14), -5.41, 4.081)
"""Squared error; the differences are of the PSNR [dB]."""

DISSIMILARITY = Fit((0.189, 0.877, 0.0, 0.0, 6.03), -0.182, 0.15)
"""1 - SSIM; the differences are of the SSIM."""

_LEAST = 1e-5
"""Squared error that no view falls below (50 dB): images have eight bits, and no model is exact."""


class ErrorImages(eqx.Module):
    """The expected error in each pixel of one view."""

    squared: Float[Array, "h w"]
    """Squared error, averaged over the channels."""

    dissimilarity: Float[Array, "h w"]
    """1 - SSIM."""


class ExpectedError(eqx.Module):
    """The expected error of one view, with 80 % intervals."""

    psnr: Float[Array, ""]
    """PSNR [dB]."""

    psnr_low: Float[Array, ""]
    """10th percentile [dB]."""

    psnr_high: Float[Array, ""]
    """90th percentile [dB]."""

    ssim: Float[Array, ""]
    """SSIM."""

    ssim_low: Float[Array, ""]
    """10th percentile."""

    ssim_high: Float[Array, ""]
    """90th percentile."""


@checked_view
@jax.jit
def error_terms(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
    difficulty: Float[Array, " N"] | None = None,
) -> Float[Array, "T h w"]:
    """Computes the terms of the expected error in the pixels of one view, in the order of `TERMS`.

    Differentiable with respect to the pose as `renderability_image` is: which voxel a pixel sees
    is held fixed, its R varies.

    Args:
        state: the map.
        camera: of the view.
        T_world_camera: its pose.
        config: range and size of the depth buffer.
        difficulty: `voxel_difficulty` of the map, if many views of one map are evaluated; None:
            computed for the voxels in view.
    """
    config = ScoringConfig() if config is None else config
    far = eqx.tree_at(lambda c: c.max_range, config, REACH * config.max_range)
    row = rows_in_pixels(state, pinhole_view(camera, T_world_camera, far), far)
    shown = voxels_of_rows(state, row)
    value = score_voxels(shown, T_world_camera[:3, 3], camera.focal, config.score).value
    contrast = _difficulty_in_pixels(state, row.reshape(-1), difficulty)
    hit = shown.present
    deficit = jnp.where(hit, 1.0 - value, 0.0)
    unseen = jnp.where(hit, 0.0, mean_square_color(state))
    terms = jnp.stack([jnp.ones_like(value), unseen, contrast, deficit**2, contrast * deficit])
    return nan_unless_valid(camera, T_world_camera, state.voxel_size) * terms.reshape(
        -1, *row.shape
    )


def _difficulty_in_pixels(
    state: MapState, row: Int[Array, " p"], difficulty: Float[Array, " N"] | None
) -> Float[Array, " p"]:
    if difficulty is None:
        return difficulty_of_rows(state, row)
    return difficulty.at[row].get(mode="fill", fill_value=0.0)


def mean_square_color(state: MapState) -> Float[Array, ""]:
    """Averages the squared colors of all voxels, the assumed brightness of unknown pixels."""
    squares = jnp.where(state.present, jnp.mean(state.mean**2, axis=0), 0.0)
    number = jnp.sum(state.present, dtype=jnp.float32)
    return (jnp.sum(squares) + _PRIOR_BRIGHTNESS) / (number + 1.0)


@checked_view
@jax.jit
def expected_error_images(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
    difficulty: Float[Array, " N"] | None = None,
) -> ErrorImages:
    """Predicts the error of every pixel of one view, in the pixels of `renderability_image`.

    Arguments as in `error_terms`.
    """
    terms = error_terms(state, camera, T_world_camera, config, difficulty)
    return ErrorImages(_weighted(SQUARED, terms), _weighted(DISSIMILARITY, terms))


@checked_view
@jax.jit
def expected_error(
    state: MapState,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig | None = None,
    difficulty: Float[Array, " N"] | None = None,
) -> ExpectedError:
    """Predicts PSNR and SSIM of one view from the means of `expected_error_images`.

    The values are those of a model of the frames in the map, trained like the benchmark's models.
    They rank the views of a model; their level depends on the training. Written for one pose;
    `jax.vmap` it over many:

        hard = r3jax.voxel_difficulty(map_state)
        expect = lambda T: r3jax.expected_error(map_state, camera, T, difficulty=hard)
        jax.vmap(expect)(candidates).psnr

    Arguments as in `error_terms`.
    """
    terms = jnp.mean(error_terms(state, camera, T_world_camera, config, difficulty), axis=(1, 2))
    return expected_of_means(terms)


def expected_of_means(terms: Float[Array, " T"]) -> ExpectedError:
    """Predicts PSNR and SSIM from the terms' means over a view."""
    psnr = -10.0 * jnp.log10(_weighted(SQUARED, terms) + _LEAST)
    ssim = 1.0 - _weighted(DISSIMILARITY, terms)
    return ExpectedError(
        psnr,
        psnr + SQUARED.low,
        psnr + SQUARED.high,
        ssim,
        ssim + DISSIMILARITY.low,
        ssim + DISSIMILARITY.high,
    )


def _weighted(fit: Fit, terms: Float[Array, "T ..."]) -> Float[Array, "..."]:
    return jnp.tensordot(jnp.asarray(fit.coefficients), terms, axes=1)
