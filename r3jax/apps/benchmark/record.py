"""The record of one cell at one snapshot: a JSON object, a line of `cells.jsonl`."""

import dataclasses
import functools
import json
import math
import os
import platform
import subprocess
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path, PurePosixPath
from statistics import median
from typing import Any

from r3jax.apps.benchmark.cells import Cell, paths_of, snapshot_order
from r3jax.errors import InputError
from r3jax.evaluation.scores import METRICS, ViewRow, summarize
from r3jax.exploration.taken_views import StepRow
from r3jax.files import write_atomic
from r3jax.planning.policies import current_name
from r3jax.runs.header import package_versions, plain_settings
from r3jax.validation.errors import ForeignFileError, VersionError, check_version
from r3jax.validation.files import read_bytes
from r3jax.validation.json_text import check_fields, parse_json, sealed, unsealed

FORMAT = 1
"""Format version of a record."""

_MAX_BYTES = 64 << 20

_KINDS = {
    **dict.fromkeys(("format", "seed", "resolution"), int),
    **dict.fromkeys(
        ("scene", "scene_hash", "policy", "budget", "snapshot", "clock", "run", "machine"), str
    ),
    **dict.fromkeys(("settings", "sensing", "training", "test_views", "packages"), dict[str, Any]),
    **dict.fromkeys(("commit", "lpips_network"), str | None),
    "exploration": dict[str, float | str],
    "metrics": dict[str, dict[str, float | list[float] | None] | None],
    "views": dict[str, list[float | None] | None],
}

_PARTS = {
    "training": {"iterations": int, "resolution": int},
    "test_views": {"hash": str, "resolution": int},
    "views": {"view": list[int]},
}
"""Fields that tables and figures rely on."""

CELLS = "cells.jsonl"
"""All records of a benchmark, one a line."""


def make_record(
    root: Path,
    cell: Cell,
    snapshot: str,
    steps: Sequence[StepRow],
    outcome: str,
    rows: Sequence[ViewRow],
    decision_seconds: Sequence[float] = (),
) -> dict[str, Any]:
    """Makes the record of a snapshot.

    Args:
        root: folder of the benchmark.
        cell: what was done.
        snapshot: up to where.
        steps: rows of the exploration up to the snapshot, at least one.
        outcome: why it ended there.
        rows: one per test view.
        decision_seconds: what the decisions took on this machine; none: not known.
    """
    conditions, last = cell.conditions, steps[-1]
    return {
        "format": FORMAT,
        "scene": cell.scene_name,
        "scene_hash": cell.scene_hash,
        "policy": cell.policy,
        "settings": plain_settings(cell.settings),
        "seed": cell.seed,
        "budget": conditions.budget,
        "snapshot": snapshot,
        "clock": conditions.clock,
        "resolution": conditions.resolution,
        "sensing": {
            name: getattr(conditions, name)
            for name in ("fov", "noise", "max_range", "voxel_size", "cell_size")
        }
        | conditions.loop,
        "lpips_network": conditions.lpips,
        "training": {
            "iterations": conditions.iterations,
            "resolution": conditions.train_resolution,
            "gaussians": conditions.gaussians,
            "capacity": conditions.capacity,
            "strategy": conditions.train_config(cell.seed).strategy,
            "seed": cell.seed,
        }
        | conditions.trainer,
        "test_views": {
            "hash": cell.test_views_hash,
            "count": cell.num_test_views,
            "resolution": conditions.train_resolution,
        },
        "exploration": {
            "views": len(steps),
            "seconds": last.seconds,
            "metres": last.metres,
            "radians": last.radians,
            "known_share": last.coverage.known_share,
            "mean_renderability": last.coverage.mean_renderability,
            "map_bytes": last.coverage.map_bytes,
            "outcome": outcome,
        },
        # Differs from run to run, as does what follows from the machine.
        "measured": {"decision_ms": 1e3 * median(decision_seconds)} if decision_seconds else {},
        "metrics": _metrics(rows),
        "views": _columns(rows),
        "run": paths_of(root, cell).run.relative_to(root).as_posix(),
        "machine": machine(),
        "commit": source_commit(),
        "packages": package_versions(),
    }


def _metrics(rows: Sequence[ViewRow]) -> dict[str, Any]:
    """Summarizes every metric, by name; None where no view has a value."""
    metrics: dict[str, Any] = {metric.name: None for metric in METRICS}
    for summary in summarize(rows):
        plain = dataclasses.asdict(summary)
        del plain["metric"], plain["views"]
        metrics[summary.metric.name] = plain | {"interval": list(summary.interval)}
    return metrics


def _columns(rows: Sequence[ViewRow]) -> dict[str, Any]:
    """Turns rows into columns; a column without any value becomes None."""
    columns: dict[str, Any] = {}
    for field in dataclasses.fields(ViewRow):
        values = [_finite(getattr(row, field.name)) for row in rows]
        columns[field.name] = None if all(value is None for value in values) else values
    return columns


def _finite(value: float | int | None) -> float | int | None:
    return None if value is None or not math.isfinite(value) else value


def write_record(path: Path, record: dict[str, Any]) -> None:
    """Writes a record as one line: it is there as a whole, or not at all.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    line = json.dumps(sealed(record), allow_nan=False, separators=(",", ":"))
    write_atomic(path, line.encode() + b"\n")


def read_records(root: Path, cells: Iterable[Cell] | None = None) -> list[dict[str, Any]]:
    """Reads the records of a benchmark, ordered by the cells' names, then by snapshot.

    A record is a dictionary: `scene`, `policy`, `settings`, `seed`, `snapshot`, what the views
    cost (`exploration`), each metric's mean, interval and tail (`metrics`), and its value in each
    test view (`views`). `pandas.json_normalize(records)` makes a table of them.

    Args:
        root: folder of a benchmark, or a `cells.jsonl` that lies elsewhere.
        cells: whose records; None: all that were ever made there.

    Raises:
        ValueError: a record is damaged; the message names it.
        OSError: a record cannot be read.
    """
    if Path(root).is_file():
        return _read_lines(root)
    if cells is None:
        folders = [path for path in (Path(root) / "cells").glob("*") if path.is_dir()]
    else:
        folders = [paths_of(root, cell).folder for cell in cells]
    records: list[dict[str, Any]] = []
    for folder in sorted(folders):
        found = [_read_record(path) for path in folder.glob("snapshot-*.json")]
        records += sorted(found, key=lambda record: snapshot_order(record["snapshot"]))
    return records


def _read_record(path: Path) -> dict[str, Any]:
    """Reads one record.

    Raises:
        ValueError: it is damaged, or a newer version of this package wrote it.
    """
    try:
        return _parse_record(read_bytes(path, _MAX_BYTES))
    except VersionError as error:
        raise InputError(f"{path} has {error}") from None
    except ValueError as error:
        raise InputError(
            f"{path} is no record of a benchmark ({error!s:.300}): delete it and start the "
            "benchmark again: it computes the missing ones"
        ) from None


def _parse_record(text: bytes) -> dict[str, Any]:
    """Parses a record from its line.

    Raises:
        VersionError: a newer version of this package wrote it.
        ValueError: it is damaged.
    """
    record = parse_json(text)
    if isinstance(record, dict):
        check_version(record.get("format"), FORMAT)
        record = unsealed(record)
    check_fields("record", record, _KINDS)
    for name, kinds in _PARTS.items():
        check_fields(name, record[name], kinds)
    snapshot_order(record["snapshot"])
    run = PurePosixPath(record["run"])
    if run.is_absolute() or ".." in run.parts or "\0" in record["run"]:
        raise ForeignFileError(f"its run {record['run'][:80]!r} lies outside of the benchmark")
    lengths = {len(column) for column in record["views"].values() if column is not None}
    if len(lengths) != 1:
        raise ForeignFileError(f"the columns of `views` differ in length: {sorted(lengths)}")
    return record | {"policy": current_name(record["policy"])}


def collect(root: Path) -> Path:
    """Writes all records of a benchmark to one file, and returns its path."""
    path = Path(root) / CELLS
    write_records(path, read_records(root))
    return path


def write_records(path: Path, records: Iterable[Mapping[str, Any]]) -> None:
    """Writes records to one file, one a line.

    Raises:
        OSError: the disk is full, not writable, ...
    """
    lines = [json.dumps(sealed(dict(record)), separators=(",", ":")) + "\n" for record in records]
    write_atomic(path, "".join(lines).encode())


def _read_lines(path: Path) -> list[dict[str, Any]]:
    """Reads the records of a file that `write_records` wrote.

    Raises:
        ValueError: a line is no record; the message says which.
        OSError: the file cannot be read.
    """
    records: list[dict[str, Any]] = []
    for number, line in enumerate(read_bytes(path, _MAX_BYTES).splitlines(), start=1):
        try:
            records.append(_parse_record(line))
        except ValueError as error:
            raise InputError(
                f"{path}, line {number}, is no record of a benchmark ({error!s:.300})"
            ) from None
    return records


@functools.cache
def machine() -> str:
    """Describes the kind of machine, never its name, which is private."""
    import jax

    devices = jax.devices()
    return (
        f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores, "
        f"{len(devices)} x {devices[0].device_kind}"
    )


@functools.cache
def source_commit() -> str | None:
    """Returns the commit of this package's source, with `-dirty` if changed; None if not known."""
    package = Path(__file__).resolve().parents[2]

    def git(*words: str) -> str:
        command = ["git", "-C", str(package), *words]
        return subprocess.run(
            command, capture_output=True, text=True, timeout=20, check=True
        ).stdout.strip()

    try:
        # A package that was installed into somebody's repository is not that repository's.
        if not git("ls-files", "--", str(package / "__init__.py")):
            return None
        dirty = "-dirty" if git("status", "--porcelain", "--", str(package)) else ""
        return git("rev-parse", "HEAD") + dirty
    except (OSError, subprocess.SubprocessError):
        return None
