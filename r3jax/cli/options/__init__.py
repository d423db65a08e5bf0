"""The options of every command. Light on purpose: `--help` must not wait for JAX."""

from r3jax.cli.options.audit import Audit
from r3jax.cli.options.benchmark import Benchmark
from r3jax.cli.options.explore import Demo, Explore
from r3jax.cli.options.runs import Export, Forecast, Info, Merge, Policies, Replay, View
from r3jax.cli.options.splats import Evaluate, Train
from r3jax.cli.options.team import Team

__all__ = [
    "Audit",
    "Benchmark",
    "Demo",
    "Evaluate",
    "Explore",
    "Export",
    "Forecast",
    "Info",
    "Merge",
    "Policies",
    "Replay",
    "Team",
    "Train",
    "View",
]
