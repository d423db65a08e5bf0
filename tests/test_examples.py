"""The examples run as a reader would run them."""

import importlib.util
import re
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import r3jax

pytestmark = pytest.mark.full

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_a_slam_stream_is_planned_for_and_mapped_again_when_its_poses_change(capsys):
    frames = load("slam_stream").main(views=7, size=64)
    lines = capsys.readouterr().out.splitlines()
    assert len(frames) == len(lines) == 7
    number = lambda line, what: int(re.search(what, line).group(1))
    mapped = [number(line, r"(\d+) frame") for line in lines]
    assert mapped == [1, 1, 1, 1, 1, 6, 1]  # the loop is closed at the sixth view
    rows = [number(line, r"in (\d+) rows") for line in lines]
    assert rows[-1] > rows[0] == 1 << 14, "the map did not grow"
    assert all("moved" in line for line in lines)
    before = load("slam_stream").main(views=5, size=64)
    sunk = [a.position[2] - b.position[2] for a, b in zip(before, frames[:5], strict=True)]
    np.testing.assert_allclose(sunk, 0.01 * np.arange(5), atol=1e-5)


def test_a_planar_robot_keeps_out_of_the_zone_and_its_map_is_saved(tmp_path):
    robot = load("planar_robot")
    track = np.array(robot.main(decisions=10, size=64, saved=tmp_path / "map"))
    (low, _, high, _), body = np.array(robot.ZONE), 0.2
    is_inside = np.all((track[:, :2] > low - body) & (track[:, :2] < high + body), axis=1)
    assert not is_inside.any()
    assert len(track) == 11
    assert np.linalg.norm(np.diff(track, axis=0), axis=1).sum() > 2.0
    assert int(r3jax.load(tmp_path / "map").map_state.num_occupied) > 1000


class Trial:
    """As much of Optuna's trial as the example uses."""

    def suggest_float(self, name, low, high, log):
        return low if name == "lambda2" else high

    def suggest_int(self, name, low, high):
        return low


def test_a_trial_of_a_search_is_the_mean_of_its_cells(tmp_path):
    terms = "--scenes flat --budget views:3 --clock model --resolution 32 --train-resolution 32"
    terms += " --iterations 20 --gaussians 200 --capacity 400 --test-views 6 --lpips none --jobs 0"
    search = load("optuna_search")
    found = search.objective(Trial(), terms.split(), tmp_path)
    (record,) = r3jax.read_records(tmp_path)
    assert record["settings"] == {"lambda2": 0.1, "num_candidates": 40}
    assert found == record["metrics"]["psnr"]["mean"]
    assert search.objective(Trial(), terms.split(), tmp_path) == found  # nothing is done twice
