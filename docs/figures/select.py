"""What a model loses when it is trained on some frames only, by who chose them.

python -m experiments.select ... (experiments/results/select/README.md)
python -m docs.figures.select
"""

from pathlib import Path

from experiments.pages.artifacts import joint_origin, write_figure
from experiments.select import compared, difference, read_records
from r3jax.plots import style

FOLDER = Path("experiments/results/select")
CHOOSERS = ("select", "uniform", "farthest", "sharp-frames", "random", "all")
"""Those that every capture has."""


def main() -> None:
    """Draws PSNR minus that of all frames, with intervals, one panel for each share."""
    records = list(read_records(FOLDER / "records.jsonl").values())
    shares = sorted({r["share"] for r in records} - {1.0})
    panels = [(share, *compared(records, share, CHOOSERS)) for share in shares]
    figure = style.new_figure(10.0, 3.0)
    axes = figure.subplots(1, len(panels), sharex=True, squeeze=False)[0]
    for part, (share, at, captures) in zip(axes, panels, strict=True):
        found = [(difference(at, name, "all"), name) for name in CHOOSERS[:-1]]
        rows = sorted(((d, n) for d, n in found if d is not None), key=lambda row: row[0].value)
        title = f"{100 * share:g} % of the frames, {len(captures)} captures"
        style.dress(part, title, "PSNR minus that of all frames [dB]")
        for height, (loss, name) in enumerate(rows):
            color = style.ACCENT if name == "select" else style.MUTED
            part.plot([loss.low, loss.high], [height, height], color=color, linewidth=2)
            part.plot([loss.value], [height], "o", color=color, markersize=7)
        part.set_yticks(range(len(rows)), [name for _, name in rows])
        part.axvline(0.0, color=style.MUTED, linewidth=1, linestyle="--")
    origin = joint_origin(
        "docs.figures.select", [r["machine"] for r in records], [r["commit"] for r in records]
    )
    write_figure(FOLDER / "losses.png", figure, origin)


if __name__ == "__main__":
    main()
