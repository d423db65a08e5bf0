"""The paper's table at a budget of seconds: methods x SSIM, PSNR, LPIPS by scenes, and the tails.

python -m experiments.replica_dense_time --size smoke
"""

from pathlib import Path

import tyro

from experiments.replica_dense import write_tables
from experiments.suite import Options, origin, run_suite

NAME = "replica_dense_time"


def main(options: Options) -> Path:
    """Runs the cells, writes the tables, and returns their folder."""
    _, records = run_suite(options, "seconds")
    folder = options.out / NAME / options.size
    write_tables(folder, NAME, records, origin(f"experiments.{NAME}", records))
    print(f"results  {folder}")
    return folder


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
