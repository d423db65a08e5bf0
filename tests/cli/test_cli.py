"""The command line, as a user meets it: help, mistakes, a run, an interrupt, a recording."""

import json
import os
import subprocess
import sys

import pytest
import trimesh

from r3jax.cli.command_line import COMMANDS, find_command
from r3jax.cli.main import main
from r3jax.cli.options.benchmark import SubmissionOptions
from r3jax.cli.parsing import parse
from r3jax.exploration.config import parse_budget
from r3jax.runs.reader import read_run
from r3jax.runs.writer import RunWriter
from r3jax.simulators.raycast.raycast import RaycastSimulator
from tests.cli.small_runs import explore, main_without_report
from tests.runs.runs import make_header, make_view
from tests.tiers import quick_and_full


@pytest.fixture(scope="module")
def run_folder(room, tmp_path_factory):
    """One finished run."""
    out = tmp_path_factory.mktemp("runs")
    assert explore(room, out, report=True) == 0
    return out / "box"


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_has_what_runs_it(name):
    assert callable(find_command(name))


def test_a_run_leaves_data_set_and_report(run_folder):
    run = read_run(run_folder)
    assert run.end is not None
    assert (run.end.outcome, len(run.rows)) == ("budget", 3)
    assert run.header.policy["settings"]["num_candidates"] == 20
    assert run.header.policy["settings"]["num_frontier"] == 6
    assert len(run.header.scene["hash"]) == 64
    content = json.loads((run_folder / "transforms.json").read_text())
    assert len(content["frames"]) == 3
    cloud = trimesh.load(run_folder / content["ply_file_path"])
    assert len(cloud.vertices) == run.rows[-1].coverage.voxels
    assert (run_folder / "report" / "report.html").stat().st_size > 100_000
    assert [frame.camera.width for frame in run.frames()] == [48] * 3


def test_an_existing_run_is_kept(room, run_folder, capsys):
    before = (run_folder / "trace.jsonl").read_bytes()
    assert explore(room, run_folder.parent) == 2
    assert "--overwrite" in capsys.readouterr().err
    assert (run_folder / "trace.jsonl").read_bytes() == before


@pytest.mark.full
def test_the_model_clock_makes_a_run_repeatable(room, run_folder, tmp_path):
    assert explore(room, tmp_path) == 0
    again = (tmp_path / "box" / "trace.jsonl").read_bytes()
    assert again == (run_folder / "trace.jsonl").read_bytes()


def test_info_tells_what_a_run_did(run_folder, capsys):
    assert main(["info", str(run_folder)]) == 0
    text = capsys.readouterr().out
    assert "budget of 3 views" in text
    assert "planning" in text
    assert "report.html" in text.replace("\n", "")


@pytest.mark.parametrize("words", [["audti", "x"], ["audti", "--help"], ["audti"]])
def test_a_command_that_does_not_exist_gets_the_one_that_was_meant(words, capsys):
    assert main(words) == 2
    told = capsys.readouterr()
    assert "'audti'" in told.err
    assert not told.out


def test_info_lists_what_there_is(capsys):
    assert main(["info"]) == 0
    text = capsys.readouterr().out
    for name in ("flat", "mesh:<file>", "r3-pano", "frontier", "jax", "device"):
        assert name in text


@pytest.mark.full
def test_info_follows_a_recording(shared, tmp_path, capsys):
    plot = tmp_path / "plot.png"
    folder = shared("recordings", "hololens_lounge")
    assert main(["info", str(folder), "--voxel-size", "0.1", "--plot", str(plot)]) == 0
    lines = capsys.readouterr().out.splitlines()
    frames = [line.split() for line in lines if line[:5].strip().isdigit()]
    assert [int(words[0]) for words in frames] == list(range(48))
    assert float(frames[0][1]) == 0.0 < float(frames[20][1]) <= 1.0
    assert plot.read_bytes().startswith(b"\x89PNG")


@pytest.mark.full
def test_ctrl_c_leaves_a_run_that_can_be_read_and_a_report(room, tmp_path, monkeypatch, capsys):
    real, count = RaycastSimulator.render, iter(range(10))

    def render(self, T_world_camera):
        if next(count) == 2:
            raise KeyboardInterrupt
        return real(self, T_world_camera)

    monkeypatch.setattr(RaycastSimulator, "render", render)
    assert explore(room, tmp_path, report=True) == 130
    errors = capsys.readouterr().err
    assert "interrupted" in errors
    assert f"r3jax explore --resume {tmp_path / 'box'}" in errors
    run = read_run(tmp_path / "box")
    assert run.end is not None
    assert (run.end.outcome, len(run.rows)) == ("interrupted", 2)
    assert "interrupted" in (tmp_path / "box" / "report" / "report.html").read_text()


@pytest.mark.parametrize(
    "place",
    quick_and_full(
        ["exploration.loop.start_state", "cli.commands.explore.write_data_set"],
        ["exploration.loop.start_state"],
    ),
)
def test_ctrl_c_names_what_goes_on_at_any_moment(room, tmp_path, monkeypatch, capsys, place):
    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(f"r3jax.{place}", interrupt)
    folder = tmp_path / "a b"
    assert explore(room, folder, "--budget", "views:1") == 130
    last = capsys.readouterr().err.strip().splitlines()[-1]
    assert f"`r3jax explore --resume '{folder / 'box'}'`" in last
    monkeypatch.undo()
    assert main_without_report(["explore", "--resume", str(folder / "box")]) == 0
    assert len(read_run(folder / "box").rows) == 1


@pytest.mark.full
def test_the_demo_overwrites_its_own_folder_only(tmp_path):
    for name in ("demo", "other"):
        with RunWriter(tmp_path / name, make_header()) as writer:
            writer.add(*make_view(0))
    short = {"views": 4, "resolution": 48, "iterations": 20, "train-resolution": 32}
    words = [word for name, value in short.items() for word in (f"--{name}", str(value))]
    assert main(["demo", "--out", str(tmp_path), *words]) == 0
    demo = read_run(tmp_path / "demo")
    assert (demo.header.scene["name"], demo.header.policy["name"]) == ("flat", "r3-pano")
    assert sum(not row.captured for row in demo.rows) == 4
    assert demo.header.config["capture_every"] == 0.3
    assert "PSNR" in (tmp_path / "demo" / "report" / "report.html").read_text()
    assert read_run(tmp_path / "other").header == make_header()


@pytest.mark.parametrize("name", quick_and_full(COMMANDS, ["explore", "audit"]))
def test_help_begins_with_examples_that_parse_and_shows_no_default_of_none(
    name, capsys, monkeypatch
):
    with pytest.raises(SystemExit):
        main([name, "--help"])
    said = capsys.readouterr().out
    assert "None" not in said
    examples = [line.split() for line in said.splitlines() if line.startswith("    r3jax ")]
    assert examples
    # What the examples name is not there.
    monkeypatch.setattr(COMMANDS[name], "__post_init__", lambda self: None, raising=False)
    monkeypatch.setattr("r3jax.cli.options.explore.check_run", lambda path: None)
    monkeypatch.setattr(SubmissionOptions, "__post_init__", lambda self: None)
    for program, *words in examples:
        assert (program, words[0]) == ("r3jax", name)
        assert isinstance(parse(COMMANDS, words, ""), COMMANDS[name])


@pytest.mark.parametrize("words", [["--help"], ["explore", "--help"], ["info", "--help"]])
def test_help_reads_well_and_waits_for_nothing_heavy(words):
    program = (
        "import sys\nfrom r3jax.cli import main\n"
        f"try:\n    main({words})\nexcept SystemExit as done:\n    assert done.code == 0\n"
        "heavy = {'matplotlib', 'skimage', 'trimesh', 'orbax', 'scipy'} & set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "--budget" in done.stdout or words[0] != "explore"
    assert max(len(line) for line in done.stdout.splitlines()) <= 200


def test_output_that_nobody_reads_is_no_traceback():
    program = "import sys\nfrom r3jax.cli import main\nsys.exit(main(['audit', '--help']))"
    reader, writer = os.pipe()
    os.close(reader)
    done = subprocess.run([sys.executable, "-c", program], stdout=writer, stderr=subprocess.PIPE)
    os.close(writer)
    assert (done.returncode, done.stderr) == (141, b"")


def test_progress_says_what_is_happening():
    import io

    from r3jax.cli.console import Console, RunProgress

    terminal = Console(file=io.StringIO(), force_terminal=True, width=160)
    with RunProgress(terminal, parse_budget("views:4")) as progress:
        progress.on_stage("render")
        progress.on_row(make_view(0)[0])
        progress.on_stage("plan")
        progress._bar.refresh()
    text = terminal.file.getvalue()
    assert "view 2/4: planning" in text
    assert "% explored" in text
    log = Console(file=io.StringIO(), force_terminal=False)
    with RunProgress(log, parse_budget("views:1000")) as progress:
        for step in range(50):
            progress.on_row(make_view(step)[0])
    assert 1 <= len(log.file.getvalue().splitlines()) <= 11


def test_the_demo_explores_before_anything_asks_for_its_run(tmp_path, monkeypatch):
    from r3jax.cli.commands import explore
    from r3jax.cli.options.explore import DemoOptions

    explored = []
    monkeypatch.setattr(explore, "run_explore", lambda options: explored.append(options) or 3)
    assert explore.run_demo(DemoOptions(out=tmp_path)) == 3  # a run that fails is not trained on
    assert explored[0].folder.name == "demo"
    assert not (tmp_path / "demo").exists()
