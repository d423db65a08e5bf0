"""Does everything hold on this machine's GPU, and how fast is it? One table; `make gpu-check`.

    python -m experiments.gpu_check

Runs the tests of all backends, the benchmarks, and one experiment at `--size smoke`, on the device
that JAX takes, and writes `build/gpu_check.md`. Nothing in it needs the network.
"""

import json
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import tyro

from experiments.pages.artifacts import joint_origin, markdown_table, write_markdown
from r3jax.apps.benchmark.record import machine, source_commit

NAME = "gpu_check"

TESTS = (
    "tests/geometry",
    "tests/mapping",
    "tests/visibility",
    "tests/scoring",
    "tests/splatting",
    "tests/exploration/test_explore.py",
)
"""What computes on the device: every backend is held to its reference there."""


@dataclass(frozen=True)
class Options:
    """What is checked, and where the table goes."""

    out: Path = Path("build")
    """Folder of the table, and of what the steps print."""

    any_device: bool = False
    """Go on without a GPU: the table then says what this machine's CPU does."""

    tests: tuple[str, ...] = TESTS
    """Folders and files of tests."""


@dataclass(frozen=True)
class Step:
    """One command of the check."""

    name: str
    words: Sequence[str]


def main(options: Options) -> int:
    """Runs the steps and writes the table.

    Returns:
        0 if all passed.

    Raises:
        SystemExit: JAX has found no GPU, and `any_device` is not given.
    """
    devices = [device.device_kind for device in jax.devices()]
    if jax.default_backend() == "cpu" and not options.any_device:
        raise SystemExit(
            "JAX has found no GPU: install its CUDA plug-in (pip install 'jax[cuda12]'), or give "
            "--any-device to check the CPU"
        )
    options.out.mkdir(parents=True, exist_ok=True)
    timings = options.out / f"{NAME}_benchmarks.json"
    rows = [run(step, options.out) for step in steps_of(options, timings)]
    measured = benchmark_rows(json.loads(timings.read_text())) if timings.exists() else []
    write_table(options.out / f"{NAME}.md", devices, rows, measured)
    print(f"table    {options.out / f'{NAME}.md'}")
    return 0 if all(row["result"] == "passed" for row in rows) else 1


def steps_of(options: Options, timings: Path) -> list[Step]:
    """Returns the commands, in order: what is wrong shows before what is slow."""
    python, pytest = sys.executable, (sys.executable, "-m", "pytest", "-q")
    smoke = ("--size", "smoke", "--work", str(options.out / NAME), "--out", str(options.out / NAME))
    return [
        # One process: several would share the memory of one GPU.
        Step("tests", (*pytest, "-m", "not slow", *options.tests)),
        Step(
            "benchmarks",
            (*pytest, "tests/benchmarks", "--jaxtyping-packages=", "--benchmark-enable",
             "--benchmark-only", f"--benchmark-json={timings}"),
        ),
        Step("experiment", (python, "-m", "experiments.replica_dense_views", *smoke)),
    ]  # fmt: skip


def run(step: Step, folder: Path) -> dict[str, Any]:
    """Runs a step, keeps what it prints, and says how it went."""
    log = folder / f"{NAME}_{step.name}.txt"
    print(f"{step.name} ...", flush=True)
    begin = time.perf_counter()
    with log.open("w") as file:
        code = subprocess.run(step.words, stdout=file, stderr=subprocess.STDOUT, check=False)
    seconds = time.perf_counter() - begin
    lines = [line for line in log.read_text().splitlines() if line.strip()]
    return {
        "step": step.name,
        "result": "passed" if code.returncode == 0 else f"failed ({code.returncode})",
        "seconds": seconds,
        "last line": lines[-1] if lines else "",
    }


def benchmark_rows(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Returns the medians of a report of pytest-benchmark [ms]."""
    return [
        {
            "benchmark": found["fullname"].removeprefix("tests/benchmarks/"),
            "median [ms]": 1e3 * found["stats"]["median"],
            "least [ms]": 1e3 * found["stats"]["min"],
        }
        for found in report["benchmarks"]
    ]


def write_table(
    path: Path,
    devices: Sequence[str],
    rows: Sequence[dict[str, Any]],
    measured: Sequence[dict[str, Any]],
) -> None:
    """Writes steps and medians as one page.

    Args:
        path: of the page.
        devices: kinds of JAX's devices.
        rows: of the steps.
        measured: of the benchmarks; none if they did not run.
    """
    page = [f"JAX {jax.__version__} on {', '.join(devices)}", markdown_table(rows)]
    if measured:
        page.append(markdown_table(measured))
    write_markdown(path, page, joint_origin(f"experiments.{NAME}", [machine()], [source_commit()]))


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, description=__doc__)))
