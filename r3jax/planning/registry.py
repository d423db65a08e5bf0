"""Finds policies by name, makes them, and registers new ones."""

import importlib
import inspect
from dataclasses import fields
from typing import Any, TypeVar

from r3jax.errors import InputError
from r3jax.planning.config import PlannerConfig
from r3jax.planning.policies import HOMES, REGISTERED, current_name, home_of, known_names
from r3jax.planning.policies.foreign.commands import COMMAND
from r3jax.planning.policy import Policy

PolicyClass = TypeVar("PolicyClass", bound=type)


def register_policy(policy_class: PolicyClass) -> PolicyClass:
    """Registers a policy by its `name` in this process; a decorator.

        @r3jax.register_policy
        @dataclass(frozen=True)
        class Highest(r3jax.GreedyPolicy): ...

    A command, or a worker of a benchmark, is another process: give it `package.module:Class`, or
    install the package with an entry point in the group `r3jax.policies`.

    Raises:
        ValueError: the class has no name, or that of a policy of this package.
    """
    name = getattr(policy_class, "name", None)
    if not isinstance(name, str) or not name:
        raise InputError(f"{policy_class.__qualname__} needs a class attribute `name`")
    # A policy of this package cannot be replaced: recorded runs name it.
    if current_name(name) in HOMES:
        raise InputError(f"a policy of this package is called {name!r}: choose another name")
    REGISTERED[name] = policy_class
    return policy_class


def policy_names() -> tuple[str, ...]:
    """Lists the names for `make_policy`."""
    return known_names()


def describe(name: str) -> str:
    """Describes a policy in one line.

    Raises:
        ValueError: no policy has that name.
    """
    return inspect.cleandoc(policy_class(name).__doc__ or "").partition("\n")[0]


def source_of(name: str) -> str:
    """Returns the origin of a policy's rule, in a phrase.

    Raises:
        ValueError: no policy has that name.
    """
    found = policy_class(name)
    return getattr(found, "source", found.__module__)


def config_class(name: str) -> type[PlannerConfig]:
    """Finds the settings class of a policy: its attribute `Config`, or `PlannerConfig`.

    Raises:
        ValueError: no policy has that name.
    """
    return getattr(policy_class(name), "Config", PlannerConfig)


def make_policy(name: str, **settings: Any) -> Policy:
    """Makes a policy by name.

    Args:
        name: one of `policy_names()`, `package.module:Class`, or `exec:COMMAND`.
        **settings: fields of its `Config` that differ from their defaults.

    Raises:
        ValueError: no policy has that name, no setting has that name, or a value is impossible.
    """
    if name.startswith(COMMAND):
        settings = settings | {"command": name.removeprefix(COMMAND)}
    config = config_class(name)
    # Checked here: the dataclass' own error would not list the available settings.
    known = [field.name for field in fields(config)]
    unknown = [setting for setting in settings if setting not in known]
    if unknown:
        raise InputError(
            f"policy {name!r} has no setting {', '.join(unknown)}; known: {', '.join(known)}"
        )
    return policy_class(name)(config(**settings))


def policy_class(name: str) -> Any:
    """Imports the class of a policy.

    Raises:
        ValueError: no policy has that name, or its module has no such class.
    """
    # Registered classes first: they override installed ones.
    if name in REGISTERED:
        return REGISTERED[name]
    module, _, kind = home_of(name).partition(":")
    # Lazy import: names are listed without loading JAX.
    try:
        found = getattr(importlib.import_module(module), kind)
    except (ImportError, AttributeError) as error:
        raise InputError(f"policy {name!r} cannot be imported: {error}") from error
    if not isinstance(getattr(found, "name", None), str):
        raise InputError(f"policy {name!r}: {module}:{kind} has no class attribute `name`")
    return found
