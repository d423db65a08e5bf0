"""Reads the command line and turns errors into messages and exit codes."""

import os
import sys
from collections.abc import Sequence
from pathlib import Path

import tyro

from r3jax.cli.errors import UserError
from r3jax.cli.options import (
    Audit,
    Benchmark,
    Demo,
    Evaluate,
    Explore,
    Export,
    Forecast,
    Info,
    Merge,
    Policies,
    Replay,
    Team,
    Train,
    View,
)

_COMMANDS = {
    "demo": Demo,
    "explore": Explore,
    "team": Team,
    "train": Train,
    "evaluate": Evaluate,
    "benchmark": Benchmark,
    "replay": Replay,
    "merge": Merge,
    "export": Export,
    "forecast": Forecast,
    "audit": Audit,
    "view": View,
    "policies": Policies,
    "info": Info,
}

INTERRUPTED = 130
USER_ERROR = 2
"""Exit code where the user can mend it: an unknown name, a folder that exists, a broken file."""

NO_READER = 141
"""Exit code where whoever read the output has gone (`r3jax info | head`), as shells have it."""


def main(args: Sequence[str] | None = None) -> int:
    """Runs one command.

    Args:
        args: the words after `r3jax`; None: those of this process.

    Returns:
        The exit code: 0 done, 1 stopped by the disk, a cell failed or a replay differed, 2 wrong
        input, 130 interrupted, 141 nobody reads the output any more.
    """
    try:
        return _main(args)
    except BrokenPipeError:
        # Python would fail once more when it flushes at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NO_READER


def _main(args: Sequence[str] | None) -> int:
    command = tyro.extras.subcommand_cli_from_dict(
        _COMMANDS,
        prog="r3jax",
        description="Where to look next for 3D Gaussian splatting: explores a scene with an RGB-D "
        "camera, chooses every view by closed-form renderability, and leaves a data set.",
        args=args,
        config=(tyro.conf.FlagCreatePairsOff,),
    )
    _keep_compilations()
    try:
        return _run(command)
    except UserError as error:
        print(f"r3jax: {error}", file=sys.stderr)
        return USER_ERROR
    except KeyboardInterrupt:  # what a command has not caught itself
        print("r3jax: interrupted; what was recorded before is complete", file=sys.stderr)
        return INTERRUPTED


def _run(
    command: Demo
    | Explore
    | Team
    | Train
    | Evaluate
    | Benchmark
    | Replay
    | Merge
    | Export
    | Forecast
    | Audit
    | View
    | Policies
    | Info,
) -> int:
    """Imports what the command needs and nothing else, so that --help does not wait for JAX."""
    if isinstance(command, Demo):
        from r3jax.cli.demo import run_demo

        return run_demo(command)
    if isinstance(command, Explore):
        from r3jax.cli.explore import run_explore

        return run_explore(command)
    if isinstance(command, Team):
        from r3jax.cli.team import run_team

        return run_team(command)
    if isinstance(command, Train):
        from r3jax.cli.train import run_train

        return run_train(command)
    if isinstance(command, Evaluate):
        from r3jax.cli.evaluate import run_evaluate

        return run_evaluate(command)
    if isinstance(command, Benchmark):
        from r3jax.cli.benchmark import run_benchmark

        return run_benchmark(command)
    if isinstance(command, Replay):
        from r3jax.cli.replay import run_replay

        return run_replay(command)
    if isinstance(command, Merge):
        from r3jax.cli.merge import run_merge

        return run_merge(command)
    if isinstance(command, Export):
        from r3jax.cli.export import run_export

        return run_export(command)
    if isinstance(command, Forecast):
        from r3jax.cli.forecast import run_forecast

        return run_forecast(command)
    if isinstance(command, Audit):
        from r3jax.cli.audit import run_audit

        return run_audit(command)
    if isinstance(command, View):
        from r3jax.cli.view import run_view

        return run_view(command)
    if isinstance(command, Policies):
        from r3jax.cli.policies import run_policies

        return run_policies(command)
    from r3jax.cli.info import run_info

    return run_info(command)


def _keep_compilations() -> None:
    """Lets the second start find what the first one compiled, unless JAX is told otherwise."""
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(base / "r3jax" / "jax")
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.2")
