"""Trees of arrays as flat tables of named arrays, and back: what a checkpoint holds."""

from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def named_arrays(tree: Any) -> dict[str, np.ndarray]:
    """Every leaf of a tree by its path in it, such as `memory.of_stage.0.left`."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {_name(path): np.asarray(leaf) for path, leaf in leaves}


def fill(template: Any, arrays: Mapping[str, np.ndarray]) -> Any:
    """A tree built like `template` whose leaves are `arrays`: inverse of `named_arrays`.

    Shapes may differ from the template's, as tables grow; types may not.

    Args:
        template: gives the structure, all that is not an array, and the type of each leaf.
        arrays: by path.

    Raises:
        ValueError: a leaf is missing, of another type, or there is one too many.
    """
    leaves, structure = jax.tree_util.tree_flatten_with_path(template)
    names = [_name(path) for path, _ in leaves]
    # One array too many means another version of the policy: its memory would be half understood.
    if set(names) != set(arrays):
        odd = sorted(set(names) ^ set(arrays))
        raise ValueError(f"these arrays are missing or of no use: {', '.join(odd)}")
    filled = [
        _like(leaf, arrays[name], name) for name, (_, leaf) in zip(names, leaves, strict=True)
    ]
    return jax.tree.unflatten(structure, filled)


def _name(path: tuple[Any, ...]) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".") or "value"


def _like(leaf: Any, array: np.ndarray, name: str) -> Any:
    """The array as the kind of thing that the leaf is: a device array, NumPy, or a number."""
    wanted = np.asarray(leaf)
    # Sizes may differ, as tables double; a type or an axis may not, as compiled code rests on them.
    if array.dtype != wanted.dtype or array.ndim != wanted.ndim:
        raise ValueError(
            f"{name} is {array.dtype} with {array.ndim} axes, expected {wanted.dtype} with "
            f"{wanted.ndim}"
        )
    if isinstance(leaf, jax.Array):
        return jnp.asarray(array)
    if isinstance(leaf, np.ndarray | np.generic):
        return array
    # A Python number: as an array it would be traced where the loop wants a plain value.
    return type(leaf)(array.item())
