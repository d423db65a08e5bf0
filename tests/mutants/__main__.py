"""Plants every fault in a copy of the package, and runs the test that must notice it.

python -m tests.mutants [WORD ...]: those whose file, test or fault contains one of the words.
"""

import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from queue import Queue

from tests.mutants import Mutant, geometry, mapping, scoring, splatting

ROOT = Path(__file__).resolve().parents[2]
MUTANTS = [*geometry.MUTANTS, *mapping.MUTANTS, *scoring.MUTANTS, *splatting.MUTANTS]
PROCESSES = int(os.environ.get("R3JAX_MUTANT_PROCESSES", "2"))
SECONDS = 300
"""After which a test with a fault counts as failed: some faults make a loop endless."""

_CAUGHT = 1
"""Pytest's exit status if a test failed; 0: it passed; others: pytest could not run it."""

_PYTEST = (
    "import sys, r3jax, pytest; assert r3jax.__file__.startswith(sys.argv[1]), r3jax.__file__; "
    "sys.exit(pytest.main(sys.argv[2:]))"
)
"""Imports the copy first: pytest would put the repository before it."""


def main(words: list[str]) -> int:
    """Prints a line for each mutant that is stale or survives; returns the exit status."""
    chosen = [m for m in MUTANTS if not words or any(word in " ".join(m) for word in words)]
    fresh = [mutant for mutant in chosen if count_in_source(mutant) == 1]
    for mutant in chosen:
        if mutant not in fresh:
            print(f"stale ({count_in_source(mutant)} times, not once): {describe(mutant)}")
    no_fault = [Mutant("r3jax/__init__.py", "", "", m.test) for m in fresh]
    sound = list(dict.fromkeys(no_fault))
    failing, survivors = 0, 0
    with contextlib.ExitStack() as copies, ThreadPoolExecutor(PROCESSES) as pool:
        for _ in range(PROCESSES):
            _COPIES.put(copied(Path(copies.enter_context(tempfile.TemporaryDirectory()))))
        for mutant, code in zip(sound, pool.map(run, sound), strict=True):
            if code != 0:
                failing += 1
                print(f"fails without a fault (pytest: {code}): {mutant.test}", flush=True)
        for mutant, code in zip(fresh, pool.map(run, fresh), strict=True):
            if code != _CAUGHT:
                survivors += 1
                print(f"survives (pytest: {code}): {describe(mutant)}", flush=True)
    num_stale = len(chosen) - len(fresh)
    print(f"{len(chosen)} mutants, {num_stale} stale, {survivors} survive, {failing} tests fail")
    return int(bool(num_stale or survivors or failing))


def describe(mutant: Mutant) -> str:
    """File, fault and test in a line."""
    return f"{mutant.file}: {mutant.original!r} -> {mutant.mutated!r} ({mutant.test})"


def count_in_source(mutant: Mutant) -> int:
    """How often the fault's place occurs in the file."""
    path = ROOT / mutant.file
    return path.read_text(encoding="utf-8").count(mutant.original) if path.exists() else 0


def run(mutant: Mutant) -> int:
    """Returns pytest's exit status with the fault."""
    if mutant.file.startswith("r3jax/kernels/"):  # its machine code must not serve another mutant
        with tempfile.TemporaryDirectory() as folder:
            return run_in(copied(Path(folder)), mutant)
    folder = _COPIES.get()
    try:
        return run_in(folder, mutant)
    finally:
        _COPIES.put(folder)


_COPIES: Queue[Path] = Queue()
"""Copies of the package that mutants of plain Python take in turn: kernels are compiled once."""


def copied(folder: Path) -> Path:
    """Copies the package into a folder, and returns the folder."""
    shutil.copytree(ROOT / "r3jax", folder / "r3jax")
    return folder


def run_in(folder: Path, mutant: Mutant) -> int:
    """Returns pytest's exit status with the fault planted in a copy, which is mended afterwards."""
    path = folder / mutant.file
    source = path.read_text(encoding="utf-8")
    options = ["-x", "-q", "-p", "no:cacheprovider", "-o", "addopts=", f"--rootdir={ROOT}"]
    words = [sys.executable, "-c", _PYTEST, str(folder), *options, str(ROOT / mutant.test)]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join((str(folder), str(ROOT)))}
    try:
        path.write_text(source.replace(mutant.original, mutant.mutated, 1), encoding="utf-8")
        done = subprocess.run(words, cwd=folder, env=env, capture_output=True, timeout=SECONDS)
    except subprocess.TimeoutExpired:
        return _CAUGHT
    finally:
        shutil.copy2(ROOT / mutant.file, path)  # with its time: what is compiled of it stays
    return done.returncode


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
