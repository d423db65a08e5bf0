"""The command line with hostile values, and on damaged folders.

The work itself (exploring, mapping, training, evaluating, planning a benchmark) is left out: a case
ends where it would begin. What was asked is refused with one line and exit code 2, or makes sense.
"""

import contextlib
import functools
import io
import json
import os
import re
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from r3jax.apps.report import figures
from r3jax.cli.commands import audit, benchmark, explore, models, runs
from r3jax.cli.main import main
from r3jax.evaluation import judge
from r3jax.exploration.config import ExplorationConfig
from r3jax.geometry.cameras import Camera
from r3jax.kernels import bridge
from r3jax.kernels.native.ahead import compile_ahead
from r3jax.mapping.join import merge
from r3jax.runs.header import header_to_json
from r3jax.simulators.meshes import load_world
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.fuzz.mutations import mutate
from tests.fuzz.tree import Entry, Files
from tests.runs.runs import make_header
from tests.simulators.rooms import box_quads, world_of

COMMANDS = (
    ("info",),
    ("info", "run"),
    ("info", "recording", "--up", "z"),
    ("policies",),
    ("explore", "--scene", "mesh:room.obj", "--policy", "random", "--resolution", "32"),
    ("explore", "--scene", "mesh:room.obj", "--budget", "seconds:5", "--resolution", "64"),
    ("explore", "--resume", "run"),
    ("explore", "--fork", "run", "--at", "1", "--name", "fork"),
    ("train", "recording", "--iterations", "10", "--hold-out", "2", "--name", "m"),
    ("train", "run", "--resolution", "16", "--name", "other"),
    ("evaluate", "run", "--lpips", "none", "--views", "all"),
    (
        "evaluate",
        "recording",
        "--views",
        "every:2",
        "--lpips",
        "none",
        "--model",
        "run/models/last",
    ),
    ("benchmark", "--scenes", "flat", "--policies", "random", "--budget", "views:3", "--jobs", "0"),
    ("replay", "run"),
    ("merge", "run", "twin", "--out", "out"),
    ("export", "run", "--format", "colmap", "--out", "out"),
    ("audit", "recording", "--out", "out", "--voxel-size", "0.1"),
    ("audit", "run", "--path", "recording", "--views", "3"),
)


def options_of(command: str) -> list[str]:
    """The options that its help names."""
    said = io.StringIO()
    with contextlib.redirect_stdout(said), contextlib.suppress(SystemExit):
        main([command, "--help"])
    return sorted(set(re.findall(r"--[a-z][a-z0-9-]+", said.getvalue())) - {"--help"})


OPTIONS = {name: options_of(name) for name in sorted({words[0] for words in COMMANDS})}
"""The options of each command."""

CONFIG = ExplorationConfig()


class Refused(Exception):
    """Exit code 2, and one line that says why."""


class Begun(BaseException):
    """The words make sense: the work would begin."""


def seeds(run: Files, splats: Files, recording: Files) -> list[Files]:
    """Every command with a run that holds a model, a recording, and a scene."""
    compile_ahead()  # once in a process, and not by the command under test
    # Numba unpickles its own machine code, which the guard would lay at a command's door.
    for name in ("map_add", "map_mark"):
        bridge.register(name)
    walls = world_of(box_quads((-2, -2, -1.5), (2, 2, 1.5), inward=True))
    _ = RaycastSimulator(walls, Camera.from_fov(6, 4, 90.0)).start_pose
    files: dict[str, Entry] = {}
    for name, data in run.items():
        files[f"run/{name}"] = data
    files["run/models/last/scene.ply"] = splats["scene.ply"]
    scene = {"name": "mesh:room.obj", "up": None, "noise": 0.0, "max_range": 5.0, "start": None}
    policy = {"name": "random", "settings": {}}
    for name, data in recording.items():
        files[f"recording/{name}"] = data
    corners = "".join(f"v {x} {y} {z}\n" for z in (0, 3) for y in (0, 4) for x in (0, 4))
    quads = ((1, 3, 4, 2), (5, 6, 8, 7), (1, 2, 6, 5), (3, 7, 8, 4), (1, 5, 7, 3), (2, 4, 8, 6))
    faces = "".join("f {} {} {} {}\n".format(*quad) for quad in quads)
    files["room.obj"] = (corners + faces).encode()
    with tempfile.TemporaryDirectory() as name:
        (Path(name) / "room.obj").write_bytes(files["room.obj"])
        scene["hash"] = load_world(Path(name) / "room.obj").content_hash
    header = header_to_json(make_header(scene=scene, policy=policy, config=vars(CONFIG)))
    files["run/run.json"] = header.encode()
    files |= {f"twin{k.removeprefix('run')}": v for k, v in files.items() if k.startswith("run/")}
    return [files | {"words.json": json.dumps(words).encode()} for words in COMMANDS]


def make(rng: np.random.Generator, files: Files) -> tuple[Files, str]:
    """A damaged run or recording."""
    folder = ("run/", "recording/")[rng.integers(2)]
    part, what = mutate(rng, {k: v for k, v in files.items() if k.startswith(folder)})
    whole = {k: v for k, v in files.items() if not k.startswith(folder)}
    return whole | dict(part), f"{what}, {bytes_of(files['words.json'])!r:.300}"


def bytes_of(entry: Entry) -> bytes:
    assert isinstance(entry, bytes)
    return entry


def read(folder: Path) -> None:
    words = json.loads((folder / "words.json").read_bytes())
    said, before = io.StringIO(), Path.cwd()
    os.chdir(folder)
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(io.StringIO()):
            with_work_left_out()
            code = main(words)
    except Begun:
        return
    except SystemExit as stop:  # how tyro refuses words
        code = stop.code
    finally:
        os.chdir(before)
    assert code in (0, 2), f"exit code {code}: {said.getvalue()[-500:]}"
    text = said.getvalue()
    assert "Traceback" not in text
    if code == 2:
        assert text.strip(), "it says nothing"
        raise Refused(text[-300:])


@functools.cache
def with_work_left_out() -> None:
    """Replaces, in this process, what takes minutes."""

    def begin(*_: Any, **__: Any) -> Any:
        raise Begun

    audit.audit = begin
    explore.explore = begin
    models.train.fit = begin
    judge.evaluate = begin
    benchmark.make_plan = begin
    merge.rebuild = begin
    runs.differences = begin
    judge.map_of = begin
    figures.follow_recording = begin


VALUES = {
    "--seed": ("-1", "9223372036854775808", "4294967296"),
    "--noise": ("nan", "-1", "inf", "1e308"),
    "--max-range": ("nan", "-1", "0", "inf", "1e308", "1e-300"),
    "--fov": ("nan", "0", "180", "1e-300"),
    "--start": ("nan 0 0", "1e308 0 0", "inf 0 0"),
    "--resolution": ("-1", "0", "1000000000"),
    "--voxel-size": ("nan", "0", "-1", "1e-300", "1e308"),
    "--cell-size": ("nan", "0", "-1", "1e-300", "1e308"),
    "--capacity": ("0", "-1", "3", "1099511627776", "9223372036854775807"),
    "--candidates": ("0", "-1", "1000000000000"),
    "--lambda1": ("nan", "-1", "inf", "1e308"),
    "--lambda2": ("nan", "-1", "inf", "1e308"),
    "--name": ("../../x", "a/../../../x", "", ".", "..", "x\0y", "x" * 300),
    "--budget": ("views:1e30", "views:nan", "seconds:1e308", "views:9223372036854775808"),
    "--iterations": ("0", "-1", "1000000000000"),
    "--gaussians": ("0", "-1", "1000000000000"),
    "--hold-out": ("1", "-1", "1000000000000"),
    "--views-per-step": ("0", "-1", "1000000000000"),
    "--worst": ("-1", "1000000000000"),
    "--test-views": ("-1", "1", "1000000000000"),
    "--jobs": ("-1",),
}
"""Values of options that chance seldom pairs with them."""

BEGINNINGS = (COMMANDS[5], COMMANDS[8], COMMANDS[10], COMMANDS[12])


def crafted(whole: Files) -> list[Files]:
    """Each value with the first command that has the option: all read it by the same rule."""
    cases: list[Files] = []
    tried: set[str] = set()
    for words in BEGINNINGS:
        known = set(OPTIONS[words[0]]) - tried
        tried |= known
        for option in sorted(VALUES.keys() & known):
            for value in VALUES[option]:
                asked = [*words, option, *(value.split() if option == "--start" else [value])]
                cases.append(dict(whole) | {"words.json": json.dumps(asked).encode()})
    return cases
