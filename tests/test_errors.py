"""Refusals are told in one line; a bug keeps its traceback."""

import importlib
import re
from pathlib import Path

import pytest

import r3jax
from r3jax.cli.main import BUG, USER_ERROR, main
from r3jax.errors import InputError

ROOT = Path(r3jax.__file__).parent


@pytest.mark.parametrize("error", [ValueError, InputError, OSError, KeyError])
def test_only_a_bug_is_told_with_its_traceback(error, monkeypatch, capsys):
    def fail(options):
        raise error("seven")

    command = importlib.import_module("r3jax.cli.commands.runs")
    monkeypatch.setattr(command, "run_policies", fail)
    is_bug = error in (ValueError, KeyError)
    assert main(["policies"]) == (BUG if is_bug else USER_ERROR)
    told = capsys.readouterr().err
    assert "seven" in told
    assert ("Traceback" in told) == is_bug
    assert (len(told.splitlines()) > 1) == is_bug


def test_refusals_have_a_type_of_their_own():
    sources = {path: path.read_text(encoding="utf-8") for path in ROOT.rglob("*.py")}
    assert [p for p, text in sources.items() if re.search(r"raise ValueError\b", text)] == []
