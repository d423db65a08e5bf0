"""What is measured is the real thing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.full

FOLDER = Path(__file__).parent


def test_large_sizes_are_measured():
    """Without --benchmark-enable they are left out, which once held with it too."""
    command = [sys.executable, "-m", "pytest", str(FOLDER), "--collect-only", "--benchmark-enable"]
    # As part of a parallel run the plugin measures nothing and warns, which is an error here.
    alone = {key: value for key, value in os.environ.items() if not key.startswith("PYTEST_XDIST")}
    done = subprocess.run(
        command, cwd=FOLDER.parents[1], env=alone, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stdout + done.stderr
    assert "test_full_step[20000-128-numba]" in done.stdout
    assert "test_full_step[200000-512-numba]" in done.stdout
    assert "test_query_at_key_frame[300]" in done.stdout
