"""Settings of the online Gaussian map, one set per rival."""

from dataclasses import dataclass


@dataclass(frozen=True)
class MapSettings:
    """How Gaussians are born, trained and pruned; the defaults are those of Active-GS."""

    flat: bool = True
    """Discs along the measured surface; False: balls."""

    image_width: int = 128
    """Longer side of the images that the map is trained on [px]; never larger than recorded."""

    spacing: float = 0.02
    """One new Gaussian at most per voxel of this edge and key frame [m]."""

    size: float = 0.01
    """Standard deviation of a new Gaussian [m]."""

    max_size: float = 0.05
    """Larger ones are cut down to this [m]."""

    birth_color: float = 0.25
    """Squared color error, mean of the channels, above which a pixel gets a new Gaussian."""

    birth_opacity: float = 0.5
    """Rendered opacity below which it does."""

    birth_depth: float = 0.05
    """It does where the measured surface is nearer than the rendered one by this share."""

    steps: int = 10
    """Steps of Adam per key frame; Adam begins anew at each."""

    recent: int = 3
    """Latest key frames in every batch."""

    older: int = 5
    """Earlier ones in it, drawn at random."""

    by_error: bool = True
    """Draws them in proportion to the last error of each; False: all alike."""

    color_weight: float = 1.0
    """Weight of the mean absolute error of colors."""

    depth_weight: float = 0.8
    """Weight of that of depths [1/m]."""

    isotropy: float = 0.0
    """Weight of the mean difference between a Gaussian's sizes and their mean [1/m], beside the sum
    of the losses of a batch."""

    rate_means: float = 5e-4
    """Learning rate of the centers [m]."""

    rate_quats: float = 5e-4
    """Learning rate of the rotations."""

    rate_opacities: float = 0.01
    """Learning rate of the opacity logits."""

    rate_log_scales: float = 0.01
    """Learning rate of the log scales."""

    rate_color: float = 1e-4
    """Learning rate of the colors."""

    prune_every: int = 5
    """Key frames between two prunings."""

    prune_opacity: float = 0.1
    """What is fainter than this is pruned, and what no key frame sees any more."""


DISCS = MapSettings()
"""Active-GS: mapper/incremental.yaml."""

BALLS = MapSettings(flat=False)
"""The same map of balls, for FisherRF's rule for photos, which brings no online map of its own."""

GAUSS_MI = MapSettings(
    flat=False, steps=20, recent=8, older=2, by_error=False, color_weight=0.9, depth_weight=0.1,
    isotropy=10.0,
)  # fmt: skip
"""GauSS-MI: 20 steps per key frame over a window of 8 and 2 older ones, with its loss."""
