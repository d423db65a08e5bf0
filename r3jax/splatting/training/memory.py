"""How much memory a training needs, and how much is free: said before it starts.

The coefficients are those of the compiled training step, rounded up;
tests/splatting/training/test_memory.py holds the estimate against XLA's own account.
"""

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax

from r3jax.kernels.constants import TILE
from r3jax.splatting.errors import TooLargeError
from r3jax.splatting.training.config import TrainConfig
from r3jax.splatting.views import Views

_GEOMETRY_FLOATS = 3 + 4 + 3 + 1
"""Mean, rotation, scales and opacity of a Gaussian."""

_COPIES = 8
"""Copies of every parameter: itself, its gradient and Adam's two moments, each before and after."""

_BYTES_PER_ROW = 200
"""Projection, its gradient and the density statistics of a Gaussian."""

_BYTES_PER_INTERSECTION = 64
"""Keys, order, and the gradient that waits for its reduction."""

_BYTES_PER_PIXEL = 400
"""The rendering, the loss and their gradients."""

_ARRAYS_PER_BATCH = 12
"""Arrays of a number for each pixel and Gaussian of a batch that the gradient of `xla` holds."""

_RESERVE = 0.05
"""Share of the free memory that is left alone, for the compiler (some 300 MB) among others."""


def training_bytes(width: int, height: int, config: TrainConfig, rows: int | None = None) -> int:
    """Estimates the memory of training besides the images of the views [bytes].

    Args:
        width: of the views [px].
        height: of the views [px].
        config: strategy, backend and sizes.
        rows: capacity of the scene. None: that of the config.
    """
    rows = config.rows if rows is None else rows
    sh_floats = 3 * (config.sh_degree + 1) ** 2
    per_row = 4 * _COPIES * (_GEOMETRY_FLOATS + sh_floats) + _BYTES_PER_ROW
    intersections = config.raster.budget(rows) * _BYTES_PER_INTERSECTION
    total = rows * per_row + intersections + width * height * _BYTES_PER_PIXEL
    if config.raster.backend == "numba":
        return total
    tiles = min(config.raster.tiles_per_batch, -(-width // TILE) * -(-height // TILE))
    pairs = tiles * TILE * TILE * config.raster.gaussians_per_chunk
    return total + 4 * _ARRAYS_PER_BATCH * pairs


def free_bytes(device: Any = None) -> int | None:
    """Returns the bytes that are free for the device's arrays; None where it is not known.

    Args:
        device: one of `jax.devices()`, the first by default. On a CPU the limits of the
            container count, too.
    """
    device = jax.devices()[0] if device is None else device
    if device.platform == "cpu":
        return min(_free_on_host(), default=None)
    stats = device.memory_stats()
    if not stats or "bytes_limit" not in stats:
        return None
    return stats["bytes_limit"] - stats.get("bytes_in_use", 0)


def _free_on_host(root: Path = Path("/")) -> Iterator[int]:
    """Measures the free memory of the machine, and of each control group of this process."""
    available = _number_after(root / "proc/meminfo", "MemAvailable:")
    if available is not None:
        yield available * 1024  # kB
    elif "SC_PHYS_PAGES" in os.sysconf_names:
        yield os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    for folder, names in _control_groups(root):
        limit = _number(folder / names.limit)
        usage = _number(folder / names.usage)
        if limit is not None and usage is not None:
            cache = _number_after(folder / "memory.stat", names.cache) or 0
            yield max(0, limit - usage + cache)  # files kept in memory give way


class _Names(NamedTuple):
    """How a version of control groups calls its numbers."""

    limit: str
    usage: str
    cache: str


_VERSION_1 = _Names("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
_VERSION_2 = _Names("memory.max", "memory.current", "inactive_file")


def _control_groups(root: Path) -> Iterator[tuple[Path, _Names]]:
    """Yields folders of the control groups that hold this process, innermost first."""
    for line in _read(root / "proc/self/cgroup").splitlines():
        number, _, rest = line.partition(":")
        controllers, _, path = rest.partition(":")
        if number == "0":
            base, names = root / "sys/fs/cgroup", _VERSION_2
        elif "memory" in controllers.split(","):
            base, names = root / "sys/fs/cgroup/memory", _VERSION_1
        else:
            continue
        inner = base / path.strip().lstrip("/")
        for folder in (inner, *inner.parents):
            yield folder, names
            if folder == base:
                break


def _read(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError:
        return ""


def _number(path: Path) -> int | None:
    """Reads the number in a file; None if it is missing or says `max`."""
    text = _read(path).strip()
    return int(text) if text.isdecimal() else None


def _number_after(path: Path, name: str) -> int | None:
    """Reads the number after a name in a file of such lines."""
    for line in _read(path).splitlines():
        words = line.split()
        if len(words) >= 2 and words[0] == name and words[1].isdecimal():
            return int(words[1])
    return None


def check_memory(views: Views, config: TrainConfig, *, free: int | None = None) -> None:
    """Refuses a training that would not fit, before anything is allocated or compiled.

    Args:
        views: the training views, already in memory.
        config: sizes, strategy and backend.
        free: bytes. None: what the device has free; nothing is refused where that is not known.

    Raises:
        TooLargeError: it would not fit; the message says how much is needed, how much is free
            and how many Gaussians would fit.
    """
    free = free_bytes() if free is None else free
    if free is None:
        return
    usable = int((1.0 - _RESERVE) * free)
    needed = training_bytes(views.width, views.height, config)
    if needed <= usable:
        return
    fitting = _most_rows(views.width, views.height, config, usable)
    raise TooLargeError(
        f"room for {config.rows} Gaussians (SH degree {config.sh_degree}) needs about "
        f"{needed / 1e9:.1f} GB, {free / 1e9:.1f} GB are free: "
        + (f"at most {fitting} fit" if fitting else "none would fit; lower the resolution, too")
    )


def _most_rows(width: int, height: int, config: TrainConfig, usable: int) -> int:
    """Finds the largest capacity that fits: the estimate grows with it. 0 if not even 1 does."""
    low, high = 0, config.rows
    while high - low > 1:
        middle = (low + high) // 2
        if training_bytes(width, height, config, middle) <= usable:
            low = middle
        else:
            high = middle
    return low
