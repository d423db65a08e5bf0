"""What a view would repair: who looks at a surface, how well it answers, and what would help.

A voxel is asked for by standpoints s, places in reachable free space from which it can be seen.
What a set of views is worth beside those already taken:

    value(views)  = sum over voxels and the standpoints that see them of
                    worth_s max(cover_s, max over the views v that see the voxel of K(v, s))
    K(v, s)       = b delta^(kappa (1 - b)) min(1, rho_v / rho_s)^(1 - delta b)
    b             = max(<q_v, r_s>, 0)^kappa,    kappa = 2

with q_v the direction bin in which the view falls, all that the map will remember of its
direction; r_s the direction to the standpoint; rho = focal / distance; delta the consistency of
the voxel's color. `cover` is the same of the bins that were visited and the best resolution.
`worth` is how large a voxel looks from a standpoint, 1 / max(distance, 1 m)^2, scaled so that the
worths of a voxel sum to 1 on average: voxels that everybody looks at have more, those that nobody
can see have none.

A sum of maxima is monotone and submodular (facility location): a view never harms, and helps the
less the more others there are, so that the greedy choice of m views is worth at least 1 - 1/e of
the best (Nemhauser, Wolsey & Fisher 1978). Two things in R (`renderability`) would break that and
are otherwise here. The box of kappa: two views can span it that do nothing alone; kappa is what
the paper takes outside of it. The best resolution, shared by all bins: a near view would sharpen a
far one from another side; each view brings its own. How consistent colors will be cannot be
foreseen: delta stays.

Shape symbols: S standpoints; n voxels; K voxels of a chunk; B bins of the panorama.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from r3jax.geometry.cameras import Camera
from r3jax.geometry.sphere import fibonacci_lattice, nearest_bin
from r3jax.scoring.chunks import Selection, for_selected
from r3jax.scoring.config import ScoringConfig
from r3jax.scoring.directions import nearest_seen
from r3jax.scoring.lack import sum_by_direction
from r3jax.scoring.views import panorama_view, pinhole_view
from r3jax.scoring.visibility import seen_in
from r3jax.scoring.voxels import Voxels

NEAREST = 1.0
"""Nearer voxels look no larger [m]: else the few beside a standpoint would outweigh a room."""

KAPPA = 2.0
"""One number, as a power must be here; a square also costs no logarithm."""

_LOG_ZERO = -1e6
"""In place of log 0: its power is 0 for any exponent but 0."""


class Demand(eqx.Module):
    """Who asks for which voxels, and how well those answer."""

    position: Float[Array, "S 3"]
    """The standpoints [m]."""

    cover: Float[Array, "S n"]
    """Renderability of a voxel from a standpoint, in [0, 1]; inf where it does not see it, so
    that nothing can be gained."""

    focal: Float[Array, ""]
    """Focal length of the camera with which the standpoints ask [px]."""

    scale: Float[Array, ""]
    """Worth of a voxel that is asked for from 1 m."""


def demand_of(
    voxels: Voxels, standpoints: Float[Array, "S 3"], focal: Float[Array, ""], config: ScoringConfig
) -> Demand:
    """What is asked for from the standpoints. One after the other: `scoring.batch` deals them out.

    Args:
        voxels: what is known.
        standpoints: in free space [m].
        focal: focal length of the camera that will look from there [px].
        config: range and visibility.
    """
    ask = lambda position: asked_from(voxels, focal, config, position)
    cover, size = jax.lax.map(ask, standpoints)
    return joined(standpoints, cover, size, focal)


def asked_from(
    voxels: Voxels, focal: Float[Array, ""], config: ScoringConfig, position: Float[Array, " 3"]
) -> tuple[Float[Array, " n"], Float[Array, ""]]:
    """What one standpoint asks for: a row of `Demand.cover`, and how large all of it looks."""
    num = voxels.count.shape[0]
    _, visible = seen_in(voxels, panorama_view(position, config), config)

    def ask(
        index: Int[Array, " K"],
        valid: Bool[Array, " K"],
        found: tuple[Float[Array, " n"], Float[Array, ""]],
    ) -> tuple[Float[Array, " n"], Float[Array, ""]]:
        cover, size = found
        part = voxels.take(index, valid)
        direction, distance = _towards(part, position)
        cosine = jnp.clip(nearest_seen(part.visited, direction, voxels.num_bins), 0.0, 1.0)
        ratio = part.resolution * distance / focal
        value = _kernel(cosine * cosine, part.delta, _log(part.delta), _log(ratio))
        target = jnp.where(valid, index, num)
        size = size + jnp.sum(jnp.where(valid, _size(distance), 0.0))
        return cover.at[target].set(value, mode="drop"), size

    return for_selected(visible, ask, (jnp.full(num, jnp.inf), jnp.zeros(())))


def joined(
    standpoints: Float[Array, "S 3"],
    cover: Float[Array, "S n"],
    size: Float[Array, " S"],
    focal: Float[Array, ""],
) -> Demand:
    """The demand of all standpoints, from what `asked_from` found for each."""
    num_asked = jnp.sum(jnp.any(jnp.isfinite(cover), axis=0), dtype=jnp.float32)
    return Demand(standpoints, cover, focal, num_asked / jnp.maximum(jnp.sum(size), 1e-6))


def gain_by_direction(
    voxels: Voxels,
    visible: Selection,
    demand: Demand,
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
    num_bins: int,
) -> Float[Array, " B"]:
    """What views from a position would add to the value, by the direction of what they show.

    Args:
        voxels: those of the demand.
        visible: which of them the position sees.
        demand: who asks.
        position: camera center [m].
        focal: focal length [px].
        num_bins: bins of the Fibonacci lattice; 1 sums over all directions.
    """

    def add(
        index: Int[Array, " K"], valid: Bool[Array, " K"], total: Float[Array, " B"]
    ) -> Float[Array, " B"]:
        part = voxels.take(index, valid)
        gain = jnp.where(valid, gain_of_voxels(part, demand, index, position, focal), 0.0)
        return total + sum_by_direction(part.center, gain, position, num_bins)

    return for_selected(visible, add, jnp.zeros(num_bins, dtype=jnp.float32))


def gain_of_voxels(
    part: Voxels,
    demand: Demand,
    index: Int[Array, " K"],
    position: Float[Array, " 3"],
    focal: Float[Array, ""],
) -> Float[Array, " K"]:
    """What seeing each of the voxels at `index`, which are `part`, from a position would add."""
    cover, gain = demand.cover[:, index], jnp.zeros(index.shape)
    for s, (offer, worth) in enumerate(_offers(part, demand, position, focal)):
        gain = gain + worth * jnp.maximum(offer - cover[s], 0.0)
    return gain


def gain_of(
    voxels: Voxels,
    demand: Demand,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
) -> Float[Array, ""]:
    """What one view would add to the value; in voxels: 1 is one that was lost and is perfect."""
    _, visible = seen_in(voxels, pinhole_view(camera, T_world_camera, config), config)
    position = T_world_camera[:3, 3]
    return gain_by_direction(voxels, visible, demand, position, camera.focal, 1)[0]


def cover_after(
    voxels: Voxels,
    demand: Demand,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    config: ScoringConfig,
) -> Demand:
    """The demand that is left when a view has been taken, as far as that can be foreseen."""
    _, visible = seen_in(voxels, pinhole_view(camera, T_world_camera, config), config)
    num, position = voxels.count.shape[0], T_world_camera[:3, 3]

    def improve(
        index: Int[Array, " K"], valid: Bool[Array, " K"], cover: Float[Array, "S n"]
    ) -> Float[Array, "S n"]:
        part = voxels.take(index, valid)
        offers = _offers(part, demand, position, camera.focal)
        best = jnp.stack([offer for offer, _ in offers])
        return cover.at[:, jnp.where(valid, index, num)].max(best, mode="drop")

    return eqx.tree_at(lambda d: d.cover, demand, for_selected(visible, improve, demand.cover))


def value_of(voxels: Voxels, demand: Demand) -> Float[Array, " n"]:
    """Per voxel the sum over its standpoints of worth times cover: what views can add to."""

    def of_standpoint(position: Float[Array, " 3"], cover: Float[Array, " n"]) -> Array:
        worth = demand.scale * _size(_towards(voxels, position)[1])
        return jnp.where(jnp.isfinite(cover), worth * cover, 0.0)

    return jnp.sum(jax.vmap(of_standpoint)(demand.position, demand.cover), axis=0)


def _offers(
    part: Voxels, demand: Demand, position: Float[Array, " 3"], focal: Float[Array, ""]
) -> list[tuple[Float[Array, " K"], Float[Array, " K"]]]:
    """K(v, s) of a view from a position, and worth_s, for each standpoint s.

    The standpoints are looped over, the voxels vectorised. Whether a standpoint sees a voxel is
    not asked: where it does not, the cover is inf.
    """
    direction, distance = _towards(part, position)
    bins = nearest_bin(direction, part.num_bins)
    axis = jnp.asarray(fibonacci_lattice(part.num_bins).T, dtype=jnp.float32)[:, bins]
    delta, log_delta = part.delta, _log(part.delta)
    log_resolution = _log(focal / (distance * demand.focal))
    center, offers = part.center, []
    for s in range(demand.position.shape[0]):
        offset = [demand.position[s, i] - center[i] for i in range(3)]
        squared = offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]
        squared = jnp.maximum(squared, 1e-12)
        along = axis[0] * offset[0] + axis[1] * offset[1] + axis[2] * offset[2]
        ahead = jnp.maximum(along, 0.0)
        bias = jnp.minimum(ahead * ahead / squared, 1.0)
        offer = _kernel(bias, delta, log_delta, log_resolution + 0.5 * jnp.log(squared))
        offers.append((offer, demand.scale / jnp.maximum(squared, NEAREST * NEAREST)))
    return offers


def _kernel(
    bias: Float[Array, " K"],
    delta: Float[Array, " K"],
    log_delta: Float[Array, " K"],
    log_ratio: Float[Array, " K"],
) -> Float[Array, " K"]:
    """K: noise and resolution in one exponential; `log_ratio` of rho_v / rho_s."""
    noise = KAPPA * (1.0 - bias) * log_delta
    return bias * jnp.exp(noise + (1.0 - delta * bias) * jnp.minimum(log_ratio, 0.0))


def _log(x: Float[Array, " K"]) -> Float[Array, " K"]:
    return jnp.where(x > 0.0, jnp.log(jnp.maximum(x, 1e-38)), _LOG_ZERO)


def _size(distance: Float[Array, " K"]) -> Float[Array, " K"]:
    """How large voxels look, in units of one that is 1 m away."""
    return 1.0 / jnp.square(jnp.maximum(distance, NEAREST))


def _towards(
    part: Voxels, position: Float[Array, " 3"]
) -> tuple[Float[Array, "3 K"], Float[Array, " K"]]:
    """Unit vectors from voxels to a position, and the distances [m]."""
    offset = position[:, None] - part.center
    distance = jnp.maximum(jnp.sqrt(jnp.sum(offset * offset, axis=0)), 1e-6)
    return offset / distance[None, :], distance
