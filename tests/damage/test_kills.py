"""Commands that are killed at random moments, and while they write a checkpoint, and go on.

All of it, with the counts: `pytest -m slow -s tests/damage/test_kills.py`. R3JAX_KILLS changes
the number of kills of each command (30).
"""

import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import pytest

from r3jax.apps.benchmark.record import read_records
from r3jax.files import MARKER
from r3jax.runs.reader import read_run
from tests.box_room import write_room

pytestmark = pytest.mark.slow

KILLS = int(os.environ.get("R3JAX_KILLS", "30"))
SIGNALS = (signal.SIGKILL, signal.SIGTERM, signal.SIGINT)
ROOM = {"resolution": 32, "voxel-size": 0.1, "clock": "model"}
_MAIN = "import sys; from r3jax.cli.main import main; sys.exit(main(sys.argv[1:]))"
PATIENCE = 120.0
"""No process needs longer to begin, or to end [s]."""


@dataclass(frozen=True)
class Target:
    """A command, its folder, and what of its results must not depend on kills."""

    folder: Path
    room: str

    def command(self) -> list[str]:
        """Begins, or goes on."""
        raise NotImplementedError

    def beginnings(self) -> int:
        """Grows whenever a process begins to write."""
        return sum(path.stat().st_size for path in self.folder.rglob("history.jsonl"))

    def result(self) -> object:
        """After the end."""
        raise NotImplementedError

    def progress(self) -> int:
        """Rows of views so far: never fewer than before."""
        return sum(len(read_run(path.parent).rows) for path in self.folder.rglob("run.json"))


def _command(name: str, options: dict[str, object], *more: str) -> list[str]:
    words = [word for key, value in options.items() for word in (f"--{key}", str(value))]
    return [sys.executable, "-c", _MAIN, name, *words, *more]


class Explore(Target):
    def command(self):
        if (self.folder / "run" / "run.json").exists():
            return _command("explore", {"resume": self.folder / "run"})
        options = ROOM | {"scene": self.room, "budget": "views:24", "policy": "random"}
        options |= {"out": self.folder, "name": "run", "capacity": 16384, "candidates": 20}
        return _command("explore", options | {"fov": 90})

    def result(self):
        run = self.folder / "run"
        names = ["trace.jsonl", *sorted(f"frames/{p.name}" for p in (run / "frames").iterdir())]
        state = read_run(run).load_checkpoint(23)
        arrays = {f"{t}.{n}": x.tobytes() for t in state for n, x in state[t].items()}
        return {name: (run / name).read_bytes() for name in names} | arrays


class Team(Target):
    def command(self):
        members = [self.folder / "team" / number / "run.json" for number in ("0", "1")]
        if all(path.exists() for path in members):
            return _command("team", {"resume": self.folder / "team"})
        options = ROOM | {"scene": self.room, "budget": "views:12", "policy": "random"}
        options |= {"out": self.folder, "name": "team", "capacity": 16384, "candidates": 20}
        begun = ["--overwrite"] if any(path.exists() for path in members) else []
        return _command("team", options | {"meet-every": 0.5, "fov": 90}, *begun)

    def result(self):
        traces = sorted(self.folder.rglob("trace.jsonl"))
        return [path.read_bytes() for path in traces]


class Benchmark(Target):
    def beginnings(self):
        steps = (int(p.name) for p in self.folder.glob("cells/*/training/*/0*"))
        done = len(list(self.folder.glob("cells/*/snapshot-*.json")))
        return super().beginnings() + sum(steps) + 1000 * done

    def command(self):
        options = ROOM | {"scenes": self.room, "out": self.folder, "policies": "random"}
        options |= {"budget": "views:6", "snapshots": "views:3,views:6", "train-resolution": 32}
        options |= {"iterations": 60, "gaussians": 200, "capacity": 400, "test-views": 6}
        options |= {"lpips": "none", "fov": 90, "jobs": 2, "seeds": "0,1"}
        return _command("benchmark", options, "--settings", "num_candidates=10", "num_frontier=3")

    def result(self):
        records = read_records(self.folder)
        return [(r["snapshot"], r["seed"], r["metrics"], r["exploration"]) for r in records]


class Train(Target):
    def command(self):
        return [sys.executable, "-m", "tests.splatting.training.killed_training", str(self.folder)]

    def beginnings(self):
        return self.progress()

    def progress(self):
        return max((int(p.name) for p in self.folder.glob("checkpoints/0*")), default=0)

    def result(self):
        return (self.folder / "scene.ply").read_bytes()


def _start(target: Target) -> subprocess.Popen[str]:
    target.folder.mkdir(exist_ok=True)
    cached = {"MIN_COMPILE_TIME_SECS": "0", "MIN_ENTRY_SIZE_BYTES": "-1"}
    environment = {f"JAX_PERSISTENT_CACHE_{name}": value for name, value in cached.items()}
    return subprocess.Popen(
        target.command(),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | environment | {"TERM": "dumb"},
        start_new_session=True,
    )


def _finish(target: Target) -> object:
    process = _start(target)
    output, _ = process.communicate(timeout=600)
    assert process.returncode == 0, output
    assert "Traceback" not in output, output
    leftovers = [
        path
        for pattern in ("*.partial", "*.orbax-checkpoint-tmp*")
        for path in target.folder.rglob(pattern)
    ]
    assert not leftovers
    assert not list(target.folder.rglob(".room"))
    return target.result()


def _children(pid: int) -> set[int]:
    found: set[int] = set()
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = path.read_text().rpartition(")")[2].split()
        except OSError:
            continue
        if int(fields[1]) == pid and fields[0] != "Z":
            child = int(path.parent.name)
            found |= {child} | _children(child)
    return found


def _is_alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _is_writing(target: Target, since: float) -> bool:
    """Whether a checkpoint is being written; one that an earlier kill left does not count."""
    written = target.folder.rglob(f"{MARKER}/*.partial")
    return any(path.is_dir() and _is_newer(path, since) for path in written)


def _is_newer(path: Path, since: float) -> bool:
    try:
        return path.stat().st_mtime > since
    except OSError:
        return False


def _kill(target: Target, how: signal.Signals, *, in_a_write: bool, rng: random.Random) -> str:
    """Starts the command and kills it; tells where it was, or that it had ended."""
    since = time.time()
    before, process, begin = target.beginnings(), _start(target), time.monotonic()
    while process.poll() is None and target.beginnings() == before:
        assert time.monotonic() < begin + PATIENCE
        time.sleep(0.005)
    until = time.monotonic() + rng.uniform(0.0, 3.0)
    while process.poll() is None and time.monotonic() < until:
        time.sleep(0.005)
    while process.poll() is None and in_a_write and not _is_writing(target, since):
        assert time.monotonic() < begin + PATIENCE
    where = "in a write" if _is_writing(target, since) else "elsewhere"
    children = _children(process.pid)
    if process.poll() is None:
        os.killpg(process.pid, how) if how is signal.SIGINT else process.send_signal(how)
    else:
        where = "had ended"
    output, _ = process.communicate(timeout=PATIENCE)
    codes = {-how, 130, 0} if how is signal.SIGINT else {-how, 0}
    assert process.returncode in codes, output
    if not isinstance(target, Train):  # which is no command
        # JAX's own callback of the garbage collector swallows a Ctrl-C that falls into it.
        assert "Traceback" not in re.sub(
            r"Exception ignored in.*?\nKeyboard\w+: ?", "", output, flags=re.S
        ), output
    end = time.monotonic() + 30.0
    while alive := [pid for pid in children if _is_alive(pid)]:
        assert time.monotonic() < end, f"processes {alive} outlive their parent"
        time.sleep(0.05)
    return where


@pytest.mark.parametrize("kind", [Explore, Train, Team, Benchmark], ids=lambda kind: kind.__name__)
def test_what_is_killed_goes_on_as_if_nothing_had_happened(tmp_path, kind):
    room = write_room(tmp_path / "room.ply")
    whole = _finish(kind(tmp_path / "whole", room))
    rng, counts = random.Random(0), Counter[str]()
    target, kills, compared = kind(tmp_path / "0", room), 0, 0
    while kills < KILLS:
        before, how = target.progress(), SIGNALS[kills % 3]
        where = _kill(target, how, in_a_write=kills % 2 == 0, rng=rng)
        assert target.progress() >= before or kind is Team, "what was reached is lost"
        counts[f"{how.name} {where}"] += 1
        if where != "had ended":
            kills += 1
            continue
        assert _finish(target) == whole
        compared += 1
        target = kind(tmp_path / str(len(list(tmp_path.iterdir()))), room)
    assert _finish(target) == whole
    told = {"command": kind.__name__, "kills": kills, "compared": compared + 1, **counts}
    print("\n" + json.dumps(told))
