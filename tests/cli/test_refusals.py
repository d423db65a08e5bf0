"""Command lines that are refused: in one line that names the fact or the remedy, leaving nothing.

Most are refused before JAX is imported; others only once a scene or a capture is opened.
"""

import contextlib
import json
import subprocess
import sys

import pytest
from PIL import Image

from r3jax.cli.command_line import COMMANDS
from r3jax.cli.commands.explore import run_settings
from r3jax.cli.main import main
from r3jax.cli.options.explore import ExploreOptions, MotionOptions
from r3jax.cli.parsing import flat, parse, whole_number
from r3jax.errors import InputError
from r3jax.exploration.config import ExplorationConfig
from r3jax.files import MARKER
from r3jax.runs.writer import RunWriter
from tests.runs.runs import make_header
from tests.tiers import quick_and_full

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
    "explore --scene mesh:": "mesh:",
    "explore --scene flat --scale 0.1": "mesh",
    "explore --scene replica:office0 --scale 0.1": "mesh",
    "explore --scene flat --policy exec:": "exec:",
    "explore --scene flat --policy exec:no-such-program": "no-such-program",
    "explore --scene flat --resolution 3": "--resolution",
    "explore --scene flat --voxel-size -1": "voxel_size",
    "explore --scene flat --max-range 5000": "13.1 m",
    "explore --scene flat --seed 9223372036854775808": "--seed",
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
    "team --scene flat --cameras 0": "--cameras",
    "team --scene flat --meet-every -1": "--meet-every",
    "team --resume run": "no such folder",
    "benchmark --scenes flat,ofice": "office",
    "benchmark --policies r3,cvoer": "cover",
    "benchmark --photos captures/lounge": "r3jax select",
    "benchmark --sweep lambda2": "lambda2",
    "benchmark --sweep lambda2=0.2,0.2": "lambda2",
    "benchmark --sweep lambda2=0.2 --sweep lambda2=0.3": "lambda2",
    "benchmark --sweep radius=1 --settings radius=2": "radius",
    "benchmark --seeds 0,x": "--seeds",
    "benchmark --seeds 0,-1": "got -1",
    f"benchmark --seeds 0,{1 << 31}": "got 2147483648",
    "benchmark --submission runs --check": "this is a folder",
    "benchmark --submission nowhere.jsonl": "nowhere.jsonl",
    "benchmark --check": "--submission FILE",
    "benchmark --submission scan.ply --budget views:9": "--budget",
    "benchmark --submission scan.ply --policies r3": "--policies",
    "benchmark --submission scan.ply --scenes office": "mesh:<file>",
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
    "audit nowhere": "nowhere",
    "audit nowhere.zip": "such file",
    "audit runs --path nowhere.json": "nowhere.json",
    "audit runs --out scan.ply": "scan.ply",
    "audit runs --voxel-size 0": "--voxel-size",
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
    "view nowhere": "nowhere",
    "view runs --name other": "--name",
    "view runs --export other": "--export",
    "view runs/run --video": "--export",
    "view runs/run --name ../other": "--name",
    "select runs --frames 3 --share 0.5": "--share",
    "select runs --frames 0": "--frames",
    "select runs --gain 1.5": "--gain",
    "forecast nowhere": "nowhere",
    "info nowhere": "nowhere",
    "demo --views 0": "views",
}
"""Command lines, and the fact or the remedy that their refusal names."""


def test_names_budgets_and_paths_are_refused_before_jax_is_imported(tmp_path):
    with RunWriter(tmp_path / "runs" / "run", make_header()):
        pass
    for name in ("scan.mp4", "scan.ply", "scan.r3d"):
        (tmp_path / name).touch()
    before = sorted(tmp_path.rglob("*"))
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
    assert sorted(tmp_path.rglob("*")) == before


SHORT = "--train-resolution 32 --iterations 30 --gaussians 200 --capacity 400 --test-views 6"
ON_ROOM = f"benchmark --scenes {{room}} --resolution 32 --lpips none --jobs 0 {SHORT}"

REFUSED_LATER = {
    "explore --scene {room} --start 50 0 0": "50",
    "explore --scene {room} --scale 0": "scale",
    "explore --scene {room} --scale nan": "scale",
    "explore --scene {room} --capacity 1099511627776": "capacity",
    "explore --scene {room} --cell-size 1e-300": "cell_size",
    "team --scene {room} --start 50 0 0": "50",
    f"{ON_ROOM} --sweep lambda2=0.2,much": "lambda2",
    f"{ON_ROOM} --reference nobody": "--reference",
    f"{ON_ROOM} --scenes ,": "no scenes",
    f"{ON_ROOM} --seeds 1,1": "1, 1",
    f"{ON_ROOM} --snapshots views:99": "views:99",
    f"{ON_ROOM} --train-resolution 64": "train_resolution 64",
    f"{ON_ROOM} --test-views 3": "max_views",
    f"{ON_ROOM} --settings num_candidates=many": "num_candidates",
    f"{ON_ROOM} --settings nothing=1": "nothing",
    f"{ON_ROOM} --settings scoring.kappa=ball": "kappa",
    "train {recording} --hold-out 1": "hold out nothing",
    "train {recording} --iterations 0": "iterations",
    "train {recording} --views-per-step 1000000000": "2^31",
    "train {recording} --gaussians 300 --capacity 10": "capacity 10",
    "train {recording} --gaussians 1000000000": "GB",
    "train {empty}": "{empty}",
    "info {empty}": "{empty}",
    "audit {empty}": "{empty}",
    "audit {recording} --out {photos}": "--out",
    "audit {recording} --voxel-size 1e-7": "voxels along an axis",
    "audit {recording} --voxel-size 30": "--voxel-size",
    "view {empty}": "{empty}",
    "select {recording} --keep nobody.png": "nobody.png",
    "select {recording} --targets no_such_file.json": "no_such_file.json",
    "select {photos} --frames 2": "{photos}",
}
"""The same of command lines that open a scene or a capture first."""


@pytest.mark.full
@pytest.mark.parametrize("words", REFUSED_LATER)
def test_what_a_scene_or_a_capture_cannot_do_is_refused(
    words, room, captures, tmp_path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    empty, photos = tmp_path / "empty", tmp_path / "photos"
    for folder in (empty, photos):
        folder.mkdir()
    Image.new("RGB", (32, 24)).save(photos / "a.png")
    places = {"room": room, "recording": captures / "recording", "empty": empty, "photos": photos}
    assert main(words.format(**places).split()) == 2
    told = capsys.readouterr().err.strip().splitlines()[-1]
    assert told.startswith("r3jax: ")
    assert REFUSED_LATER[words].format(**places) in told
    left = [path for path in tmp_path.rglob("*") if path.is_file() and MARKER not in path.parts]
    assert [path for path in left if path.name != "lock"] == [photos / "a.png"]


ODD = {
    "--seed": ("-1", "9223372036854775808", "4294967296"),
    "--max-range": ("nan", "-1", "0", "inf", "1e308", "1e-300"),
    "--resolution": ("-1", "0", "1000000000"),
    "--voxel-size": ("nan", "0", "-1", "1e-300", "1e308"),
    "--cell-size": ("nan", "0", "-1"),
    "--capacity": ("0", "-1", "3"),
    "--name": ("../../x", "a/../../../x", "", ".", "..", "x" * 300),
    "--budget": ("views:1e30", "views:nan", "seconds:1e308", "views:9223372036854775808"),
    "--hold-out": ("-1",),
    "--worst": ("-1", "1000000000000"),
    "--jobs": ("-1",),
}
"""Values of options that people seldom mean."""


@pytest.mark.parametrize(
    "words",
    quick_and_full(
        ["explore --scene flat", "train run", "evaluate run", "benchmark"], ["train run"]
    ),
)
def test_odd_values_of_options_are_taken_or_refused(words, tmp_path, monkeypatch):
    """By the refusals of the options, never by another error."""
    monkeypatch.chdir(tmp_path)
    with RunWriter(tmp_path / "run", make_header()):
        pass
    command, *words = words.split()
    only, refused = {command: COMMANDS[command]}, 0  # one command is quickly read, without its name
    known = {f"--{field.name.replace('_', '-')}" for field, _ in flat(parse(only, words, ""))}
    for option in known & ODD.keys():
        for value in ODD[option]:
            with contextlib.suppress(InputError, SystemExit):
                refused += 1
                parse(only, [*words, f"{option}={value}"], "")
                refused -= 1
    assert refused >= 4


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
