"""Strict JAX, one hypothesis profile, and the shared data that some tests compare with."""

import ctypes
import gc
import importlib
import os
import signal
from pathlib import Path

import jax
import pytest
from hypothesis import settings

jax.config.update("jax_numpy_dtype_promotion", "strict")
jax.config.update("jax_numpy_rank_promotion", "raise")

# Compilation dominates these tests: keep what was compiled, also the small pieces.
_cache = os.environ.get("JAX_COMPILATION_CACHE_DIR")
if _cache:
    jax.config.update("jax_compilation_cache_dir", _cache)
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)

_QUICK_COMPILER = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"
"""XLA's older emitters, in one thread (there are two test processes): a third less time for a
program that is compiled to run once. A flag that XLA does not know ends the process, so they are
set for the version that these were measured with alone."""


_LEFT_TO_TEST_ALL = (
    "apps", "captures", "experiments", "notebooks", "plots",
    "cli/test_evaluate.py", "cli/test_odd_worlds.py", "cli/test_train.py",
    "evaluation/test_test_views.py",
    "exploration/test_captures.py", "exploration/test_guard.py", "exploration/test_motion.py",
    "exploration/test_plan_while_moving.py",
    "mapping/test_scans.py",
    "baselines/test_active_gamer.py", "baselines/test_gavis.py",
    "baselines/test_r3con.py",
    "planning/test_motions_of_policies.py", "planning/test_next_views.py",
    "scoring/test_explain.py", "scoring/test_leaks.py", "baselines/test_pixels.py",
    "scoring/test_simulated.py",
    "simulators/scenes/test_procedural.py", "simulators/test_free_space.py",
    "simulators/habitat/test_habitat.py", "simulators/test_start.py",
    "splatting/backends/test_agreement.py", "splatting/backends/test_numba",
    "splatting/backends/test_splax.py",
    "splatting/backends/test_xla.py",
    "splatting/training/test_density.py", "splatting/training/test_mcmc.py",
    "splatting/training/test_train_checkpoints.py",
)  # fmt: skip
"""Whole folders and files that `make test` leaves out: what is built on the method, and the finer
points of it. Single tests elsewhere are marked `full` themselves."""


def pytest_ignore_collect(collection_path, config):
    """Leaves files to `make test-all` unread.

    Reading them would import what is built on the method, a fifth of the time of `make test`.
    """
    if "not (full" not in config.option.markexpr or collection_path.suffix != ".py":
        return None
    is_left = str(collection_path).startswith(_left_to_test_all())
    return True if is_left else None


def _left_to_test_all() -> tuple[str, ...]:
    return tuple(str(Path(__file__).parent / name) for name in _LEFT_TO_TEST_ALL)


def pytest_collection_modifyitems(items):
    """Marks what is left to `make test-all`, before pytest selects by markers."""
    left = _left_to_test_all()
    for item in items:
        if str(item.path).startswith(left) and not item.get_closest_marker("slow"):
            item.add_marker(pytest.mark.full)


def is_measured(config: pytest.Config) -> bool:
    """True with --benchmark-enable; `benchmark_disable` is always set, by our defaults."""
    return bool(config.getoption("benchmark_enable", default=False))


def pytest_configure(config):
    """Compiles quickly, unless it is measured how long things take: then all benchmarks run."""
    if is_measured(config):
        config.option.markexpr = "not slow"
    flags = os.environ.get("XLA_FLAGS", "")
    is_known = jax.__version_info__[:2] == (0, 10)
    # Once, though each test process inherits them: a program is found again by its flags' text.
    if is_known and not is_measured(config) and _QUICK_COMPILER not in flags:
        os.environ["XLA_FLAGS"] = f"{flags} {_QUICK_COMPILER}"


# A shell's background job begins with Ctrl-C ignored; the tests of interrupts need it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

settings.register_profile("jax", deadline=None, max_examples=30, derandomize=True)
settings.load_profile("jax")

SHARED = Path(__file__).resolve().parents[2] / "shared"
"""Golden values, scenes and recordings: a folder beside the repository, absent elsewhere."""


def shared_path(*parts: str) -> Path:
    """A file or folder of the shared data; skips the calling test where it is absent."""
    path = SHARED.joinpath(*parts)
    if not path.exists():
        pytest.skip(f"needs ../shared/{'/'.join(parts)}, which is not here")
    return path


_MOST_MAPPINGS = 20_000
_MOST_MEMORY = 1_400 << 20
"""Of a test process before it forgets what it has compiled [bytes]."""


@pytest.fixture(scope="module", autouse=True)
def _few_programs():
    """Drops compiled code between files before the process runs out of mappings or memory.

    XLA's CPU compiler maps every computation; Linux allows 65 530 mappings a process (the
    default of vm.max_map_count), the whole suite needs more, and LLVM aborts at the limit.
    """
    yield
    mappings = Path("/proc/self/maps")
    if not mappings.exists():
        return
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    has_much = pages * os.sysconf("SC_PAGE_SIZE") > _MOST_MEMORY
    if has_much or mappings.read_bytes().count(b"\n") > _MOST_MAPPINGS:
        jax.clear_caches()
        gc.collect()
        ctypes.CDLL(None).malloc_trim(0)  # else glibc keeps what was freed


@pytest.fixture(scope="session", autouse=True)
def _no_process_that_compiles_ahead():
    """Two test processes use the cores; what one compiles the other finds on the disk."""
    with pytest.MonkeyPatch.context() as patch:
        for caller in (
            "r3jax.cli.command_line", "r3jax.planning.planner", "r3jax.simulators.scenes.registry",
        ):  # fmt: skip
            patch.setattr(importlib.import_module(caller), "compile_ahead", lambda: None)
        yield


@pytest.fixture(scope="session")
def shared():
    """`shared("golden", "file.npz")` is the path of shared data, or skips the test."""
    return shared_path
