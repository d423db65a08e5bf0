"""What is printed is shown as it is: a name from a file is no markup, and moves no cursor."""

import ast
import io
from pathlib import Path

import pytest

import r3jax
from r3jax.cli.commands.benchmark import print_results
from r3jax.cli.console import Console, Table, TextColumn, progress_bar
from r3jax.cli.main import main
from r3jax.runs.writer import RunWriter
from tests.evaluation.records import record
from tests.runs.runs import make_header, make_view

ODD = "[/x] [abc] [bold]b[/bold] :smile: \x1b[2J\udcff"
SHOWN = "[/x] [abc] [bold]b[/bold] :smile: \\x1b[2J\\udcff"


def terminal() -> Console:
    return Console(file=io.StringIO(), force_terminal=True, width=200, color_system=None)


def test_everything_that_prints_shows_text_as_it_is():
    console = terminal()
    console.print(ODD)
    console.say(ODD, style="red")
    table = Table(ODD, title=ODD, box=None)
    table.add_row(ODD)
    console.print(table)
    with console.status(ODD) as status:
        status.update(f"{ODD} again")
    with progress_bar(console, TextColumn("{task.description}")) as bar:
        bar.add_task(ODD)
    text = console.file.getvalue()
    assert text.count(SHOWN) >= 7
    assert f"{SHOWN} again" in text
    assert "\x1b[2J" not in text


def test_a_run_may_be_called_anything(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    header = make_header(scene={"name": "[/s]", "hash": "abc"}, policy={"name": "[/p]"})
    with RunWriter(Path("[/x]"), header) as writer:
        writer.add(*make_view(0))
        writer.add_timings(0, {"[/stage]": 1.0})
        writer.finish("budget", "[/why] [abc]")
    assert main(["info", "[/x]"]) == 0
    printed = capsys.readouterr().out
    for name in ("[/x]", "[/s]", "[/p]", "[/stage]", "[/why] [abc]"):
        assert name in printed
    assert main(["export", "[/x]", "--out", "[/y]"]) == 0
    assert "[/y]" in capsys.readouterr().err


@pytest.mark.parametrize("command", ["explore", "team"])
def test_a_scene_may_be_called_anything(tmp_path, capsys, command):
    assert main([command, "--scene", "mesh:[/x].glb", "--out", str(tmp_path)]) == 2
    assert "[/x].glb" in capsys.readouterr().err


def test_a_benchmark_may_be_of_anything():
    console = terminal()
    print_results(console, [record("[abc]", "[/x]", psnr=[20.0] * 3)])
    assert "[/x]" in console.file.getvalue()


def test_rich_is_used_through_the_console_alone():
    root = Path(r3jax.__file__).parent
    users = set()
    for path in root.rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            elif isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            else:
                continue
            if any(name.split(".")[0] == "rich" for name in names):
                users.add(path.relative_to(root).as_posix())
    assert users == {"cli/console.py"}
