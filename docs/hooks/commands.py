"""The reference of the command line: what every command says with --help."""

import os
import re
import subprocess
import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parents[2]
_RUN = "import sys; sys.argv[0] = 'r3jax'; from r3jax.cli import main; main()"
_HEAD = """# Command line

What `r3jax COMMAND --help` says, for each command. Which commands follow each other is in
[Getting started](../getting-started.md) and in the how-to pages.
"""


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Adds the page."""
    overview = _help()
    commands = re.findall(r"^│\s+• (\S+)", overview, re.MULTILINE)
    sections = [f"## r3jax {name}\n\n```text\n{_help(name)}\n```" for name in commands]
    text = "\n\n".join([_HEAD, f"```text\n{overview}\n```", *sections])
    files.append(File.generated(config, "api/commands.md", content=text))
    return files


def _help(*words: str) -> str:
    settings = os.environ | {"PYTHONPATH": str(ROOT), "NO_COLOR": "1", "COLUMNS": "84"}
    command = [sys.executable, "-c", _RUN, *words, "--help"]
    done = subprocess.run(command, env=settings, capture_output=True, text=True, check=True)
    return done.stdout.strip()
