"""Small runs, for the tests of the command line."""

from pathlib import Path
from unittest import mock

from r3jax.cli.main import main


def explore(room: str, out: Path, *words: str, report: bool = False) -> int:
    """A small run; the same shapes everywhere, so that each part compiles once."""
    options = {"scene": room, "policy": "random", "budget": "views:3", "clock": "model"}
    options |= {"resolution": 48, "fov": 90, "capacity": 16384, "voxel-size": 0.1}
    options |= {"out": out, "name": "box", "candidates": 20}
    given = [word for name, value in options.items() for word in (f"--{name}", str(value))]
    return (main if report else main_without_report)(["explore", *given, *words])


def main_without_report(words: list[str]) -> int:
    """Runs a command that would write a report, which takes longer than a small run."""
    with mock.patch(
        "r3jax.cli.commands.explore.write_report", lambda run, *_: run.path / "report.html"
    ):
        return main(words)
