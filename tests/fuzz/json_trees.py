"""Wrong types, wrong numbers, wrong names and doubled keys in JSON."""

import json
from typing import Any

import numpy as np

HOSTILE_NAMES = (
    "../../x",
    "../outside/secret",
    "/etc/passwd",
    "/dev/zero",
    "..\\..\\x",
    "a/../../../outside/secret",
    "\x00",
    "%2e%2e/outside/secret",
    "file:///etc/passwd",
    "http://localhost:1/x",
    "data:application/octet-stream;base64,AAAA",
    "data:,",
    "x" * 10_000,
    "",
    ".",
    "~/x",
    "nul\n",
    "\ud800",
)

_VALUES: tuple[Any, ...] = (
    None, True, False, 0, -1, 1, 1.5, 2**31, 2**32 - 1, 2**63, 10**12, 10**400, 1e308, -1e308,
    1e-320, float("nan"), float("inf"), "", "text", "nan", [], [1], [[]], {}, {"a": 1}, [None],
    [1e308] * 3, ["a", {}], [float("nan")] * 16, [0] * 5000,
)  # fmt: skip


def damage_lines(rng: np.random.Generator, data: bytes) -> bytes:
    """Damages one value of a JSON text, or of one line of JSON lines."""
    try:
        return damage(rng, data)
    except (ValueError, RecursionError):  # no JSON, or nested by earlier damage
        lines = data.split(b"\n")
        i = int(rng.integers(len(lines)))
        try:
            lines[i] = damage(rng, lines[i])
        except (ValueError, RecursionError):
            lines[i] = b"{}"
        return b"\n".join(lines)


def damage(rng: np.random.Generator, data: bytes) -> bytes:
    """Damages one value of a JSON text.

    Raises:
        ValueError: the data is no JSON, or nested too deeply by an earlier damage.
    """
    try:
        tree = {"": json.loads(data)}
    except RecursionError:
        raise ValueError("nested too deeply") from None
    places: list[tuple[Any, Any]] = []
    _collect(tree, places)
    # Strings (names of files among them) deserve their share beside long lists of numbers.
    names = [(node, key) for node, key in places if isinstance(node[key], str)]
    if names and rng.random() < 0.3:
        node, key = names[rng.integers(len(names))]
        node[key] = HOSTILE_NAMES[rng.integers(len(HOSTILE_NAMES))]
        return _text(tree[""])
    if rng.random() < 0.5:  # and so do shallow places
        places = places[: max(1, min(len(places), 40))]
    node, key = places[rng.integers(len(places))]
    how = rng.integers(8)
    if how == 0 and key != "":
        del node[key]
    elif how == 1 and isinstance(node, dict):
        marker = f"~{key}"
        node[marker] = _VALUES[rng.integers(len(_VALUES))]
        return _text(tree[""]).replace(json.dumps(marker).encode(), json.dumps(key).encode())
    elif how == 2 and isinstance(node, list):
        node.extend([node[key]] * int(rng.integers(1, 50)))
    elif how == 3:
        node[key] = [node[key]]
    else:
        node[key] = _VALUES[rng.integers(len(_VALUES))]
    return _text(tree[""])


def _collect(node: Any, places: list[tuple[Any, Any]]) -> None:
    """Every value of the tree by its container and key, breadth first."""
    level = [node]
    while level:
        below = []
        for node in level:
            keys = node.keys() if isinstance(node, dict) else range(len(node))
            for key in keys:
                places.append((node, key))
                if isinstance(node[key], dict | list):
                    below.append(node[key])
        level = below


def _text(tree: Any) -> bytes:
    # 10**400 is written digit by digit; surrogates stay escaped.
    return json.dumps(tree).encode()
