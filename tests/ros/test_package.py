"""The ROS 2 package installs with all that `ros2 run` and `ros2 launch` look for."""

import importlib.util
import os
import shutil
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from importlib.metadata import distributions

import pytest

from tests.ros.stubs import PACKAGE

pytestmark = pytest.mark.full


@pytest.mark.skipif(importlib.util.find_spec("pip") is None, reason="no pip in this Python")
def test_it_installs_without_colcon(tmp_path):
    copy, target = tmp_path / "source", tmp_path / "target"
    shutil.copytree(PACKAGE, copy)  # pip leaves a build folder there
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation"]
    subprocess.run([*pip, "--target", target, copy], check=True, capture_output=True)
    share = target / "share" / "r3jax_ros"
    for name in ("config/r3jax.yaml", "launch/r3jax.launch.py", "rviz/r3jax.rviz", "package.xml"):
        assert (share / name).read_bytes() == (PACKAGE / name).read_bytes()
    assert (target / "share/ament_index/resource_index/packages/r3jax_ros").is_file()
    modules = {path.name for path in (target / "r3jax_ros").glob("*.py")}
    assert modules == {path.name for path in (PACKAGE / "r3jax_ros").glob("*.py")}

    (found,) = distributions(path=[str(target)])
    assert found.version == ElementTree.parse(PACKAGE / "package.xml").findtext("version")
    (script,) = found.entry_points
    assert f'executable="{script.name}"' in (share / "launch/r3jax.launch.py").read_text()
    # The command starts, and says which modules of ROS are missing.
    ran = subprocess.run(
        [sys.executable, target / "bin" / script.name], capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(target)},
    )  # fmt: skip
    if importlib.util.find_spec("rclpy") is None:
        assert ran.returncode == 1
        assert ran.stderr.startswith("r3jax_ros: rclpy")
