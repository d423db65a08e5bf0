"""What a model loses when it is trained on some frames only, by who chose them.

python -m experiments.select ... (experiments/results/select/README.md)
python -m docs.figures.select
"""

from pathlib import Path

from experiments.pages.artifacts import joint_origin, write_figure
from experiments.select import difference, read_records
from r3jax.plots import style

FOLDER = Path("experiments/results/select")
SHARES = (0.1, 0.2)


def main() -> None:
    """Draws PSNR minus that of all frames, with intervals, one panel for each share."""
    records = list(read_records(FOLDER / "records.jsonl").values())
    terms = (records[0]["iterations"], records[0]["resolution"])
    records = [r for r in records if (r["iterations"], r["resolution"]) == terms]
    figure = style.new_figure(10.0, 3.4)
    for axes, share in zip(figure.subplots(1, len(SHARES), sharex=True), SHARES, strict=True):
        at = [r for r in records if r["share"] in (share, 1.0)]
        names = {r["chooser"] for r in at} - {"all"}
        found = {name: difference(at, name, "all") for name in names}
        rows = sorted(((d, name) for name, d in found.items() if d), key=lambda row: row[0].value)
        style.dress(axes, f"{100 * share:g} % of the frames", "PSNR minus that of all frames [dB]")
        for height, (loss, name) in enumerate(rows):
            color = style.ACCENT if name == "select" else style.MUTED
            axes.plot([loss.low, loss.high], [height, height], color=color, linewidth=2)
            axes.plot([loss.value], [height], "o", color=color, markersize=7)
        axes.set_yticks(range(len(rows)), [name for _, name in rows])
        axes.axvline(0.0, color=style.MUTED, linewidth=1, linestyle="--")
    origin = joint_origin(
        "docs.figures.select", [r["machine"] for r in records], [r["commit"] for r in records]
    )
    write_figure(FOLDER / "losses.png", figure, origin)


if __name__ == "__main__":
    main()
