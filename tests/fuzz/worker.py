"""The process that reads hostile files: `python -m tests.fuzz.worker FOLDER`.

For every line that it is sent, {"table": "READERS", "reader": name, "count": number}, it answers
with one: what failed, and how many cases were read or refused. The table "BOMBS" holds meshes that
would unpack to gigabytes. What kills this process kills nothing else: its standard error names
the case.
"""

import contextlib
import faulthandler
import importlib
import json
import os
import resource
import signal
import sys
import traceback
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tests.fuzz.mutations import mutate
from tests.fuzz.tree import Files, lay_out

MEMORY = 1 << 30
"""What one case may add at most [bytes]; a bomb that asks for more address space fails at once."""

HANG = 10.0
"""A case that takes longer hangs [s]."""

_LONGEST_MESSAGE = 2000
"""A message that quotes half the file helps nobody [characters]."""


@dataclass(frozen=True)
class Reader:
    """A reader under test."""

    seeds: Callable[[], list[Files]]
    """Small valid trees of files."""

    read: Callable[[Path], None]
    """Reads a tree from a folder; fails an assertion if the values make no sense."""

    errors: tuple[type[BaseException], ...]
    """The reader's own errors, exactly these types."""

    make: Callable[[np.random.Generator, Files], tuple[Files, str]] = mutate
    """Makes a case from a seed."""

    cases: int = 150
    """Of those that are made by chance, in the normal suite."""


class Guard:
    """Watches what a reader does to the rest of the machine."""

    def __init__(self, folder: Path):
        self._folder = os.fspath(folder)
        self.active = False
        self.problems: list[str] = []
        sys.addaudithook(self._hook)

    def _hook(self, event: str, args: tuple[Any, ...]) -> None:
        if not self.active:
            return
        if event == "open":
            path, _, flags = args
            writes = flags & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC)
            if isinstance(path, str | bytes) and writes:
                self._check(event, path)
        elif event in ("os.mkdir", "os.remove", "os.rmdir", "os.truncate", "shutil.rmtree"):
            self._check(event, args[0])
        elif event in ("os.rename", "os.link", "os.symlink"):
            self._check(event, args[1])
        elif event == "pickle.find_class" and _is_cache_of_numba():
            return
        elif event in ("pickle.find_class", "os.system", "subprocess.Popen", "socket.connect"):
            self.problems.append(f"{event} {args!r:.200}")

    def _check(self, event: str, path: Any) -> None:
        if not isinstance(path, str | bytes | os.PathLike):
            return
        full = os.path.realpath(os.fsdecode(path))
        # JAX and Numba keep what they compiled; the null device takes what tools print.
        allowed = (self._folder, "/dev/null", "/proc/", *_caches())
        if not full.startswith(allowed):
            self.problems.append(f"{event} outside the folder: {full}")


def _is_cache_of_numba() -> bool:
    """Whether a kernel is being read from Numba's own cache, which is pickled."""
    frame = sys._getframe()
    while frame is not None:
        if frame.f_globals.get("__name__") == "numba.core.caching":
            return True
        frame = frame.f_back
    return False


def _caches() -> tuple[str, ...]:
    names = ("JAX_COMPILATION_CACHE_DIR", "NUMBA_CACHE_DIR", "MPLCONFIGDIR")
    found = [os.environ[name] for name in names if os.environ.get(name)]
    return (*found, str(Path(__file__).resolve().parents[2] / "r3jax"))


def make_case(name: str, reader: Reader, seeds: list[Files], number: int) -> tuple[Files, str]:
    """Case `number` of a reader: always the same."""
    rng = np.random.default_rng([zlib.crc32(name.encode()), number])
    return reader.make(rng, seeds[number % len(seeds)])


def find_reader(table: str, name: str) -> tuple[Reader, list[Files]]:
    """A reader of a table, and its seeds."""
    readers = importlib.import_module("tests.fuzz.readers")
    if table != "BOMBS":
        reader: Reader = getattr(readers, table)[name]
        return reader, reader.seeds()
    return readers.READERS[name], importlib.import_module("tests.fuzz.meshes").bombs()


def run_case(reader: Reader, folder: Path, guard: Guard) -> tuple[str, str]:
    """`read`, `refused` or `failed`, and why."""
    before, peak = _resident(), _peak()
    guard.problems.clear()
    guard.active = True
    signal.setitimer(signal.ITIMER_REAL, HANG)
    faulthandler.dump_traceback_later(6 * HANG, exit=True)  # where no signal is handled
    try:
        reader.read(folder)
        verdict, why = "read", ""
    except BaseException as error:  # SystemExit and whatever else a library may raise
        verdict, why = _judge(reader, folder, error)
    signal.setitimer(signal.ITIMER_REAL, 0.0)
    faulthandler.cancel_dump_traceback_later()
    guard.active = False
    if guard.problems:
        return "failed", "; ".join(guard.problems[:3])
    if _peak() > peak and _peak() - before > MEMORY:
        return "failed", f"memory rose by {(_peak() - before) >> 20} MiB ({verdict} {why[:200]})"
    return verdict, why


def _judge(reader: Reader, folder: Path, error: BaseException) -> tuple[str, str]:
    if _ran_out_of_memory(error):
        return "failed", f"memory: {''.join(traceback.format_exception(error))[-1500:]}"
    if type(error) not in reader.errors:
        return "failed", "".join(traceback.format_exception(error))[-1500:]
    text = str(error)
    if os.fspath(folder) not in text:
        return "failed", f"the message names no file: {text[:500]}"
    if len(text) > _LONGEST_MESSAGE:
        return "failed", f"the message has {len(text)} characters: {text[:300]}"
    return "refused", text


def _ran_out_of_memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def _resident() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def _mapped() -> int:
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def _peak() -> int:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


@contextlib.contextmanager
def _under(ceiling: int) -> Iterator[None]:
    """Lets the process grow by so much and no further [bytes]."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (_mapped() + ceiling, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def check(table: str, name: str, count: int | None, folder: Path, guard: Guard) -> dict[str, Any]:
    """Reads the good files of a reader, then damaged ones, or those of another table."""
    reader, seeds = find_reader("READERS", name)
    for number, files in enumerate(seeds):  # also imports and compiles what the reader needs
        lay_out(folder, files)
        reader.read(folder)
        print(f"{name}: seed {number} is read", file=sys.stderr, flush=True)
    if table == "READERS":
        cases = (make_case(name, reader, seeds, n) for n in range(count or reader.cases))
    else:
        reader, seeds = find_reader(table, name)
        cases = ((files, "made by hand") for files in seeds)
    found: dict[str, Any] = {"failures": [], "read": 0, "refused": 0}
    for number, (files, what) in enumerate(cases):
        lay_out(folder, files)
        print(f"{name}: case {number} ({what})", file=sys.stderr, flush=True)
        with _under(MEMORY if table == "BOMBS" else 3 * MEMORY):
            verdict, why = run_case(reader, folder, guard)
        if verdict == "failed":
            found["failures"].append(f"case {number} ({what}): {why}")
        else:
            found[verdict] += 1
    return found


class Hang(BaseException):
    """Raised in a case that takes too long; no reader may make another error of it."""


def _hang(*_: object) -> None:
    raise Hang(f"for more than {HANG} s")


def main() -> None:
    """Answers until there are no more questions."""
    scratch = Path(sys.argv[1]).resolve()
    (scratch / "outside").mkdir(parents=True, exist_ok=True)
    (scratch / "outside" / "secret").write_bytes(b"this is none of your business " * 40)
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # whatever libraries print is no answer
    guard, folder = Guard(scratch / "case"), scratch / "case"
    folder.mkdir(exist_ok=True)
    os.chdir(scratch)
    signal.signal(signal.SIGALRM, _hang)
    for line in sys.stdin:
        asked = json.loads(line)
        found = check(asked["table"], asked["reader"], asked["count"], folder, guard)
        print(json.dumps(found), file=answers, flush=True)


if __name__ == "__main__":
    main()
