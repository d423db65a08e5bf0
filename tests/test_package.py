"""The package as it is installed: one version, files that it needs, and a wheel that runs."""

import os
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import r3jax

ROOT = Path(__file__).resolve().parents[1]


def test_the_version_stands_in_one_place():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))
    assert "version" not in project["project"]
    citation = (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"\nversion: {r3jax.__version__}\n" in citation
    assert f"## {r3jax.__version__}\n" in (ROOT / "CHANGELOG.md").read_text("utf-8")


@pytest.mark.full
def test_wheel_and_source_install_and_run_in_an_empty_environment(tmp_path):
    command = [
        sys.executable,
        "-m",
        "build",
        "--no-isolation",
        "--outdir",
        str(tmp_path),
        str(ROOT),
    ]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    (wheel,), (source,) = tmp_path.glob("*.whl"), tmp_path.glob("*.tar.gz")

    names = zipfile.ZipFile(wheel).namelist()
    for needed in ("py.typed", "__init__.pyi", "apps/forecast/calibration.json"):
        assert f"r3jax/{needed}" in names
    assert not any(name.startswith(("tests/", "experiments/")) for name in names)
    with tarfile.open(source) as archive:
        assert any(name.endswith("r3jax/py.typed") for name in archive.getnames())

    for what in (wheel, source):
        folder = tmp_path / what.suffix[1:]
        # Its own package, the libraries of this environment: an index may be out of reach.
        venv.create(folder, with_pip=False, symlinks=True)
        site = next(folder.glob("lib/python*/site-packages"))
        (site / "libraries.pth").write_text("\n".join(p for p in sys.path if "site-packages" in p))
        install = [
            sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation",
            "--target", str(site), str(what),
        ]  # fmt: skip
        subprocess.run(install, check=True, capture_output=True)
        python = str(folder / "bin" / "python")
        outside = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
        program = "import r3jax; print(r3jax.__version__, r3jax.__file__)"
        said = subprocess.run(
            [python, "-c", program],
            capture_output=True, text=True, check=True, cwd=tmp_path, env=outside,
        ).stdout.split()  # fmt: skip
        assert said[0] == r3jax.__version__
        assert Path(said[1]).is_relative_to(folder)
        help_text = subprocess.run(
            [python, "-m", "r3jax", "policies"],
            capture_output=True, text=True, check=True, cwd=tmp_path, env=outside,
        )  # fmt: skip
        assert "frontier" in help_text.stdout
