"""What `pip install r3jax` has without extras, and which extra an error names."""

import subprocess
import sys
import textwrap
import tomllib
from pathlib import Path

import pytest

from r3jax.extras import EXTRAS

ROOT = Path(__file__).resolve().parents[1]

BLOCKED = f"import sys; sys.modules |= dict.fromkeys({sorted(EXTRAS)!r})\n"
"""Makes the packages of the extras as good as not installed."""


def run(program: str) -> subprocess.CompletedProcess[str]:
    words = [sys.executable, "-c", BLOCKED + textwrap.dedent(program)]
    return subprocess.run(words, capture_output=True, text=True, timeout=300)


def test_the_planner_needs_no_extra():
    done = run(
        """
        import jax, numpy as np, r3jax
        camera = r3jax.Camera.from_fov(16, 16)
        pose = r3jax.look_at([0.5, 0.5, 1.0], [2.0, 0.5, 1.0])
        planner = r3jax.start(camera, ([0, 0, 0], [4, 3, 2]), "r3", starts=[pose])
        rgb, depth = np.zeros((16, 16, 3), np.uint8), np.full((16, 16), 2.0, np.float32)
        planner = r3jax.observe(planner, r3jax.Frame.from_arrays(rgb, depth, pose, camera))
        decision, planner, info = r3jax.decide(planner, pose, jax.random.key(0))
        print("decided", info.outcome)
        """
    )
    assert "decided" in done.stdout, done.stderr[-2000:]


@pytest.mark.parametrize(
    ("call", "extra"), [("r3jax.open_scene('flat')", "sim"), ("r3jax.fit", "splats")]
)
def test_an_error_names_the_extra(call, extra):
    done = run(f"import r3jax; {call}")
    assert f"r3jax[{extra}]" in done.stderr.splitlines()[-1]


def test_a_command_names_the_extra(tmp_path):
    program = f"from r3jax.cli import main; sys.exit(main(['train', {str(tmp_path)!r}]))"
    done = run(program)
    assert done.returncode == 2
    assert "r3jax[splats]" in done.stderr
    assert "Traceback" not in done.stderr


def test_every_named_extra_installs_its_package():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"][
        "optional-dependencies"
    ]
    for package, extra in EXTRAS.items():
        assert any(requirement.startswith(package) for requirement in extras[extra])
        assert any(extra in requirement for requirement in extras["all"])
