"""Quality along the budget: curves against views and seconds, spreads of views, areas.

    python -m experiments.quality_over_budget --size smoke

The cells are those of `experiments.replica_dense_views`.
"""

from pathlib import Path

import tyro

from experiments.pages.artifacts import Origin, write_figure, write_markdown
from experiments.pages.comparison_tables import area_table
from experiments.pages.distribution_figures import ridge_figure
from experiments.suite import Options, Records, origin, run_suite
from r3jax.apps.benchmark.figures import curve_figure
from r3jax.apps.benchmark.table_formats import to_csv, to_markdown
from r3jax.files import write_atomic

NAME = "quality_over_budget"

CURVES = {
    "psnr_over_views": ("views", "psnr"),
    "psnr_over_seconds": ("seconds", "psnr"),
    "views_over_seconds": ("seconds", "views"),
}
"""Quantities on the two axes, by the picture's name."""


def main(options: Options) -> Path:
    """Runs the cells, draws, and returns the folder of the results."""
    _, records = run_suite(options, "views")
    folder = options.out / NAME / options.size
    write_page(folder, records, origin(f"experiments.{NAME}", records))
    print(f"results  {folder}")
    return folder


def write_page(folder: Path, records: Records, source: Origin) -> None:
    """Writes the pictures, the table of areas, and the page that shows them."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, (x, y) in CURVES.items():
        write_figure(folder / f"{name}.png", curve_figure(records, x, y), source)
    write_figure(folder / "psnr_by_view.png", ridge_figure(records), source)
    areas = area_table(records)
    comment = "".join(f"# {line}\n" for line in source.lines())
    write_atomic(folder / "areas.csv", (comment + to_csv(areas)).encode())
    pictures = [f"![{name}]({name}.png)" for name in (*CURVES, "psnr_by_view")]
    write_markdown(folder / f"{NAME}.md", [*pictures, to_markdown(areas)], source)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
