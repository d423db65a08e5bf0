"""Plants every fault in a copy of the package, and runs the test that must notice it.

python -m tests.mutants [WORD ...]: those whose file, test or fault contains one of the words.
"""

import contextlib
import io
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
from pathlib import Path

import pytest

from tests.mutants import Mutant, geometry, mapping, scoring, splatting

ROOT = Path(__file__).resolve().parents[2]
MUTANTS = [*geometry.MUTANTS, *mapping.MUTANTS, *scoring.MUTANTS, *splatting.MUTANTS]
PROCESSES = 2
_QUIET = "filterwarnings=ignore::pytest.PytestAssertRewriteWarning"
SECONDS = 300
"""After which a test with a fault counts as failed: some faults make a loop endless."""


def main(words: list[str]) -> int:
    """Prints a line for each mutant that is stale or survives; returns the exit status."""
    chosen = [m for m in MUTANTS if not words or any(word in " ".join(m) for word in words)]
    stale = [mutant for mutant in chosen if count_in_source(mutant) != 1]
    for mutant in stale:
        print(f"stale: {describe(mutant)} occurs {count_in_source(mutant)} times, not once")
    tests = sorted({mutant.test for mutant in chosen if mutant not in stale})
    # Preloading what every test imports saves seconds each; the package itself must be the copy.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["jax", "numba", "numpy", "scipy", "equinox", "pytest"])
    survivors = []
    with context.Pool(PROCESSES, maxtasksperchild=1) as pool:
        sound = pool.map_async(run_without_fault, tests, chunksize=1)
        verdicts = pool.imap(run, [m for m in chosen if m not in stale], chunksize=1)
        failing = [test for test, code in zip(tests, sound.get(), strict=True) if code != 0]
        for test in failing:
            print(f"fails without a fault: {test}", flush=True)
        for mutant, code in zip([m for m in chosen if m not in stale], verdicts, strict=True):
            if code != 1:  # 0: all tests passed; others: pytest could not run them
                survivors.append(mutant)
                print(f"survives (pytest: {code}): {describe(mutant)}", flush=True)
    print(f"{len(chosen)} mutants, {len(stale)} stale, {len(survivors)} survive")
    return int(bool(stale or survivors or failing))


def describe(mutant: Mutant) -> str:
    """File, fault and test in a line."""
    return f"{mutant.file}: {mutant.original!r} -> {mutant.mutated!r} ({mutant.test})"


def count_in_source(mutant: Mutant) -> int:
    """How often the fault's place occurs in the file."""
    path = ROOT / mutant.file
    return path.read_text(encoding="utf-8").count(mutant.original) if path.exists() else 0


def run_without_fault(test: str) -> int:
    """Returns pytest's exit status with the package as it is."""
    return run(Mutant("r3jax/__init__.py", "", "", test))


def run(mutant: Mutant) -> int:
    """Returns pytest's exit status with the fault, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder) / "r3jax"
        shutil.copytree(ROOT / "r3jax", copy)
        path = Path(folder) / mutant.file
        source = path.read_text(encoding="utf-8")
        path.write_text(source.replace(mutant.original, mutant.mutated, 1), encoding="utf-8")
        return _pytest_with(folder, mutant.test)


def _pytest_with(folder: str, test: str) -> int:
    """Runs one test in this process, which must not have imported the package before."""
    os.chdir(ROOT)
    sys.path.insert(0, folder)
    import r3jax

    assert str(r3jax.__file__).startswith(folder), r3jax.__file__
    signal.signal(signal.SIGALRM, _fail)
    signal.alarm(SECONDS)
    options = [
        "-x",
        "-q",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
        "-o",
        "addopts=",
        "-o",
        _QUIET,
    ]
    silence = io.StringIO()
    with contextlib.redirect_stdout(silence), contextlib.redirect_stderr(silence):
        return int(pytest.main([*options, test]))


def _fail(*_: object) -> None:
    pytest.exit("too slow", returncode=1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
