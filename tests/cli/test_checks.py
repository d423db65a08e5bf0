"""What is refused before JAX is imported, and in which words."""

import json
import subprocess
import sys

import pytest

from r3jax.cli.commands.explore import run_settings
from r3jax.cli.main import main
from r3jax.cli.options.explore import ExploreOptions, MotionOptions
from r3jax.cli.parsing import whole_number
from r3jax.errors import InputError
from r3jax.exploration.config import ExplorationConfig
from r3jax.runs.writer import RunWriter
from tests.runs.runs import make_header

REFUSED = {
    "explore --scene apartement": "apartment",
    "explore --scene house.glb": "mesh:house.glb",
    "explore --scene mash:house.glb": "mesh:house.glb",
    "explore --scene mesh:nowhere.glb": "nowhere.glb",
    "explore --scene habitat:nowhere.glb": "nowhere.glb",
    "explore --scene flat --policy our-pano": "r3-pano",
    "explore --scene flat --budget hours:1": "views:100",
    "explore --scene flat --budget frames:1.5": "frames:100",
    "explore --scene flat --until psnr": "psnr",
    "explore --scene flat --name a/b": "--name",
    "explore --scene flat --name run": "--overwrite",
    "explore --scene flat --heights 1 2": "heights 1 to 2 m",
    "explore --scene flat --speed 0": "speed",
    "explore --scene flat --gaze ahead": "--gaze",
    "explore --scene flat --gaze up": "panorama",
    "explore --scene flat --exposure 0.01": "--exposure",
    "explore --scene flat --blur 2": "--capture-every",
    "explore --scene flat --capture-every 0.3 --blur 2": "--exposure",
    "explore --scene flat --capture-rate 21": "20 Hz",
    "explore --scene flat --capture-rate 11 --motion ground": "10 Hz",
    "explore --scene flat --speed 1e-310": "0.001",
    "explore --scene flat --voxel-size 5": "voxel_size",
    "explore --scene flat --capacity 1000": "power of two",
    "explore --resume nowhere": "nowhere",
    "explore --fork run": "--at",
    "team --scene ofice": "office",
    "team --scene flat --policy r3 fronteer": "frontier",
    "team --scene flat --cameras 3 --fov 60 90": "--fov",
    "team --resume run": "no such folder",
    "benchmark --scenes flat,ofice": "office",
    "benchmark --policies r3,cvoer": "cover",
    "benchmark --seeds 0,-1": "got -1",
    f"benchmark --seeds 0,{1 << 31}": "got 2147483648",
    "benchmark --submission runs --check": "this is a folder",
    "benchmark --site page --seeds 1": "--seeds",
    "benchmark --jobs -1": "--jobs",
    "benchmark --slurm time": "--slurm",
    "benchmark --snapshots views:x": "'x'",
    "train nowhere": "nowhere",
    "train runs --resolution 3": "--resolution",
    "evaluate runs --name ../x": "--name",
    "evaluate runs --worst -1": "--worst",
    "audit scan.mp4": "ns-process-data video",
    "audit scan.ply": "scan.ply",
    "audit runs --live --path scan.ply": "--path",
    "audit runs --folds 1": "--folds",
    "audit scan.r3d --live": "--live",
    "audit /camera/color --live": "r3jax_ros",
    "audit runs --port 9000": "--live",
    "audit runs --live --port 99999": "--port",
    "audit runs --live --depth-scale 2": "--depth-scale",
    "replay runs": "runs",
    "merge runs/run nowhere": "nowhere",
    "merge runs/run runs/run": "runs/run",
    "export runs/run --out runs": "runs",
    "view runs/run --video": "--export",
    "info nowhere": "nowhere",
    "demo --views 0": "views",
}
"""Command lines, and the fact or the remedy that their refusal names."""


def test_names_budgets_and_paths_are_refused_before_jax_is_imported(tmp_path):
    with RunWriter(tmp_path / "runs" / "run", make_header()):
        pass
    for name in ("scan.mp4", "scan.ply", "scan.r3d"):
        (tmp_path / name).touch()
    program = (
        "import json, sys\n"
        "from r3jax.cli.main import main\n"
        "for words in json.load(sys.stdin):\n"
        "    assert main(words.split()) == 2, words\n"
        "heavy = {'jax', 'trimesh', 'equinox', 'scipy', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", program],
        input=json.dumps(list(REFUSED)),
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr
    lines = done.stderr.splitlines()
    assert len(lines) == len(REFUSED)
    for line, words in zip(lines, REFUSED.values(), strict=True):
        assert line.startswith("r3jax: ")
        assert words in line


def test_the_largest_capture_rate_is_one_frame_every_voxel():
    """0.7 / 0.05 is a little less than 14."""
    slow = MotionOptions(speed=0.7)
    ExploreOptions(scene="flat", robot=slow, loop=ExplorationConfig(capture_rate=14.0))
    with pytest.raises(ValueError, match="at most 14 Hz"):
        ExploreOptions(scene="flat", robot=slow, loop=ExplorationConfig(capture_rate=14.1))


def test_a_map_that_may_grow_begins_with_room():
    def rows(capacity, **given):
        loop = ExplorationConfig(capacity=capacity)
        return run_settings(ExploreOptions(scene="flat", loop=loop, **given)).config.capacity

    assert rows(2) == 1 << 14
    assert rows(2, fixed_capacity=True) == 2
    assert rows(1 << 15) == 1 << 15


@pytest.mark.parametrize(
    ("text", "number"), [("1e5", 100_000), ("512", 512), ("-3", -3), ("2.0", 2), ("50_000", 50_000)]
)
def test_whole_numbers_may_be_written_as_people_do(text, number):
    assert whole_number(text) == number


@pytest.mark.parametrize("text", ["512x512", "1.5", "", "nan", "inf", "1e999999999", "0x10"])
def test_what_is_no_whole_number_is_said_so(text):
    with pytest.raises(InputError):
        whole_number(text)


def test_a_number_that_cannot_be_read_is_told_in_words(capsys):
    for words in (["--resolution", "512x512"], ["--iterations", "a"]):
        with pytest.raises(SystemExit) as stopped:
            main(["train", "run", *words])
        assert stopped.value.code == 2
        said = capsys.readouterr().err
        assert "expects one whole number" in said
        assert "int" not in said.replace("INT", "")


def test_the_version_is_told(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("r3jax ")
