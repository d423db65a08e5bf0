"""Scores of an evaluated scene: one row per view, and their summary."""

import csv
import dataclasses
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy import stats

from r3jax.errors import InputError
from r3jax.files import write_atomic

POOR_PSNR = 20.0
"""Views below this count as poor [dB]."""

_RESAMPLES, _RESAMPLES_AT_A_TIME = 4000, 500


@dataclass(frozen=True)
class ViewRow:
    """The scores of one test view."""

    view: int
    """Number of the view in its data set."""

    psnr: float
    """[dB], of the render rounded to 8 bits."""

    ssim: float
    """In [-1, 1]."""

    lpips: float | None
    """0 and up, lower is better; None where it was not requested."""

    psnr_measured: float
    """PSNR over the pixels with a depth measurement [dB]: holes of the scan (windows, mirrors,
    depth 0) are left out. NaN where there is none."""

    measured: float
    """Share of the pixels with a depth measurement."""

    coverage: float
    """Mean opacity of the render: the share of the image that the scene fills."""

    renderability: float | None
    """R of the view from a map of the training views, in [0, 1]; None where there is no map."""


@dataclass(frozen=True)
class Metric:
    """A column of rows that is summarized."""

    name: str
    """Field of `ViewRow`."""

    title: str
    """Its name in tables."""

    decimals: int
    """That tables show."""

    lower_is_better: bool = False


METRICS = (
    Metric("psnr", "PSNR [dB]", 2),
    Metric("psnr_measured", "– holes left out", 2),
    Metric("ssim", "SSIM", 3),
    Metric("lpips", "LPIPS", 3, lower_is_better=True),
)


@dataclass(frozen=True)
class Summary:
    """One metric over a test set. The tail is always the bad one."""

    metric: Metric

    views: int
    """Views that have a value."""

    mean: float
    """Mean of the values per view."""

    interval: tuple[float, float]
    """95 % bootstrap interval of the mean, over views."""

    median: float

    percentile_5: float
    """The 5th percentile (LPIPS: the 95th), so that 5 % of the views are worse."""

    worst: float

    worst_view: int
    """Number of the view with the worst value."""

    poor_share: float | None
    """Share of the views under 20 dB; None for metrics that are no PSNR."""


def summarize(rows: Sequence[ViewRow], *, seed: int = 0) -> tuple[Summary, ...]:
    """Computes the mean, bootstrap interval, median and tail of every metric that has values.

    The interval is the percentile bootstrap of the mean (Efron 1979): 4000 test sets of the same
    size are drawn from the views, with replacement. It covers the choice of the test views, but not
    the seeds of training.

    Args:
        rows: one per view; NaN and None are left out.
        seed: of the bootstrap.

    Raises:
        ValueError: there are no rows.
    """
    if not rows:
        raise InputError("there is no view to summarize")
    summaries: list[Summary] = []
    for metric in METRICS:
        known = [(row.view, value) for row in rows if _has(value := getattr(row, metric.name))]
        if known:
            views, values = (np.array(column) for column in zip(*known, strict=True))
            summaries.append(_summary(metric, views, values.astype(np.float64), seed))
    return tuple(summaries)


def _has(value: float | None) -> bool:
    return value is not None and not math.isnan(value)


def _summary(metric: Metric, views: np.ndarray, values: np.ndarray, seed: int) -> Summary:
    worst = int(np.argmax(values) if metric.lower_is_better else np.argmin(values))
    is_psnr = metric.name.startswith("psnr")
    return Summary(
        metric=metric,
        views=len(values),
        mean=float(values.mean()),
        interval=bootstrap_interval(values, seed=seed),
        median=float(np.median(values)),
        percentile_5=float(np.percentile(values, 95 if metric.lower_is_better else 5)),
        worst=float(values[worst]),
        worst_view=int(views[worst]),
        poor_share=float(np.mean(values < POOR_PSNR)) if is_psnr else None,
    )


def bootstrap_interval(values: np.ndarray, *, seed: int = 0) -> tuple[float, float]:
    """Computes the 95 % interval of the mean by resampling the values, [n], n >= 1."""
    if len(values) == 1:
        return float(values[0]), float(values[0])
    found = stats.bootstrap(
        (values,),
        np.mean,
        n_resamples=_RESAMPLES,
        batch=_RESAMPLES_AT_A_TIME,
        method="percentile",
        rng=np.random.default_rng(seed),
    )
    low, high = found.confidence_interval
    return float(low), float(high)


def worst_rows(rows: Sequence[ViewRow], count: int) -> list[ViewRow]:
    """Returns the rows with the lowest PSNR, worst first."""
    return sorted(rows, key=lambda row: row.psnr)[:count]


def write_rows(path: Path, rows: Sequence[ViewRow]) -> None:
    """Writes one line per view: CSV, or Parquet if the file's name ends in `.parquet`.

    CSV holds every digit (reading it gives the same numbers), an empty field where there is no
    value.

    Raises:
        ValueError: another suffix.
        ImportError: Parquet without the package `pyarrow`.
        OSError: the disk is full, not writable, ...
    """
    if path.suffix == ".csv":
        write_atomic(path, _to_csv(rows).encode())
    elif path.suffix == ".parquet":
        write_atomic(path, _to_parquet(rows))
    else:
        raise InputError(f"{path}: rows are written as .csv or .parquet, not {path.suffix!r}")


def _columns() -> list[str]:
    return [field.name for field in dataclasses.fields(ViewRow)]


def _to_csv(rows: Sequence[ViewRow]) -> str:
    text = io.StringIO()
    table = csv.DictWriter(text, _columns(), lineterminator="\n")
    table.writeheader()
    table.writerows(dataclasses.asdict(row) for row in rows)
    return text.getvalue()


def _to_parquet(rows: Sequence[ViewRow]) -> bytes:
    try:
        import pyarrow  # pyright: ignore[reportMissingImports]
        import pyarrow.parquet  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise ImportError(
            "Parquet needs the package pyarrow: pip install pyarrow (or write .csv)"
        ) from error
    sink = pyarrow.BufferOutputStream()
    columns = {name: [getattr(row, name) for row in rows] for name in _columns()}
    pyarrow.parquet.write_table(pyarrow.table(columns), sink)
    return sink.getvalue().to_pybytes()
