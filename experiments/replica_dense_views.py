"""The paper's table at a budget of views: methods x SSIM, PSNR, LPIPS by scenes, and the tails.

    python -m experiments.replica_dense_views --size smoke

What is done in `--work` is not done again.
"""

import tyro

from experiments.replica_dense import make_tables
from experiments.suite import Options

if __name__ == "__main__":
    make_tables(tyro.cli(Options, description=__doc__), "replica_dense_views", "views")
