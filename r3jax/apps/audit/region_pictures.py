"""Where a region is, for the eye: the picture of the capture that shows it best, and a ring."""

from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from r3jax.apps.audit.audit import Audit
from r3jax.apps.audit.colors import COLOR_OF_CAUSE
from r3jax.apps.audit.ground_plan import letter
from r3jax.apps.audit.regions import BLOCK, Region
from r3jax.apps.report import style

_TRIED = 6
"""Pictures of which the depth is looked at."""

_SLACK = 0.5
"""A region this far behind or before the depth of its pixel is not what the picture shows there
[audit units]."""

_BEST_DISTANCE = 2.0
"""From here a region is in the picture with what is around it [audit units]."""

_PER_LINE = 5


@dataclass(frozen=True)
class Finding:
    """A picture that shows a region."""

    index: int
    """Of the picture in the capture."""

    column: float
    """Of the region's middle in the thinned picture [px]."""

    row: float
    """Of the region's middle in the thinned picture [px]."""

    radius: float
    """Of the region [px]."""


def best_picture(audit: Audit, region: Region) -> Finding | None:
    """The picture with the region near its middle, at a good distance, and not hidden.

    Only depth images tell what is hidden. None: no picture has the region's middle in it.
    """
    poses = audit.survey.alignment.poses(audit.source.poses[audit.survey.chosen])
    local = np.einsum("nji,nj->ni", poses[:, :3, :3], region.center - poses[:, :3, 3])
    found: list[tuple[float, float, Finding]] = []
    for index, (x, y, z) in zip(audit.survey.chosen.tolist(), local, strict=True):
        if z < 0.1:
            continue
        camera = audit.source.camera(index)
        column = float(camera.fx) * x / z + float(camera.cx)
        row = float(camera.fy) * y / z + float(camera.cy)
        if not (0.0 <= column < camera.width and 0.0 <= row < camera.height):
            continue
        aside = np.hypot(column / camera.width - 0.5, row / camera.height - 0.5)
        penalty = float(aside + 0.3 * abs(np.log(z / _BEST_DISTANCE)))
        radius = 0.5 * BLOCK * float(camera.focal) / z
        found.append((penalty, float(z), Finding(index, column, row, radius)))
    found.sort(key=lambda entry: entry[0])
    for _, z, finding in found[:_TRIED]:
        if _shows(audit, finding, z):
            return finding
    return None


def _shows(audit: Audit, finding: Finding, z: float) -> bool:
    """False where something else is measured there."""
    if not audit.source.is_dense:
        return True
    depth = audit.source.read(finding.index)[1][int(finding.row), int(finding.column)]
    return depth == 0.0 or abs(float(depth) * audit.survey.alignment.scale - z) <= _SLACK


def region_figure(audit: Audit) -> Figure | None:
    """The worst regions in pictures of the capture; None where no picture shows any."""
    shown = [
        (number, region, finding)
        for number, region in enumerate(audit.regions)
        if (finding := best_picture(audit, region)) is not None
    ]
    if not shown or not audit.source.has_images:
        return None
    lines = -(-len(shown) // _PER_LINE)
    aspect = audit.camera.height / audit.camera.width
    figure = style.new_figure(10.0, lines * (10.0 / _PER_LINE * aspect + 0.22))
    grid = figure.subplots(lines, _PER_LINE, squeeze=False)
    for axes in grid.flat:
        style.blank(axes)
    for axes, (number, region, finding) in zip(grid.flat, shown, strict=False):
        photo, _ = audit.source.read(finding.index)
        axes.imshow(photo)
        radius = min(finding.radius, 0.45 * photo.shape[0])
        color = COLOR_OF_CAUSE[region.cause]
        for width, ring in ((3.2, "white"), (1.8, color)):
            axes.add_patch(
                Circle((finding.column, finding.row), radius, fill=False, edgecolor=ring,
                       linewidth=width)
            )  # fmt: skip
        axes.set_xlim(0, photo.shape[1])
        axes.set_ylim(photo.shape[0], 0)
        axes.set_title(
            f"{letter(number)}: {region.cause}", fontsize=9, color=color, loc="left", pad=2,
            fontweight="bold",
        )  # fmt: skip
    return figure
