"""The PSNR of views, from what the map shows in them: a distribution, calibrated on trained models.

Of a view are known its coverage C, the share of its pixels that show a voxel, and its
renderability R. Over the views of many trained models

    PSNR = a + b C + c C^2 + d R + exp(e + f C + g R) z,

z from the residuals of the calibration. The views of a place mix these distributions, and a
forecast is a statistic of the mixture: its mean, or a percentile. How far forecasts are off is
not known from the residuals (the views of a scene err together), but from scenes that were left
out of the calibration, one at a time. Calibrations are files; one comes with the package.
A goal is a statistic that a forecast must reach for the views to be enough.

On the host, NumPy, float64. Shape symbols: V views; L of their residual levels.
"""

import dataclasses
import functools
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np

from r3jax.errors import InputError
from r3jax.files import write_atomic
from r3jax.validation.errors import ForeignFileError, check_version
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import check_fields, parse_json

MEAN = "mean"
"""Name of the statistic that is not a percentile; those are `p10`, `p50`, ..."""

PERCENTILES = (5, 10, 25, 50, 75, 90)
"""Percentiles whose errors are known."""

STATISTICS = (MEAN, *(f"p{percent}" for percent in PERCENTILES))

_LEVELS = np.linspace(2.5, 97.5, 20)
"""Percentiles of the residuals that are kept."""

_PASSES = 5
"""Location and scale are fitted in turn; the coefficients stand still after three."""

_LEAST_RESIDUAL = 0.3
"""Added to a residual's size before its logarithm is taken [dB]."""


@dataclass(frozen=True)
class PsnrModel:
    """What was learned of the PSNR of a view, given its coverage and renderability."""

    location: tuple[float, ...]
    """a, b, c, d [dB]."""

    log_scale: tuple[float, ...]
    """e, f, g."""

    residuals: tuple[float, ...]
    """Values of z, equally likely, increasing."""

    def mixture(self, coverage: np.ndarray, renderability: np.ndarray) -> np.ndarray:
        """Equally likely values of the PSNR of views, [V, L] [dB].

        Args:
            coverage: of each view, [V] in [0, 1].
            renderability: of each view, [V] in [0, 1].
        """
        mean = _location_terms(coverage, renderability) @ np.asarray(self.location)
        scale = np.exp(_scale_terms(coverage, renderability) @ np.asarray(self.log_scale))
        return mean[:, None] + scale[:, None] * np.asarray(self.residuals)


def fit(coverage: np.ndarray, renderability: np.ndarray, psnr: np.ndarray) -> PsnrModel:
    """Fits the model to views of known PSNR by weighted least squares.

    Location and scale are fitted in turn.

    Args:
        coverage: of each view, [V] in [0, 1].
        renderability: of each view, [V] in [0, 1].
        psnr: of the trained models' images, [V] [dB].

    Raises:
        ValueError: fewer than 100 views, or numbers that are not finite.
    """
    if len(psnr) < 100:
        raise InputError(f"a calibration needs at least 100 views, got {len(psnr)}")
    for name, values in (("coverage", coverage), ("renderability", renderability), ("psnr", psnr)):
        if not np.isfinite(values).all():
            raise InputError(f"{name} must be finite, view {np.argmin(np.isfinite(values))} is not")
    terms, scale_terms = (f(coverage, renderability) for f in (_location_terms, _scale_terms))
    scale, location, log_scale = np.ones(len(psnr)), np.zeros(4), np.zeros(3)
    for _ in range(_PASSES):
        location = np.linalg.lstsq(terms / scale[:, None], psnr / scale, rcond=None)[0]
        size = np.log(np.abs(psnr - terms @ location) + _LEAST_RESIDUAL)
        log_scale = np.linalg.lstsq(scale_terms, size, rcond=None)[0]
        scale = np.exp(scale_terms @ log_scale)
    residuals = np.percentile((psnr - terms @ location) / scale, _LEVELS)
    return PsnrModel(*(tuple(part.tolist()) for part in (location, log_scale, residuals)))


def statistic(values: np.ndarray, name: str) -> float:
    """Computes the mean or a percentile of values, by its name: `mean`, `p10`."""
    return (
        float(np.mean(values)) if name == MEAN else float(np.percentile(values, percent_of(name)))
    )


def percent_of(name: str) -> float:
    """Parses the number in the name of a percentile.

    Raises:
        ValueError: no percentile has that name.
    """
    try:
        percent = float(name.removeprefix("p"))
    except ValueError:
        percent = -1.0
    if not (name.startswith("p") and 0.0 < percent < 100.0):
        raise InputError(f"{name!r} is no statistic of views: use mean, or p10 for a percentile")
    return percent


@dataclass(frozen=True)
class Calibration:
    """A model, and how far the forecasts of such models were off in scenes they had not seen."""

    model: PsnrModel

    errors: Mapping[str, tuple[float, ...]]
    """Size of each error [dB], increasing, by statistic."""

    source: str
    """Which runs, in a sentence."""

    def half_width(self, name: str, level: float) -> float:
        """Returns half of a statistic's interval [dB]: the quantile `level` of its errors.

        For other percentiles it is interpolated between those whose errors are known; beyond the
        last of these it is constant.
        """
        if name in self.errors:
            return float(np.quantile(self.errors[name], level))
        widths = [np.quantile(self.errors[f"p{percent}"], level) for percent in PERCENTILES]
        return float(np.interp(percent_of(name), PERCENTILES, widths))


def leave_one_out(
    coverage: np.ndarray,
    renderability: np.ndarray,
    psnr: np.ndarray,
    scenes: Sequence[str],
    models: Sequence[str],
) -> list[dict[str, tuple[float, float]]]:
    """Forecasts every model by a calibration without its scene; returns forecasts and truth.

    Args:
        coverage: of each view, [V].
        renderability: of each view, [V].
        psnr: of each view, [V] [dB].
        scenes: of each view, [V]; two or more.
        models: name of the trained model of each view, [V].

    Returns:
        For every model, in the order in which they come, forecast and truth by statistic [dB].
    """
    scene_of, model_of = np.asarray(scenes), np.asarray(models)
    if len(set(scenes)) < 2:
        raise InputError("to leave a scene out, two are needed")
    fits = {
        scene: fit(*(x[scene_of != scene] for x in (coverage, renderability, psnr)))
        for scene in dict.fromkeys(scenes)
    }
    found: list[dict[str, tuple[float, float]]] = []
    for model in dict.fromkeys(models):
        views = model_of == model
        learned = fits[str(scene_of[views][0])]
        mixture = learned.mixture(coverage[views], renderability[views])
        pairs = {s: (statistic(mixture, s), statistic(psnr[views], s)) for s in STATISTICS}
        found.append(pairs)
    return found


def errors_of(pairs: Sequence[Mapping[str, tuple[float, float]]]) -> dict[str, tuple[float, ...]]:
    """Returns the absolute errors by statistic, increasing, as `Calibration` stores them."""
    return {
        name: tuple(sorted(round(abs(pair[name][0] - pair[name][1]), 4) for pair in pairs))
        for name in STATISTICS
    }


def _location_terms(coverage: np.ndarray, renderability: np.ndarray) -> np.ndarray:
    C, R = np.asarray(coverage, dtype=np.float64), np.asarray(renderability, dtype=np.float64)
    return np.stack([np.ones_like(C), C, C * C, R], axis=1)


def _scale_terms(coverage: np.ndarray, renderability: np.ndarray) -> np.ndarray:
    C, R = np.asarray(coverage, dtype=np.float64), np.asarray(renderability, dtype=np.float64)
    return np.stack([np.ones_like(C), C, R], axis=1)


_FORMAT = 1
_MAX_BYTES = 1 << 20
_KINDS = {
    "source": str,
    "location": list[float],
    "log_scale": list[float],
    "residuals": list[float],
    "errors": dict[str, list[float]],
}


@functools.cache
def default_calibration() -> Calibration:
    """Reads the calibration that comes with the package."""
    return read_calibration(Path(str(files("r3jax.apps.forecast") / "calibration.json")))


def write_calibration(path: Path, calibration: Calibration) -> None:
    """Writes what `read_calibration` reads."""
    fields = {
        "format": _FORMAT,
        "source": calibration.source,
        **dataclasses.asdict(calibration.model),
        "errors": dict(calibration.errors),
    }
    write_atomic(path, (json.dumps(fields, indent=1) + "\n").encode())


def read_calibration(path: Path) -> Calibration:
    """Reads a calibration that `write_calibration` wrote.

    Raises:
        ValueError: the file is no calibration, or one of another version.
        OSError: it is missing, or must not be read.
    """
    try:
        return _parse(read_bytes(path, _MAX_BYTES))
    except ForeignFileError as error:
        raise InputError(
            f"{path}: {error}; `python -m experiments.forecast` writes calibrations"
        ) from None


def _parse(data: bytes) -> Calibration:
    found = parse_json(data)
    check_fields("calibration", found, {"format": int} | _KINDS)
    check_version(found["format"], _FORMAT)
    counts = {name: len(found[name]) for name in ("location", "log_scale")}
    if counts != {"location": 4, "log_scale": 3} or not found["residuals"]:
        raise ForeignFileError(
            "a calibration has 4 numbers of location, 3 of log_scale, and residuals; "
            f"got {counts['location']}, {counts['log_scale']} and {len(found['residuals'])}"
        )
    errors = {name: tuple(sorted(found["errors"].get(name, ()))) for name in STATISTICS}
    missing = [name for name, sizes in errors.items() if not sizes]
    if missing:
        raise ForeignFileError(f"the errors of {', '.join(missing)} are missing")
    location, log_scale, residuals = (tuple(found[name]) for name in list(_KINDS)[1:4])
    return Calibration(PsnrModel(location, log_scale, residuals), errors, found["source"])


_EXAMPLE = "use psnr:25 for the mean of all views, psnr:20@p10 for all but the worst tenth"


@runtime_checkable
class PsnrForecast(Protocol):
    """What a goal asks of a forecast, which takes JAX to make."""

    def value(self, name: str) -> float:
        """Returns a statistic of the PSNR [dB]."""
        ...


@dataclass(frozen=True)
class Goal:
    """A statistic of the PSNR of free-space views, and what it is to reach."""

    psnr: float
    """[dB]."""

    statistic: str = MEAN
    """`mean`, or a percentile: `p10`."""

    def reached(self, forecast: PsnrForecast) -> bool:
        """Returns True if the forecast reaches the goal."""
        return forecast.value(self.statistic) >= self.psnr

    def __str__(self) -> str:
        """As `parse_goal` reads it."""
        return f"psnr:{self.psnr!r}@{self.statistic}"


def parse_goal(text: str) -> Goal:
    """Reads `psnr:27` or `psnr:27@p10`.

    Raises:
        ValueError: anything else.
    """
    quantity, separator, rest = text.strip().partition(":")
    amount_text, _, name = rest.partition("@")
    if quantity != "psnr" or not separator:
        raise InputError(f"goal {text!r} is not understood: {_EXAMPLE}")
    try:
        amount = float(amount_text)
    except ValueError:
        raise InputError(f"goal {text!r}: {amount_text!r} is not a number; {_EXAMPLE}") from None
    if not math.isfinite(amount):
        raise InputError(f"goal {text!r}: the PSNR must be a finite number; {_EXAMPLE}")
    name = name or MEAN
    if name != MEAN:
        try:
            percent_of(name)
        except ValueError as error:
            raise InputError(f"goal {text!r}: {error}") from None
    return Goal(amount, name)
