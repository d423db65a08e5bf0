"""The figure of `pool_selection`: PSNR over the number of chosen views."""

from typing import Any

import numpy as np
from matplotlib.figure import Figure

from experiments.pages.policy_style import legend_below, styles_of
from r3jax.evaluation.comparison import scene_title


def pool_figure(rows: list[dict[str, Any]]) -> Figure:
    """A panel per scene, a line per policy: the mean over seeds of the mean PSNR.

    Args:
        rows: with `scene`, `policy`, `views` and `psnr` [dB].
    """
    scenes = list(dict.fromkeys(row["scene"] for row in rows))
    looks = styles_of(list(dict.fromkeys(row["policy"] for row in rows)))
    figure = Figure(figsize=(max(4.2 * len(scenes), 5.0), 3.4), layout="constrained")
    panels = figure.subplots(1, len(scenes), squeeze=False)[0]
    for axes, scene in zip(panels, scenes, strict=True):
        for policy, look in looks.items():
            own = [row for row in rows if (row["scene"], row["policy"]) == (scene, policy)]
            views = sorted({row["views"] for row in own})
            means = [np.mean([r["psnr"] for r in own if r["views"] == v]) for v in views]
            axes.plot(views, means, label=policy, **look.line())
        axes.set(
            title=scene_title(scene), xlabel="views", xticks=sorted({row["views"] for row in rows})
        )
        axes.grid(alpha=0.3)
    panels[0].set_ylabel("PSNR [dB], mean of test views")
    legend_below(figure, list(looks))
    return figure
