"""The policies, one module each, and the table of their names, which needs no import of them.

A policy comes from this package, from another one (entry-point group `r3jax.policies`), from a
class given as `package.module:Class`, from this process (`planning.registry.register_policy`), or
from a program of its own (`exec:COMMAND`).
"""

import functools
import importlib.util
import re
from importlib.metadata import entry_points

from r3jax.errors import InputError
from r3jax.planning.policies.foreign.commands import COMMAND, words_of
from r3jax.validation.errors import did_you_mean

GROUP = "r3jax.policies"
"""Entry-point group for policies of other packages: `name = "package.module:Class"`."""

HOMES = {
    name: f"r3jax.{home}"
    for name, home in {
        "r3": "planning.policies.r3:R3",
        "r3-pano": "planning.policies.r3:R3Pano",
        "r3-ahead": "planning.policies.r3_ahead:R3Ahead",
        "r3con": "baselines.r3con:R3con",
        "active-gs": "baselines.active_gs:ActiveGS",
        "active-gs-online": "baselines.active_gs_online:ActiveGSOnline",
        "active-gamer": "baselines.active_gamer:ActiveGamer",
        "cover": "baselines.cover:Cover",
        "gavis": "baselines.gavis:Gavis",
        "fisherrf": "baselines.fisherrf:FisherRF",
        "gauss-mi": "baselines.gauss_mi:GaussMI",
        "frontier": "planning.policies.frontier:Frontier",
        "random": "planning.policies.random:Random",
    }.items()
}
"""Module and class of every policy of this package."""

ALIASES = {"ours": "r3", "ours-pano": "r3-pano", "ours-ahead": "r3-ahead"}
"""Former names of policies, in recorded runs, submissions and records."""

FOREIGN = "r3jax.planning.policies.foreign.foreign:Foreign"
"""Module and class of the policy that runs a program."""

RETIRED = {
    "ours-demand": "it lost 0.74 dB against r3-pano; commit e43d800 has it",
    "fisherrf-d-opt": "use fisherrf with the settings criterion=d-opt, quirk=False",
} | dict.fromkeys(
    ("active-gs-no-depth", "unseen", "unseen-depth", "uniform"),
    "no table rests on it; commit fb13156 has it",
)
"""Removed policies: why they were removed, and the commit with their code."""

REGISTERED: dict[str, type] = {}
"""Classes registered by `planning.registry.register_policy` in this process."""

_CLASS = re.compile(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*:[A-Za-z_]\w*")


@functools.cache
def plugins() -> dict[str, str]:
    """Finds the module and class of every policy of installed packages."""
    # Not loaded: listing names must not import other packages.
    return {point.name: point.value for point in entry_points(group=GROUP)}


def known_names() -> tuple[str, ...]:
    """Lists all names: this package's, other packages', this process's."""
    # A dictionary drops repeats and keeps the order, which a set would lose.
    return tuple(dict.fromkeys([*HOMES, *plugins(), *REGISTERED]))


def current_name(name: str) -> str:
    """Translates a former name of a policy, as older runs and records have it."""
    return ALIASES.get(name, name)


def home_of(name: str) -> str:
    """Finds the `package.module:Class` of a policy that is not registered in this process.

    Raises:
        ValueError: an unknown name; lists the known ones and suggests a similar one.
    """
    if name.startswith(COMMAND):
        return FOREIGN
    # First of all: for a removed policy give the reason, not a similar name.
    if name in RETIRED:
        raise InputError(f"policy {name!r} has left the package: {RETIRED[name]}")
    # Before plug-ins: in recorded runs these names mean policies of this package.
    name = current_name(name)
    if name in HOMES:
        return HOMES[name]
    if name in plugins():
        return plugins()[name]
    if _CLASS.fullmatch(name):
        return name
    names = known_names()
    raise InputError(
        f"unknown policy {name!r}{did_you_mean(name, names)}; known: {', '.join(names)}, a class "
        "as package.module:Class, or a program as exec:COMMAND"
    )


def check_policy(name: str) -> None:
    """Refuses an unknown policy, or one whose package is not installed; imports no policy.

    Raises:
        ValueError: lists the known policies and suggests a similar one, or names the missing
            program.
    """
    if name in REGISTERED:
        return
    if name.startswith(COMMAND):
        words_of(name.removeprefix(COMMAND))
        return
    module = home_of(name).partition(":")[0]
    try:
        # This imports the parents of a module, and raises if one of them is missing.
        found = importlib.util.find_spec(module)
    except ImportError:
        found = None
    if found is None:
        raise InputError(f"policy {name!r}: there is no module {module}")
