"""The options of every command. Light on purpose: `--help` must not wait for JAX."""

from r3jax.cli.options.audit import AuditOptions
from r3jax.cli.options.benchmark import BenchmarkOptions
from r3jax.cli.options.explore import DemoOptions, ExploreOptions
from r3jax.cli.options.runs import (
    ExportOptions,
    ForecastOptions,
    InfoOptions,
    MergeOptions,
    PoliciesOptions,
    ReplayOptions,
    ViewOptions,
)
from r3jax.cli.options.splats import EvaluateOptions, TrainOptions
from r3jax.cli.options.team import TeamOptions

__all__ = [
    "AuditOptions",
    "BenchmarkOptions",
    "DemoOptions",
    "EvaluateOptions",
    "ExploreOptions",
    "ExportOptions",
    "ForecastOptions",
    "InfoOptions",
    "MergeOptions",
    "PoliciesOptions",
    "ReplayOptions",
    "TeamOptions",
    "TrainOptions",
    "ViewOptions",
]
