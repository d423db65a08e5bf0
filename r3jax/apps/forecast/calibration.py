"""Calibrations as files; the one that comes with the package among them."""

import dataclasses
import functools
import json
from importlib.resources import files
from pathlib import Path

from r3jax.apps.forecast.psnr import STATISTICS, Calibration, PsnrModel
from r3jax.files import write_atomic
from r3jax.formats.validation.errors import ForeignFileError
from r3jax.formats.validation.fields import check_fields
from r3jax.formats.validation.files import read_bytes
from r3jax.formats.validation.json_text import parse_json
from r3jax.formats.validation.versions import check_version

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
    """The calibration that comes with the package."""
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
    """A calibration that `write_calibration` wrote.

    Raises:
        ValueError: the file is no calibration, or one of another version.
        OSError: it is missing, or must not be read.
    """
    try:
        return _parse(read_bytes(path, _MAX_BYTES))
    except ForeignFileError as error:
        raise ValueError(
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
        raise ForeignFileError(f"the errors of {', '.join(missing)} are not told")
    location, log_scale, residuals = (tuple(found[name]) for name in list(_KINDS)[1:4])
    return Calibration(PsnrModel(location, log_scale, residuals), errors, found["source"])
