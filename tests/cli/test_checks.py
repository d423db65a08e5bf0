"""What is refused before JAX is imported, and in which words."""

import json
import subprocess
import sys

import pytest

from r3jax.cli.checks import check_options, loop_of_options
from r3jax.cli.errors import UserError
from r3jax.cli.main import main
from r3jax.cli.options import ExploreOptions
from r3jax.cli.options.parsing import whole_number
from r3jax.runs.writer import RunWriter
from tests.runs.runs import make_header

REFUSED = {
    "explore --scene apartement": "did you mean apartment?",
    "explore --scene house.glb": "did you mean mesh:house.glb?",
    "explore --scene mash:house.glb": "did you mean mesh:house.glb?",
    "explore --scene mesh:nowhere.glb": "no such mesh file: nowhere.glb",
    "explore --scene habitat:nowhere.glb": "no such file for Habitat: nowhere.glb",
    "explore --scene flat --policy our-pano": "did you mean ours-pano?",
    "explore --scene flat --budget hours:1": "use views:100, seconds:300 or meters:25",
    "explore --scene flat --budget frames:1.5": "frames:100",
    "explore --scene flat --until psnr": "is not understood",
    "explore --scene flat --name a/b": "--name is the name of one folder",
    "explore --scene flat --name run": "the run exists already",
    "explore --scene flat --heights 1 2": "heights 1 to 2 m above the start leave out the start",
    "explore --scene flat --speed 0": "speed must be positive",
    "explore --scene flat --gaze ahead": "--gaze is for frames on the way: add --capture-every",
    "explore --scene flat --exposure 0.01": "--exposure is for frames on the way",
    "explore --scene flat --blur 2": "--blur is for frames on the way",
    "explore --scene flat --capture-every 0.3 --blur 2": "add --exposure, or leave it out",
    "explore --scene flat --capture-rate 21": "at most 20 Hz at this speed",
    "explore --scene flat --capture-rate 11 --motion ground": "at most 10 Hz at this speed",
    "explore --scene flat --speed 1e-310": "speed must be positive and finite, at least 0.001",
    "explore --resume nowhere": "nowhere: there is no such folder",
    "explore --fork run": "--fork RUN and --at FRAME belong together",
    "team --scene ofice": "did you mean office?",
    "team --scene flat --policy ours fronteer": "did you mean frontier?",
    "team --resume run": "there is no such folder",
    "benchmark --scenes flat,ofice": "did you mean office?",
    "benchmark --policies ours,cvoer": "did you mean cover?",
    "benchmark --seeds 0,-1": "--seeds must lie between 0 and 2^31 - 1, got -1",
    f"benchmark --seeds 0,{1 << 31}": "--seeds must lie between 0 and 2^31 - 1, got 2147483648",
    "benchmark --submission runs --check": "runs: this is a folder; a submission is a file",
    "benchmark --snapshots views:x": "'x' is not a number",
    "train nowhere": "nowhere: there is no such folder",
    "train runs --resolution 3": "--resolution must be at least 16",
    "evaluate runs --name ../x": "--name is the name of one folder",
    "audit scan.mp4": "scan.mp4: this is a video without poses: ns-process-data video",
    "audit scan.ply": "scan.ply: this is a file; a capture is a folder",
    "audit runs --live --path scan.ply": "--live follows a capture, --path judges a path",
    "audit scan.r3d --live": "a file that does not grow",
    "audit /camera/color --live": "no such capture, and no folder in which it could be recorded",
    "audit runs --port 9000": "--port and --host are for the page of --live",
    "audit runs --live --port 99999": "--port must lie between 0 and 65535",
    "replay runs": "runs: this folder is not a run",
    "merge runs/run nowhere": "nowhere: there is no such folder",
    "info nowhere": "nowhere: there is no such folder",
    "demo --views 0": "must be positive",
}


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
    check_options(ExploreOptions(scene="flat", name="none", speed=0.7, capture_rate=14.0))
    with pytest.raises(UserError, match="at most 14 Hz"):
        check_options(ExploreOptions(scene="flat", name="none", speed=0.7, capture_rate=14.1))


def test_a_map_that_may_grow_begins_with_room():
    assert loop_of_options(ExploreOptions(capacity=2)).capacity == 1 << 14
    assert loop_of_options(ExploreOptions(capacity=2, fixed_capacity=True)).capacity == 2
    assert loop_of_options(ExploreOptions(capacity=1 << 15)).capacity == 1 << 15
    with pytest.raises(ValueError, match="power of two"):
        loop_of_options(ExploreOptions(capacity=1000))


@pytest.mark.parametrize(
    ("text", "number"), [("1e5", 100_000), ("512", 512), ("-3", -3), ("2.0", 2), ("50_000", 50_000)]
)
def test_whole_numbers_may_be_written_as_people_do(text, number):
    assert whole_number(text) == number


@pytest.mark.parametrize("text", ["512x512", "1.5", "", "nan", "inf", "1e999999999", "0x10"])
def test_what_is_no_whole_number_is_said_so(text):
    with pytest.raises(ValueError, match="it takes one whole number"):
        whole_number(text)


def test_a_number_that_cannot_be_read_is_told_in_words(capsys):
    for words in (["--resolution", "512x512"], ["--iterations", "a"]):
        with pytest.raises(SystemExit) as stopped:
            main(["train", "run", *words])
        assert stopped.value.code == 2
        said = capsys.readouterr().err
        assert "it takes one whole number" in said
        assert "int" not in said.replace("INT", "")


def test_the_version_is_told(capsys):
    assert main(["--version"]) == 0
    assert capsys.readouterr().out.startswith("r3jax ")
