"""`r3jax benchmark --photos`: choice among the photos of captures while a model trains."""

from typing import Any

from r3jax.apps.benchmark.photos.choosers import check_chooser
from r3jax.apps.benchmark.photos.pool import open_pool
from r3jax.apps.benchmark.photos.protocol import PhotoTerms
from r3jax.apps.benchmark.photos.records import load_or_compute, record_path, table_rows
from r3jax.cli.console import Console
from r3jax.cli.console import Table as ConsoleTable
from r3jax.cli.options.benchmark import BenchmarkOptions, words
from r3jax.cli.parsing import settings_for
from r3jax.evaluation.image_metrics import load_lpips
from r3jax.files import own_folder

DEFAULT_POLICIES = ("r3", "cover", "gavis", "random")


def run_photos_of(console: Console, options: BenchmarkOptions) -> int:
    """Runs the remaining captures, seeds and policies, and prints their tables.

    Returns:
        0 done, 130 interrupted (run it again to resume).

    Raises:
        ValueError, OSError, ImportError: a policy that cannot choose among photos, a capture
            without depth or with too few photos, terms that cannot work.
    """
    is_default = options.policies == BenchmarkOptions.policies
    policies = DEFAULT_POLICIES if is_default else words(options.policies)
    records: list[dict[str, Any]] = []
    try:
        own_folder(options.out, "benchmark", "give another --out")
        for name in policies:
            check_chooser(name)
        terms = PhotoTerms(**settings_for(PhotoTerms, options))
        lpips = options.training.lpips
        network = None if lpips == "none" else load_lpips(lpips)
        for path in options.pool.photos:
            with console.status(f"reading {path} ..."):
                up = options.meshes.up or "y"
                pool = open_pool(path, options.training.train_resolution, up=up)
            for seed in options.seed_numbers:
                for name in policies:
                    title = f"{pool.name}, {name}, seed {seed}"
                    with console.status(f"{title} ...") as status:
                        show = lambda what, status=status, title=title: status.update(
                            f"{title}: {what} ..."
                        )
                        record = load_or_compute(
                            options.out, pool, name, terms, seed, lpips=network, on_stage=show
                        )
                    records.append(record)
                    console.say(f"{title}: {record['metrics']['psnr']['mean']:.2f} dB")
            console.say(f"records  {record_path(options.out, pool, policies[0], 0).parent}")
    except KeyboardInterrupt:
        console.say("interrupted: run the same command again to resume")
        return 130
    for capture in dict.fromkeys(record["capture"] for record in records):
        own = [record for record in records if record["capture"] == capture]
        _print_table(capture, table_rows(own))
    return 0


def _print_table(capture: str, rows: list[dict[str, str]]) -> None:
    shown = ConsoleTable(title=capture, box=None, title_justify="left")
    for column in rows[0]:
        left = column == "chooser"
        shown.add_column(column, justify="left" if left else "right", no_wrap=True)
    for row in rows:
        shown.add_row(*row.values())
    Console().print(shown)
