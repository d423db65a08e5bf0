"""Policies of others: registered here, offered by a package, or given as a class."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

import r3jax
from r3jax.cli.main import main
from r3jax.planning import policies, registry
from r3jax.planning.config import PlannerConfig
from r3jax.runs.reader import read_run
from tests.box_room import write_room
from tests.cli.small_runs import explore, main_without_report

PAGE = Path(__file__).resolve().parents[2] / "docs" / "howto/policy.md"
CELL = ["--budget", "views:3", "--clock", "model", "--resolution", "32", "--fov", "90"]
CELL += ["--train-resolution", "32", "--iterations", "20", "--gaussians", "200"]
CELL += ["--capacity", "400", "--test-views", "6", "--lpips", "none", "--voxel-size", "0.1"]


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with the policy of the documentation in `my_policy.py`."""
    code = PAGE.read_text(encoding="utf-8").partition("```python\n")[2].partition("```")[0]
    (tmp_path / "my_policy.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    monkeypatch.setattr(policies, "REGISTERED", {})
    monkeypatch.setattr(registry, "REGISTERED", policies.REGISTERED)
    yield tmp_path
    sys.modules.pop("my_policy", None)


@pytest.fixture
def empty(monkeypatch):
    """Nothing is registered in this process."""
    monkeypatch.setattr(policies, "REGISTERED", {})
    monkeypatch.setattr(registry, "REGISTERED", policies.REGISTERED)


def test_the_page_has_twenty_lines(here):
    lines = [line for line in (here / "my_policy.py").read_text().splitlines() if line.strip()]
    assert len(lines) <= 20


@pytest.mark.full
def test_the_policy_of_the_page_explores_and_goes_on(here, capsys):
    room = write_room(here / "room.ply")
    assert explore(room, here / "runs", "--policy", "my_policy:Highest") == 0
    run = read_run(here / "runs" / "box")
    assert run.header.policy["name"] == "highest"
    assert run.header.policy["class"] == "my_policy:Highest"
    heights = [row.pose[2, 3] for row in run.rows]
    assert heights[1] > heights[0]
    assert main_without_report(["explore", "--resume", str(run.path), "--budget", "views:4"]) == 0
    assert len(read_run(run.path).rows) == 4


@pytest.mark.full
def test_the_policy_of_the_page_is_benchmarked_by_workers(here):
    room = write_room(here / "room.ply")
    program = [sys.executable, "-c", "from r3jax.cli.main import main; raise SystemExit(main())"]
    words = ["--scenes", room, "--policies", "my_policy:Highest,random", "--jobs", "1"]
    done = subprocess.run(
        [*program, "benchmark", *words, *CELL], cwd=here, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert "my_policy:Highest" in done.stdout


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("nowhere.at:All", "nowhere.at"),
        ("my_policy:Lowest", "'Lowest'"),
        ("my_policy:dataclass", "`name`"),
        ("my_policy", "'my_policy'"),
    ],
)
def test_a_class_that_is_not_there_is_told(here, name, says, capsys):
    words = ["--scene", "flat", "--policy", name, "--out", str(here / "runs")]
    assert main(["explore", *words]) == 2
    assert says in " ".join(capsys.readouterr().err.split())
    assert not (here / "runs").exists()


def test_an_installed_package_offers_its_policies(here, monkeypatch):
    monkeypatch.syspath_prepend(here)
    monkeypatch.setattr(policies, "plugins", lambda: {"offered": "my_policy:Highest"})
    assert "offered" in registry.policy_names()
    policies.check_policy("offered")
    assert registry.make_policy("offered", num_candidates=70).config.num_candidates == 70


def test_entry_points_of_the_group_are_found():
    """No package here has any: the group is asked for by the name that the page gives."""
    assert policies.plugins() == {}
    assert f'entry-points."{policies.GROUP}"' in PAGE.read_text(encoding="utf-8")


def test_a_registered_policy_has_settings_of_its_own(empty):
    @dataclass(frozen=True)
    class Settings(PlannerConfig):
        eagerness: float = 0.5

    @r3jax.register_policy
    @dataclass(frozen=True)
    class Eager(r3jax.GreedyPolicy):
        """Is eager."""

        config: Settings = Settings()
        name = "eager"
        source = "a test"
        Config = Settings

        def score(self, situation, candidates, *, key):
            return candidates, {"utility": np.full(len(candidates.valid), self.config.eagerness)}

    assert r3jax.make_policy("eager", eagerness=0.9, lambda2=0.1).config.eagerness == 0.9
    assert registry.describe("eager") == "Is eager."
    with pytest.raises(ValueError, match=r"haste.*eagerness"):
        r3jax.make_policy("eager", haste=1.0)


def test_names_are_not_taken_twice(empty):
    class R3(r3jax.GreedyPolicy):
        name = "r3"

    with pytest.raises(ValueError, match="'r3'"):
        r3jax.register_policy(R3)
    with pytest.raises(ValueError, match="`name`"):
        r3jax.register_policy(dict)


@pytest.mark.parametrize("former", ["ours", "ours-pano", "ours-ahead"])
def test_a_former_name_means_the_same_policy(former):
    name = former.replace("ours", "r3")
    assert type(registry.make_policy(former)) is type(registry.make_policy(name))
    assert registry.make_policy(former).name == name
    assert former not in registry.policy_names()
