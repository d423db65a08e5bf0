"""Figures of what predicts the error of single views: points, distributions, terms, models.

Better is up and to the right in all of them, so that a right prediction always rises.
"""

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from experiments.error_analysis import (
    COVER,
    COVERAGE,
    ERRORS,
    SCORE,
    SEEN_ERROR,
    SceneModels,
    snapshots_of_models,
)
from experiments.error_terms import KAPPAS, PRODUCTS, column
from experiments.pages.policy_style import OKABE_ITO, legend_below
from r3jax.evaluation.statistics import Estimate
from r3jax.plots import style

TITLES = {SCORE: "renderability R", COVERAGE: "coverage", COVER: "COVER"}
"""Predictions as axes call them; terms keep their names."""

_BINS = 8
"""Groups of equal size along the prediction whose medians are drawn."""


def told(found: Estimate, decimals: int = 2) -> str:
    """Returns an estimate with its interval, as tables and titles have it."""
    if np.isnan(found.value):
        return "–"
    if np.isnan(found.low):
        return f"{found.value:.{decimals}f}"
    return f"{found.value:.{decimals}f} [{found.low:.{decimals}f}, {found.high:.{decimals}f}]"


def budget_name(snapshot: str) -> str:
    """Returns `views:30` as people read it."""
    kind, _, amount = snapshot.partition(":")
    return f"{amount} {kind}"


def budget_colors(models: SceneModels) -> dict[str, str]:
    """Returns a color for each budget, the same in every figure of a scene."""
    return dict(zip(snapshots_of_models(models), OKABE_ITO, strict=False))


def scatter_figure(models: SceneModels) -> Figure:
    """Returns a point per view and model.

    R above, coverage below, against each error of whole images.

    Lines join the medians of eighths of each budget's points.
    """
    errors = [name for name in ("psnr", "ssim", "lpips") if name in models.columns]
    figure = style.new_figure(3.6 * len(errors), 6.6)
    panels = figure.subplots(2, len(errors), squeeze=False, sharex=True, sharey="col")
    for line, predictor in zip(panels, (SCORE, COVERAGE), strict=True):
        for axes, error in zip(line, errors, strict=True):
            found = models.estimate("spearman", predictor, error)
            title = f"Spearman {told(found)}"
            style.dress(axes, x=TITLES[predictor], y=ERRORS[error])
            axes.set_title(title, fontsize=9, color=style.INK, loc="left")
            _draw_points(axes, models, predictor, error)
    for axes in panels[0]:
        axes.tick_params(labelbottom=True)
    if "lpips" in errors:  # after the points: limits are known
        axes = panels[0, errors.index("lpips")]
        axes.invert_yaxis()
        for axes in panels[:, errors.index("lpips")]:
            axes.set_ylabel("LPIPS, turned: better is up", fontsize=9, color=style.MUTED)
    names = [budget_name(snapshot) for snapshot in budget_colors(models)]
    figure.suptitle(
        f"{models.scene}: {len(models.methods)} models x {models.columns[SCORE].shape[1]} test "
        "views; mean over models of Spearman within a model",
        fontsize=11, color=style.INK, fontweight="bold",
    )  # fmt: skip
    legend_below(figure, names)
    return figure


def _draw_points(axes: Axes, models: SceneModels, predictor: str, error: str) -> None:
    x, y = models.columns[predictor], models.columns[error]
    alpha = float(np.clip(400.0 / x.size, 0.06, 0.5))
    for snapshot, color in budget_colors(models).items():
        mine = np.array([name == snapshot for name in models.snapshots])
        a, b = x[mine].ravel(), y[mine].ravel()
        known = ~np.isnan(a + b)
        a, b = a[known], b[known]
        axes.scatter(a, b, s=9, color=color, alpha=alpha, linewidths=0, rasterized=True)
        groups = [part for part in np.array_split(np.argsort(a, kind="stable"), _BINS) if len(part)]
        middle = np.array([[np.median(a[part]), np.median(b[part])] for part in groups]).T
        axes.plot(*middle, color="white", linewidth=4.0, zorder=4)
        axes.plot(
            *middle, color=color, linewidth=2.0, marker="o", markersize=4, zorder=5,
            label=budget_name(snapshot),
        )  # fmt: skip


def distribution_figure(scenes: Sequence[SceneModels]) -> Figure:
    """Returns how R, coverage and PSNR spread over views and models.

    A line per scene, a color per budget.

    Histograms, as a smoothed density would reach beyond 0 and 1; a line marks each median.
    """
    shown = {SCORE: TITLES[SCORE], COVERAGE: TITLES[COVERAGE], "psnr": ERRORS["psnr"]}
    figure = style.new_figure(10.8, 2.4 * len(scenes) + 0.3)
    panels = figure.subplots(len(scenes), len(shown), squeeze=False, sharex="col")
    for line, models in zip(panels, scenes, strict=True):
        for axes, (name, title) in zip(line, shown.items(), strict=True):
            is_first = axes is line[0]
            style.dress(axes, models.scene if is_first else "", title)
            if is_first:
                axes.set_ylabel("views [%]", fontsize=9, color=style.MUTED)
            everywhere = np.concatenate([other.columns[name].ravel() for other in scenes])
            top = 1.0 if name in TITLES else float(np.nanmax(everywhere))
            edges = np.linspace(min(0.0, float(np.nanmin(everywhere))), top, _BARS + 1)
            _draw_histograms(axes, models, name, edges)
            axes.tick_params(labelbottom=True)
    legend_below(figure, [budget_name(snapshot) for snapshot in budget_colors(scenes[0])])
    return figure


_BARS = 20
"""Bars of a histogram."""


def _draw_histograms(axes: Axes, models: SceneModels, name: str, edges: np.ndarray) -> None:
    for snapshot, color in budget_colors(models).items():
        mine = np.array([other == snapshot for other in models.snapshots])
        values = models.columns[name][mine].ravel()
        values = values[~np.isnan(values)]
        share = 100.0 * np.histogram(values, edges)[0] / len(values)
        if len(set(models.snapshots)) <= 2:  # more of them would only make mud
            axes.stairs(share, edges, color=color, alpha=0.2, fill=True)
        axes.stairs(share, edges, color=color, linewidth=1.6, label=budget_name(snapshot))
        axes.axvline(float(np.median(values)), color=color, linewidth=1.4, linestyle="--")


def term_figure(models: SceneModels) -> Figure:
    """Returns how well each term, product and rival predicts.

    Dots with intervals, in three questions.
    """
    names = (COVERAGE, COVER, *PRODUCTS)
    questions = {
        "PSNR of all pixels": ("spearman", "psnr", ""),
        "the same, given coverage": ("partial", "psnr", COVERAGE),
        "PSNR of seen pixels, by seen voxels": ("spearman", SEEN_ERROR, ""),
    }
    figure = style.new_figure(10.8, 0.36 * len(names) + 1.4)
    panels = figure.subplots(1, len(questions), sharey=True, sharex=True)
    for axes, (title, (statistic, error, given)) in zip(panels, questions.items(), strict=True):
        style.dress(axes, x="Spearman, mean over models")
        axes.set_title(title, fontsize=10, color=style.INK, loc="left", fontweight="bold")
        axes.axvline(0.0, color=style.MUTED, linewidth=0.9, linestyle="--", zorder=1)
        for place, name in enumerate(reversed(names)):
            if name in PRODUCTS:
                for k, kappa in enumerate(KAPPAS):
                    found = models.estimate(statistic, column(name, kappa), error, given=given)
                    _draw_estimate(axes, found, place + 0.16 * (1 - 2 * k), _LOOKS[kappa])
            elif not (name == COVERAGE and given):
                found = models.estimate(statistic, name, error, given=given)
                _draw_estimate(axes, found, place, _LOOKS[""])
    panels[0].set_yticks(range(len(names)), [_term_title(name) for name in reversed(names)])
    panels[0].set_ylim(-0.6, len(names) - 0.4)
    for label in panels[0].get_yticklabels():
        label.set_color(style.INK)
    figure.suptitle(models.scene, fontsize=11, color=style.INK, fontweight="bold")
    legend_below(figure, [look[2] for look in _LOOKS.values()])
    return figure


_LOOKS = {
    "box": (OKABE_ITO[0], "o", "kappa by the box test"),
    "one": (OKABE_ITO[1], "s", "kappa = 1"),
    "": (style.INK, "D", "no kappa"),
}
"""Color, marker and name of each form of kappa."""


def _term_title(name: str) -> str:
    return {SCORE: "bias x noise x resolution = R"}.get(name, TITLES.get(name, name))


def _draw_estimate(axes: Axes, found: Estimate, place: float, look: tuple[str, str, str]) -> None:
    color, marker, label = look
    if np.isnan(found.value):
        return
    if not np.isnan(found.low):
        axes.hlines(place, found.low, found.high, color=color, linewidth=1.6, zorder=3)
    axes.plot(
        found.value, place, marker, color=color, markersize=5, zorder=4, label=label,
        linestyle="none",
    )  # fmt: skip


def model_figure(scenes: Sequence[SceneModels]) -> Figure:
    """Returns a point per model.

    How good predictions are where little was seen, and between models.

    Left: Spearman within the model, against its coverage. Right: does its mean R tell its PSNR?
    """
    figure = style.new_figure(8.4, 3.1 * len(scenes))
    panels = figure.subplots(len(scenes), 2, squeeze=False)
    for (left, right), models in zip(panels, scenes, strict=True):
        style.dress(left, models.scene, "mean coverage of the model", "Spearman with PSNR")
        coverage = models.columns[COVERAGE].mean(axis=1)
        for predictor, color, marker in ((COVERAGE, style.INK, "D"), (SCORE, OKABE_ITO[5], "o")):
            left.scatter(
                coverage, models.sample("spearman", predictor, "psnr")[:, 0], s=22, color=color,
                marker=marker, alpha=0.75, linewidths=0, label=f"by {TITLES[predictor]}",
            )  # fmt: skip
        left.axhline(0.0, color=style.MUTED, linewidth=0.9, linestyle="--", zorder=1)
        style.dress(right, "", "mean R of the model", "mean PSNR of the model [dB]")
        for snapshot, color in budget_colors(models).items():
            mine = np.array([name == snapshot for name in models.snapshots])
            right.scatter(
                models.columns[SCORE].mean(axis=1)[mine],
                np.nanmean(models.columns["psnr"], axis=1)[mine],
                s=22, color=color, alpha=0.75, linewidths=0, label=budget_name(snapshot),
            )  # fmt: skip
    labels = [f"by {TITLES[name]}" for name in (COVERAGE, SCORE)]
    legend_below(figure, labels + [budget_name(name) for name in budget_colors(scenes[0])])
    return figure
