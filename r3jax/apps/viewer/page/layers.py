"""What of the place can be drawn: the entries of the menu, and what their colors mean."""

from dataclasses import dataclass

from r3jax.apps.viewer.blocks import CAUSE

PLACES = ("places in free space", "the dragged camera")
"""From where the map's colors are seen."""


@dataclass(frozen=True)
class Layer:
    """One entry of the menu."""

    name: str
    """Name in the menu."""

    surface: str
    """What is drawn: voxels, splats, points or mesh."""

    quantity: str
    """What it is colored by: one of `blocks.QUANTITIES`, or `CAUSE`."""

    title: str
    """What the legend says of it."""

    @property
    def has_score(self) -> bool:
        """Whether the colors are those of R or of a term, which depend on a place."""
        return self.quantity not in ("color", CAUSE)

    @property
    def is_of_one_view(self) -> bool:
        """Whether it shows what was known after a view; all else shows the whole run."""
        return self.surface == "voxels"


LAYERS = (
    Layer("splats", "splats", "color", "Splats trained on this run"),
    Layer("colors", "voxels", "color", "Map in its own colors"),
    Layer("renderability R", "voxels", "renderability", "Renderability R of the map"),
    Layer("bias: viewing angle", "voxels", "bias", "Bias: seen from the right angle?"),
    Layer("noise: color agreement", "voxels", "noise", "Noise: do the views agree on the color?"),
    Layer("resolution: closeness", "voxels", "resolution", "Resolution: seen from close enough?"),
    Layer("why this view was chosen", "voxels", CAUSE, "Why this view was chosen"),
    Layer("measured points", "points", "color", "Measured points of all views"),
    Layer("scene mesh", "mesh", "color", "The scene's own mesh"),
)
"""The menu, in order."""


def menu_of(surfaces: tuple[str, ...], *, with_causes: bool) -> tuple[Layer, ...]:
    """The entries of a menu, the first to be opened on: splats if there are any, else colors.

    Args:
        surfaces: what there is to draw.
        with_causes: whether it can be known why a view was chosen.
    """
    return tuple(
        layer
        for layer in LAYERS
        if layer.surface in surfaces and (with_causes or layer.quantity != CAUSE)
    )
