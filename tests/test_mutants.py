"""The helper that plants faults: it must plant them, beside the real modules, and say if not."""

import sys

import pytest

from r3jax.mapping import table
from tests.mutants import Mutant, assert_caught, load

CHAIN = ("r3jax.mapping.table", "r3jax.mapping.join")


def probes_are_few(modules) -> None:
    assert modules["table"].MAX_PROBES < 1000


def mutant(original: str, mutated: str, module: str = "table") -> Mutant:
    return Mutant(module, original, mutated, probes_are_few)


FAULT = mutant("MAX_PROBES = 192", "MAX_PROBES = 1920")


def test_a_fault_is_planted_and_the_real_module_stays():
    modules = load(CHAIN, FAULT)
    assert modules["table"].MAX_PROBES == 1920
    assert modules["join"].find_or_insert is modules["table"].find_or_insert
    assert table.MAX_PROBES == 192
    assert sys.modules["r3jax.mapping.table"] is table


def test_without_a_fault_the_law_holds():
    probes_are_few(load(CHAIN))


def test_a_caught_mutant_passes_and_a_survivor_fails():
    assert_caught(CHAIN, FAULT)
    with pytest.raises(pytest.fail.Exception, match="DID NOT RAISE"):
        assert_caught(CHAIN, mutant("MAX_PROBES = 192", "MAX_PROBES = 191"))


@pytest.mark.parametrize(
    ("original", "module", "words"),
    [
        ("no such line", "table", "occurs 0 times in table.py"),
        ("capacity", "table", "not once"),
        ("MAX_PROBES", "compact", "no module 'compact'"),
    ],
)
def test_a_stale_mutant_is_named(original, module, words):
    with pytest.raises(LookupError, match=words):
        load(CHAIN, mutant(original, "", module))
