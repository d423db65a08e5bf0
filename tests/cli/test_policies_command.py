"""`r3jax policies`: every policy once, with its sentence and its source, on 80 columns."""

import pytest

from r3jax.cli.main import main
from r3jax.planning.registry import describe, policy_names, source_of


@pytest.fixture
def listing(monkeypatch, capsys):
    def run(columns: int) -> list[str]:
        monkeypatch.setenv("COLUMNS", str(columns))
        assert main(["policies"]) == 0
        return capsys.readouterr().out.splitlines()

    return run


def blocks(lines: list[str]) -> dict[str, str]:
    """What is said about each policy, by name."""
    found: dict[str, str] = {}
    for line in lines:
        if not line.startswith(" "):
            name, _, line = line.partition(" ")
            assert name not in found
            found[name] = ""
        else:
            name = list(found)[-1]
        found[name] += f" {line.strip()}"
    return found


@pytest.mark.parametrize("columns", [80, 100, 200])
def test_every_policy_has_its_sentence_and_its_source(listing, columns):
    lines = listing(columns)
    assert max(len(line.rstrip()) for line in lines) <= min(columns, 100)
    said = blocks(lines)
    assert tuple(said) == policy_names()
    for name, text in said.items():
        assert text == f" {describe(name)} {source_of(name)}"


def test_no_policy_borrows_the_words_of_another():
    """A subclass without a docstring or a source of its own would repeat its parent's."""
    for tell in (describe, source_of):
        texts = [tell(name) for name in policy_names()]
        assert len(set(texts)) == len(texts)
        assert all(texts)


def test_nothing_else_is_asked_for():
    with pytest.raises(SystemExit) as stopped:
        main(["policies", "--scene", "flat"])
    assert stopped.value.code == 2
