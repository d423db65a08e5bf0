"""The targets of the Makefile."""

import os
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SHOW = "demo test:\n\t@echo $@ $${JAX_COMPILATION_CACHE_DIR:-default}\n"


def test_the_demo_compiles_for_the_commands_that_follow_it():
    words = ["make", "-s", "-f", "Makefile", "-f", "-", "-o", ".venv/.installed", "demo", "test"]
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    done = subprocess.run(words, input=SHOW, capture_output=True, text=True, cwd=ROOT, env=env)
    assert done.stdout.splitlines() == ["demo default", f"test {ROOT}/.cache/jax"], done.stderr
