"""GAVIS: views with the highest entropy of colors, because no photo shows their content from there.

    utility = mean over the rays of a view of H(u)      (`unknown_share`, `unseen_share`)
    total   = utility / sum of utilities - lambda2 * path / sum of paths

The paper's: visibility that depends on the direction, from all photos and what hides what in them;
particles that stand for unexplored space and were never seen; a view's utility is the information
that it brings, which is the entropy of its rays, as the noise of any photo is alike.
Our reading: surface elements are the map's voxels, opaque, and photos its direction bins; the
particles are the unexplored cells of the coarse grid, of an opacity of their own in place of 0,
by which a ray's color may come from them; colors that no photo shows are spread alike everywhere;
kappa, that opacity and that spread, whose values we could not read; candidates, paths and their
weight are those of `r3`. No radiance field is kept.

A ray passes unexplored cells, which hold matter that no photo shows with some probability each, and
ends at a voxel, or nowhere. With k unexplored cells before its end, the color that is seen comes
from something that no photo shows with the probability

    u = 1 - (1 - a)^k V        V of the voxel in the ray's direction; 1 for a ray that ends nowhere

and is then spread as widely as colors are; otherwise it is known up to noise. The entropy of that
mixture, over the noise's, is at most

    H(u) = -u ln u - (1 - u) ln(1 - u) + u h,        h the entropy of any color over the noise's

and equal to it but for what both parts have in common, which is next to nothing.

The visibility of a voxel in a direction, from the photos that there are:

    v_p(d) = T_p exp(kappa (<d, d_p> - 1))             what photo p says of direction d
    V(d)   = 1 - prod over p of (1 - v_p(d))           at least one photo says something

d_p is the direction from the voxel to photo p, and T_p is 1 if nothing hides the voxel there.

The paper keeps the sum over p of v_p in spherical harmonics. From a sum the product is not to be
had, only the bound V >= 1 - (1 - sum / |P|)^|P|, by which it decides. Here every voxel holds the
directions themselves, as bits, so the product is exact but for the width of a bin; photos in the
same bin count once. Unlike the bound, it never falls when a photo is added.

Shape symbols: C views; h w rays of a view; X Y Z cells of the grid; W words of bins.
"""

import math
from dataclasses import dataclass, field
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, UInt32

from r3jax.baselines.pixels import PixelView, score_pixels
from r3jax.errors import InputError
from r3jax.geometry.cameras import Camera, pixel_rays
from r3jax.geometry.numerics import safe_norm
from r3jax.geometry.sphere import fibonacci_lattice
from r3jax.mapping.occupancy import OccupancyGrid, world_to_cell
from r3jax.mapping.state import MapState
from r3jax.planning.candidates import Candidates
from r3jax.planning.config import PlannerConfig
from r3jax.planning.decide import GreedyPolicy
from r3jax.planning.policy import Situation
from r3jax.visibility.views import pinhole_view


def unseen_share(
    visited: UInt32[Array, "W ..."],
    direction: Float[Array, "3 ..."],
    num_bins: int,
    kappa: Float[Array, ""],
) -> Float[Array, "..."]:
    """Computes 1 - V: the product over the visited bins of 1 - exp(kappa (<q_k, d> - 1)).

    It lies in [0, 1].

    1 where no bin was visited, 0 at the direction of one that was.

    Args:
        visited: bit `k % 32` of word `k // 32` is set for each visited bin k.
        direction: unit vectors from the voxels to the camera.
        num_bins: number of bins.
        kappa: how fast visibility falls with the angle; 0: not at all.
    """
    x, y, z = direction
    share = jnp.ones_like(x)
    # Python's floats: the lattice becomes literals of the program, and no gather is needed.
    for k, (q_x, q_y, q_z) in enumerate(fibonacci_lattice(num_bins).astype("float32").tolist()):
        is_visited = (visited[k // 32] & jnp.uint32(1 << (k % 32))) != jnp.uint32(0)
        # Rounding may carry a cosine past 1, and the share below 0.
        angle_term = jnp.minimum(q_x * x + q_y * y + q_z * z - 1.0, 0.0)
        share = share * jnp.where(is_visited, 1.0 - jnp.exp(kappa * angle_term), 1.0)
    return share


STRIDE = 4
"""Every fourth pixel of every fourth row has a ray: an unexplored cell at the sensor's range is as
wide as that, and samples of cells are most of the time."""


class RayEnds(eqx.Module):
    """What the rays of a view, or of several, end at."""

    hit: Bool[Array, "*C h w"]
    """True for a voxel, False for nothing within range."""

    depth: Float[Array, "*C h w"]
    """z-depth of the voxel [m]; inf for nothing."""

    offset: Float[Array, "*C 3 h w"]
    """From the voxel to the camera [m]."""

    visited: UInt32[Array, "*C W h w"]
    """Directions from which the voxel was seen."""


class Beliefs(eqx.Module):
    """Beliefs about objects that no photo shows."""

    kappa: Float[Array, ""]
    """Fall of visibility with the angle."""

    cell_opacity: Float[Array, ""]
    """Probability a that an unexplored cell stops a ray."""

    color_entropy: Float[Array, ""]
    """Entropy h of a color that no photo shows, over that of the noise [nats]."""


def ends_of_rays(view: PixelView) -> RayEnds:
    """Picks the pixels that have rays; `view.rows` are the visited bins."""
    thin = lambda x: x[..., ::STRIDE, ::STRIDE]
    return RayEnds(thin(view.hit), thin(view.depth), thin(view.offset), thin(view.rows))


@partial(jax.jit, static_argnames=("num_bins", "num_steps"))
def entropy_of_views(
    ends: RayEnds,
    grid: OccupancyGrid,
    camera: Camera,
    poses: Float[Array, "C 4 4"],
    max_range: Float[Array, ""],
    beliefs: Beliefs,
    *,
    num_bins: int,
    num_steps: int,
) -> Float[Array, " C"]:
    """Computes the mean over the rays of each view of H(u) [nats].

    Args:
        ends: of the rays of all views.
        grid: whose unexplored cells count.
        camera: of the depth buffer that the rays were picked from.
        poses: of the views.
        max_range: rays go no farther [m].
        beliefs: beliefs about objects that no photo shows.
        num_bins: number of direction bins.
        num_steps: cells along the range, rounded up.
    """

    def look(one: tuple[RayEnds, Array]) -> Float[Array, "h w"]:
        ends, pose = one
        direction = ends.offset / jnp.maximum(safe_norm(ends.offset, axis=0), 1e-6)[None]
        unseen = unseen_share(ends.visited, direction, num_bins, beliefs.kappa)
        cells = unexplored_before(ends.depth, grid, camera, pose, max_range, num_steps)
        return unknown_share(ends.hit, unseen, cells, beliefs)

    # Entropies outside of the map: XLA on a CPU would repeat the bins in each of their logarithms.
    shares = jax.lax.map(look, (ends, poses))
    return jnp.mean(entropy(shares, beliefs), axis=(1, 2))


def unknown_share(
    hit: Bool[Array, "h w"],
    unseen: Float[Array, "h w"],
    cells: Float[Array, "h w"],
    beliefs: Beliefs,
) -> Float[Array, "h w"]:
    """Computes u: the probability that a ray's color comes from something in no photo."""
    passes = (1.0 - beliefs.cell_opacity) ** cells
    # As a sum of small terms: 1 - passes (1 - unseen) would lose the digits of a known voxel.
    return (1.0 - passes) + passes * jnp.where(hit, unseen, 0.0)


def entropy(share: Float[Array, "*C h w"], beliefs: Beliefs) -> Float[Array, "*C h w"]:
    """Computes H(u) of rays [nats]."""
    known = 1.0 - share
    # xlogy: 0 ln 0 is 0, at rays that are known, or not known, for certain.
    both = -jax.scipy.special.xlogy(share, share) - jax.scipy.special.xlogy(known, known)
    return both + share * beliefs.color_entropy


def unexplored_before(
    depth: Float[Array, "h w"],
    grid: OccupancyGrid,
    camera: Camera,
    T_world_camera: Float[Array, "4 4"],
    max_range: Float[Array, ""],
    num_steps: int,
) -> Float[Array, "h w"]:
    """Measures how far rays run through unexplored cells, in edges of a cell.

    There is one sample per edge (midpoint rule).

    Args:
        depth: z-depth at which the rays end [m].
        grid: the cells.
        camera: of the full depth buffer.
        T_world_camera: its pose.
        max_range: rays go no farther [m].
        num_steps: samples of a ray.
    """
    rays = pixel_rays(camera)[::STRIDE, ::STRIDE]
    # The rays have z = 1: their length turns depth along the axis into distance.
    length = safe_norm(rays, axis=-1)
    end = jnp.minimum(depth * length, max_range)
    R, position = T_world_camera[:3, :3], T_world_camera[:3, 3]
    unit = jnp.matmul(rays / length[..., None], R.T, precision="highest")
    unexplored = grid.unexplored
    at = (jnp.arange(num_steps, dtype=jnp.float32) + 0.5) * grid.cell_size
    points = position[None, None, None] + unit[:, :, None] * at[None, None, :, None]
    cell, size = world_to_cell(grid, points), jnp.array(grid.log_odds.shape)[None, None, None]
    is_inside = jnp.all((cell >= 0) & (cell < size), axis=-1)
    # Clipped for the lookup alone: `is_inside` has refused what lies outside.
    x, y, z = jnp.moveaxis(jnp.clip(cell, 0, size - 1), -1, 0)
    counts = unexplored[x, y, z] & is_inside & (at[None, None] < end[..., None])
    return jnp.sum(counts, axis=-1, dtype=jnp.float32)


@dataclass(frozen=True)
class GavisConfig(PlannerConfig):
    """Settings of `gavis`; of the scoring it takes the range and the depth buffer."""

    kappa: float = 4.0
    """Fall of visibility with the angle to a photo's direction: 0.31 at 45 degrees, 0.02 at 90.
    0: seen from one side, a voxel is known from all (the paper's isotropic ablation)."""

    cell_opacity: float = 0.1
    """Probability that an unexplored cell stops a ray; 0: unexplored space is empty (the paper's
    ablation without virtual particles)."""

    color_entropy: float = 6.9
    """Entropy of a color that no photo shows, over that of a photo's noise [nats]: 3 ln 10, a
    standard deviation ten times as large in each channel."""

    def __post_init__(self) -> None:
        """Refuses values that would fail later, and says which."""
        super().__post_init__()
        for name in ("kappa", "color_entropy"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"{name} must be a finite number >= 0, got {value}")
        if not 0.0 <= self.cell_opacity <= 1.0:
            raise InputError(f"cell_opacity must lie in [0, 1], got {self.cell_opacity}")

    def beliefs(self) -> Beliefs:
        """Returns the three parameters as arrays, traced, so that a sweep compiles once."""
        numbers = (self.kappa, self.cell_opacity, self.color_entropy)
        return Beliefs(*(jnp.asarray(number, dtype=jnp.float32) for number in numbers))


@dataclass(frozen=True)
class Gavis(GreedyPolicy):
    """Views with the highest entropy of rays, by visibility that depends on the direction."""

    config: GavisConfig = field(default_factory=GavisConfig)

    name = "gavis"
    source = "GAVIS, CVPR 2026, arXiv 2605.30342"
    Config = GavisConfig

    def score(
        self, situation: Situation, candidates: Candidates, *, key: Array
    ) -> tuple[Candidates, dict[str, np.ndarray]]:
        """Computes the mean entropy of the rays of every view."""
        del key
        state, grid = situation.map_state, situation.scoring_grid
        poses = candidates.poses_on_device()
        return candidates, {"utility": self.entropies(state, grid, situation.camera, poses)}

    def entropies(
        self,
        state: MapState,
        grid: OccupancyGrid,
        camera: Camera,
        poses: Float[Array | np.ndarray, "C 4 4"],
    ) -> np.ndarray:
        """Computes the mean entropy of the rays of any views, [C] float64 [nats].

        Args:
            state: the map.
            grid: whose unexplored cells count.
            camera: of the views.
            poses: of the views.
        """
        poses, scoring = jnp.asarray(poses), self.config.scoring
        ends = score_pixels(ends_of_rays, state, grid, camera, poses, scoring, state.visited)
        utility = entropy_of_views(
            ends,
            grid,
            pinhole_view(camera, poses[0], scoring).camera,
            poses,
            scoring.max_range,
            self.config.beliefs(),
            num_bins=state.num_bins,
            num_steps=math.ceil(float(scoring.max_range) / float(grid.cell_size)),
        )
        return np.array(utility, dtype=np.float64)
