"""What Windows lacks is done without: commands run with these modules hidden."""

import subprocess
import sys

import pytest

HIDDEN = """
import sys
sys.modules["fcntl"] = sys.modules["resource"] = None
from r3jax.cli.main import main
sys.exit(main(sys.argv[1:]))
"""

RUN = ["explore", "--scene", "flat", "--policy", "random", "--budget", "views:3"]
RUN += ["--clock", "model", "--resolution", "48", "--candidates", "10", "--name", "r"]


def r3jax(*words):
    command = [sys.executable, "-c", HIDDEN, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True)


def test_modules_that_windows_lacks_are_needed_by_no_import():
    code = (
        "import sys; sys.modules['fcntl'] = sys.modules['resource'] = None; "
        "import r3jax.planning.policies.foreign.messages, r3jax.files, r3jax.kernels.native.ffi"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.full
def test_a_run_is_made_and_audited_without_them(tmp_path):
    done = r3jax(*RUN, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert done.stderr.count("no file locks") == 1
    done = r3jax("audit", tmp_path / "r", "--views", "1", "--out", tmp_path / "audit")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "audit" / "audit.json").is_file()
