"""`r3jax policies`: who can choose views, and where each rule comes from."""

from r3jax.cli.console import Console, Table, Text
from r3jax.cli.options.runs import PoliciesOptions
from r3jax.planning.registry import describe, policy_names, source_of


def run_policies(options: PoliciesOptions) -> int:
    """Prints every policy with a sentence and its source."""
    del options
    # Lines break between words, at 100 columns at most; into a file or a pipe they fit in 80.
    console = Console()
    table = Table(show_header=False, box=None, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(style="cyan", no_wrap=True)
    table.add_column(overflow="fold")
    for name in policy_names():
        table.add_row(name, Text(describe(name)).append(f"\n{source_of(name)}", style="dim"))
    console.print(table, width=min(console.width, 100))
    Console(stderr=True).next("explore", "--scene", "flat", "--policy", policy_names()[0])
    return 0
