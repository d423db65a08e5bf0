"""Scenes in other units, or without any space: said in a line, before there is a folder."""

import json
import re
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from r3jax.runs.reader import read_run
from r3jax.runs.settings import open_run_scene
from r3jax.simulators.scenes.registry import open_scene, scene_hash
from tests.box_room import write_room
from tests.cli.small_runs import explore


def house(scale):
    box = trimesh.creation.box(extents=np.array([10.0, 8.0, 3.0]) * scale)
    box.invert()
    return box


def triangle(corners):
    return trimesh.Trimesh(corners, [[0, 1, 2]], process=False)


def plane():
    return trimesh.Trimesh([[0, 0, 0], [6, 0, 0], [6, 4, 0], [0, 4, 0]], [[0, 1, 2], [0, 2, 3]])


ODD = {
    "tiny": (lambda: house(4e-4), r"0\.004 x 0\.0032 x 0\.0012 m large: too small.*--scale 1000"),
    "triangle": (
        lambda: triangle([[0, 0, 0], [4, 0, 0], [0, 3, 0]]),
        "4 x 3 x 0 m",
    ),
    "plane": (plane, "6 x 4 x 0 m"),
    "millimeters": (
        lambda: house(1000.0),
        r"10000 x 8000 x 3000 m large: .* cells of 0.2 m.*in millimeters, give --scale 0.001",
    ),
    "centimeters": (lambda: house(100.0), "in centimeters, give --scale 0.01"),
    "countries": (lambda: house(9e3), "is in millimeters"),
}


COMMANDS = (("explore", "--scene"), ("team", "--scene"), ("benchmark", "--jobs", "0", "--scenes"))

PROGRAM = """
import json, sys
from r3jax.cli.main import main
for words in json.load(sys.stdin):
    print(main(words), file=sys.stderr, flush=True)
"""
"""The type checks of the tests ask a scene for its start, which these have not: so one process
without them runs all commands."""


def test_an_odd_world_is_refused_in_a_line_and_leaves_no_folder(tmp_path):
    out = tmp_path / "runs"
    for name, (make, _) in ODD.items():
        make().export(tmp_path / f"{name}.ply")
    cases = [(command, name) for command in COMMANDS for name in ODD]
    words = [[*c, f"mesh:{tmp_path}/{name}.ply", "--out", str(out)] for c, name in cases]
    program = [sys.executable, "-c", PROGRAM]
    done = subprocess.run(program, input=json.dumps(words), capture_output=True, text=True)
    said = [line for line in done.stderr.splitlines() if "opening" not in line]
    assert len(said) == 2 * len(cases), done.stderr
    for (command, name), line, code in zip(cases, said[::2], said[1::2], strict=True):
        assert code == "2", (command, name, line)
        assert re.search(ODD[name][1], line), (command, name, line)
    assert list(out.rglob("*")) == []


@pytest.mark.full
def test_a_recorded_run_opens_its_scene_at_its_scale(tmp_path):
    meters = write_room(tmp_path / "room.ply")
    path = tmp_path / "millimeters.ply"
    mesh = trimesh.load(meters.removeprefix("mesh:"), process=False)
    mesh.vertices = np.asarray(mesh.vertices) * 1000.0
    mesh.export(path)
    assert explore(f"mesh:{path}", tmp_path, "--scale", "0.001", "--cull-backfaces") == 0
    run = read_run(tmp_path / "box")
    scene = run.header.scene
    assert (scene["scale"], scene["cull_backfaces"]) == (0.001, True)
    np.testing.assert_allclose(np.ptp(run.header.bounds, axis=0), [4.0, 3.0, 2.4], atol=1e-6)
    assert open_run_scene(run).bounds.tolist() == run.header.bounds  # and it has the same hash
    plain = open_scene(meters)
    older = {name: scene[name] for name in ("up", "noise", "max_range", "start")}
    scene.clear()  # headers did not always say the scale
    scene.update(older, name=meters, hash=scene_hash(plain))
    np.testing.assert_array_equal(open_run_scene(run).bounds, plain.bounds)
