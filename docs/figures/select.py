"""What a model loses when it is trained on some frames only, by who chose them.

python -m experiments.select ... (experiments/results/select/README.md)
python -m docs.figures.select
"""

from pathlib import Path

from experiments.pages.artifacts import joint_origin, write_figure
from experiments.select import compared, difference, read_records
from r3jax.plots import style

FOLDER = Path("experiments/results/select")
CHOOSERS = ("select", "uniform", "farthest", "sharp-frames", "all")
"""Those that every panel has."""

HELD_OUT = ("walk-kitchen", "walk-loft", "walk-library", "walk-villa")
"""Captures that no rule was corrected on."""


def main() -> None:
    """Draws PSNR minus that of all frames, with intervals, one panel for each share and length."""
    records = list(read_records(FOLDER / "records.jsonl").values())
    own = [r for r in records if r["capture"] in HELD_OUT]
    terms = sorted({(r["iterations"], r["share"]) for r in own if r["share"] < 1.0})
    figure = style.new_figure(12.0, 2.6)
    axes = figure.subplots(1, len(terms), sharex=True, sharey=True, squeeze=False)[0]
    for part, (iterations, share) in zip(axes, terms, strict=True):
        some = [r for r in own if r["iterations"] == iterations]
        at, _ = compared(some, share, CHOOSERS)
        title = f"{100 * share:g} %, {iterations:,} iterations"
        style.dress(part, title, "PSNR minus all frames [dB]")
        for height, name in enumerate(reversed(CHOOSERS[:-1])):
            loss = difference(at, name, "all")
            assert loss is not None, (name, share, iterations)
            color = style.ACCENT if name == "select" else style.MUTED
            part.plot([loss.low, loss.high], [height, height], color=color, linewidth=2)
            part.plot([loss.value], [height], "o", color=color, markersize=7)
        part.set_yticks(range(len(CHOOSERS) - 1), reversed(CHOOSERS[:-1]))
        part.axvline(0.0, color=style.MUTED, linewidth=1, linestyle="--")
    origin = joint_origin(
        "docs.figures.select", [r["machine"] for r in records], [r["commit"] for r in records]
    )
    write_figure(FOLDER / "losses.png", figure, origin)


if __name__ == "__main__":
    main()
