"""How visible a voxel is, for a direction, from the photos that there are (GAVIS, CVPR 2026).

    v_p(d) = T_p exp(kappa (<d, d_p> - 1))             what photo p says of direction d
    V(d)   = 1 - prod over p of (1 - v_p(d))           at least one photo says something

d_p is the direction from the voxel to photo p, and T_p is 1 if nothing hides the voxel there.

The paper keeps the sum over p of v_p in spherical harmonics. From a sum the product is not to be
had, only the bound V >= 1 - (1 - sum / |P|)^|P|, by which it decides. Here every voxel holds the
directions themselves, as bits, so the product is exact but for the width of a bin; photos in the
same bin count once. Unlike the bound, it never falls when a photo is added.

Shape symbols: W words of bins.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, UInt32

from r3jax.geometry.sphere import fibonacci_lattice


def unseen_share(
    visited: UInt32[Array, "W ..."],
    direction: Float[Array, "3 ..."],
    num_bins: int,
    kappa: Float[Array, ""],
) -> Float[Array, "..."]:
    """1 - V: the product over the visited bins of 1 - exp(kappa (<q_k, d> - 1)), in [0, 1].

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
