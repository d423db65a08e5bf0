"""The pictures of the method page: the three terms as curves, and R over all directions of a voxel.

    python -m docs.figures.terms docs/images

Shape symbols: D directions.
"""

from pathlib import Path

import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import tyro
from matplotlib.figure import Figure

import r3jax

_INK = ("#0f766e", "#d97706", "#7c3aed", "#6b7280")
_TITLES = {"bias": "bias", "noise": "noise", "resolution": "resolution", "value": "R"}


def main(folder: tyro.conf.Positional[Path]) -> None:
    """Writes both pictures into a folder."""
    plt.rcParams.update({"font.size": 10, "axes.spines.top": False, "axes.spines.right": False})
    for name, figure in (("terms", curves()), ("directions", over_directions())):
        figure.savefig(folder / f"{name}.png", dpi=130)


def curves() -> Figure:
    """Returns each term against what it depends on."""
    figure, (bias, noise, resolution) = plt.subplots(1, 3, figsize=(11, 3.2), layout="constrained")
    angle = np.linspace(0.0, 90.0, 200)
    cosine = np.cos(np.deg2rad(angle))
    for kappa, color in zip((1, 2), _INK, strict=False):
        between = "between" if kappa == 1 else "outside"
        label = f"κ = {kappa}: {between} the seen directions"
        bias.plot(angle, cosine**kappa, color=color, label=label)
    bias.set(
        xlabel="angle to the nearest seen direction [°]", title=r"bias  $b = (\cos\theta)^\kappa$"
    )
    for delta, color in zip((1.0, 0.9, 0.7, 0.4), _INK, strict=True):
        noise.plot(angle, delta ** (1.0 - cosine), color=color, label=f"δ = {delta}")
    noise.set(
        xlabel="angle to the nearest seen direction [°]",
        title=r"noise  $\varepsilon = \delta^{\kappa (1 - b)}$, $\kappa = 1$",
    )
    ratio = np.linspace(1.0, 8.0, 200)
    for b, color in zip((1.0, 0.9, 0.5, 0.0), _INK, strict=True):
        resolution.plot(ratio, ratio ** (b - 1.0), color=color, label=f"b = {b}")
    resolution.set(
        xlabel="times nearer than the nearest view so far",
        title=r"resolution  $\gamma = (\rho_{max} / \rho)^{1 - \delta b}$, $\delta = 1$",
    )
    for ax in (bias, noise, resolution):
        ax.set_ylim(0.0, 1.03)
        ax.legend(fontsize=8, frameon=False)
        ax.grid(color="0.92")
    return figure


def over_directions() -> Figure:
    """The terms of one voxel that three views saw from 2 m, asked from 1 m in every direction."""
    seen = np.array([[1.0, -0.5, 0.25], [1.0, 0.1, 0.5], [0.8, 0.7, 0.1]])
    seen /= np.linalg.norm(seen, axis=1, keepdims=True)
    m, target = r3jax.empty_map(capacity=1 << 10), np.full(3, 0.025, np.float32)
    for direction, gray in zip(seen, (0.45, 0.6, 0.5), strict=True):
        color = np.full((1, 3), gray, np.float32)
        sensor = (target + 2.0 * direction).astype(np.float32)
        m = r3jax.integrate_points(m, target[None], color, sensor, focal=400.0)
    azimuth, elevation = np.meshgrid(np.linspace(-180, 180, 181), np.linspace(-90, 90, 91))
    a, e = np.deg2rad(azimuth), np.deg2rad(elevation)
    direction = np.stack([np.cos(e) * np.cos(a), np.cos(e) * np.sin(a), np.sin(e)], axis=-1)
    row = int(r3jax.lookup(m, target))
    term_of = lambda position: jax.tree.map(
        lambda term: term[row], r3jax.voxel_renderability(m, position, focal=400.0)
    )
    positions = jnp.asarray(target + direction.reshape(-1, 3), jnp.float32)  # [D, 3]
    terms = jax.lax.map(term_of, positions, batch_size=512)

    figure, axes = plt.subplots(
        1, 4, figsize=(13, 2.5), layout="constrained", subplot_kw={"projection": "mollweide"}
    )
    for ax, (name, title) in zip(axes, _TITLES.items(), strict=True):
        values = np.asarray(getattr(terms, name)).reshape(a.shape)
        shown = ax.pcolormesh(a, e, values, vmin=0, vmax=1, cmap="RdYlGn", rasterized=True)
        where = np.arctan2(seen[:, 1], seen[:, 0]), np.arcsin(seen[:, 2])
        ax.plot(*where, "k^", markersize=4)
        ax.set(title=title, xticks=[], yticks=[])
    figure.colorbar(shown, ax=axes, shrink=0.8)
    return figure


if __name__ == "__main__":
    tyro.cli(main)
