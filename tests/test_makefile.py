"""The targets of the Makefile."""

import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
TARGETS = ["demo", "test", "test-added", "mutants", "benchmark"]
SHOW = f"{' '.join(TARGETS)}:\n\t@echo $@ $$JAX_COMPILATION_CACHE_DIR\n"


def test_all_targets_compile_for_the_commands(tmp_path):
    env = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
    env |= {"XDG_CACHE_HOME": str(tmp_path)}
    words = ["make", "-s", "-f", "Makefile", "-f", "-", "-o", ".venv/.installed", *TARGETS]
    done = subprocess.run(words, input=SHOW, capture_output=True, text=True, cwd=ROOT, env=env)
    program = (
        "import os; from r3jax.cli.command_line import _keep_compilations as keep; keep(); "
        "print(os.environ['JAX_COMPILATION_CACHE_DIR'])"
    )
    command = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, env=env
    ).stdout.strip()
    assert command.startswith(str(tmp_path))
    assert done.stdout.splitlines() == [f"{target} {command}" for target in TARGETS], done.stderr
