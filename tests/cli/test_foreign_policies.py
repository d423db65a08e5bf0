"""A program as a policy, as a user meets it."""

import json

import pytest

from r3jax.apps.benchmark.record import CELLS
from r3jax.cli.main import main
from tests.cli.small_runs import explore, main_without_report
from tests.planning.foreign.children import HIGHEST, command_of

pytestmark = pytest.mark.full


def test_a_program_explores_goes_on_and_is_submitted(room, tmp_path):
    name = f"exec:{command_of(tmp_path, HIGHEST)}"
    out = tmp_path / "runs"
    assert explore(room, out, "--policy", name) == 0
    assert (
        main_without_report(["explore", "--resume", str(out / "box"), "--budget", "views:4"]) == 0
    )
    it = tmp_path / "it.jsonl"
    assert main(["export", str(out / "box"), "--format", "submission", "--out", str(it)]) == 0
    assert json.loads(it.read_text().splitlines()[0])["policy"]["name"] == name
    assert main(["benchmark", "--submission", str(it), "--check"]) == 0


def test_a_folder_is_called_by_the_script(room, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    words = ["--scene", room, "--policy", f"exec:{command_of(tmp_path, HIGHEST)}"]
    words += ["--budget", "views:1", "--clock", "model", "--resolution", "32"]
    assert main_without_report(["explore", *words]) == 0
    assert (tmp_path / "runs" / "room-program-seed0" / "run.json").exists()


def test_a_program_stands_in_a_table(room, tmp_path, capsys):
    name = f"exec:{command_of(tmp_path, HIGHEST)}"
    words = ["--scenes", room, "--policies", name, "--budget", "views:3", "--clock", "model"]
    words += ["--resolution", "32", "--fov", "90", "--train-resolution", "32", "--iterations", "20"]
    words += ["--gaussians", "200", "--capacity", "400", "--test-views", "6", "--lpips", "none"]
    words += ["--voxel-size", "0.1", "--jobs", "1", "--out", str(tmp_path / "out")]
    assert main(["benchmark", *words]) == 0
    (record,) = map(json.loads, (tmp_path / "out" / CELLS).read_text().splitlines())
    assert record["policy"] == name


@pytest.mark.parametrize(
    ("code", "says"),
    [
        ("receive(); sys.exit('no weights')", "no weights"),
        ("receive(); print('thinking', flush=True)", "standard error"),
    ],
)
def test_a_program_that_fails_gets_one_line_and_the_run_stays(room, tmp_path, capsys, code, says):
    out = tmp_path / "runs"
    assert explore(room, out, "--policy", f"exec:{command_of(tmp_path, code)}") == 2
    told = " ".join(capsys.readouterr().err.split())
    assert says in told
    assert "Traceback" not in told
    rows = (out / "box" / "trace.jsonl").read_text().splitlines()
    assert [json.loads(row)["kind"] for row in rows] == ["step", "end"]
    assert json.loads(rows[-1])["outcome"] == "failed"
