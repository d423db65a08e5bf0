"""Which records of a benchmark share a table, and what tells one table from the next."""

from collections.abc import Sequence

from r3jax.evaluation.comparison import (
    Cell,
    check_equal_terms,
    differing,
    scenes_of,
    snapshots_of,
    terms_in_scene,
    terms_of,
)

_LONGEST = 24
"""Of a value in a heading; what is longer, such as a hash, is cut."""


def on_equal_terms(first: Cell, second: Cell) -> bool:
    """True if two records of one scene were made on equal terms, whatever they are called."""
    return not (
        differing(terms_of(first), terms_of(second))
        or differing(terms_in_scene(first), terms_in_scene(second))
    )


def headed_groups(records: Sequence[Cell]) -> list[tuple[str, list[Cell]]]:
    """All records in groups that may share a table, snapshot by snapshot, each with a heading."""
    found: list[tuple[str, list[Cell]]] = []
    for snapshot in snapshots_of(records):
        groups = groups_on_equal_terms([r for r in records if r["snapshot"] == snapshot])
        found += zip(headings_of(groups), groups, strict=True)
    return found


def groups_on_equal_terms(records: Sequence[Cell]) -> list[list[Cell]]:
    """Records of one snapshot in groups that may share a table, each as large as it can be.

    One that is there twice (the same method, scene and seed) begins a group of its own.
    """
    groups: list[list[Cell]] = []
    for record in records:
        for group in groups:
            try:
                check_equal_terms([*group, record])
            except ValueError:
                continue
            group.append(record)
            break
        else:
            groups.append([record])
    return groups


def headings_of(groups: Sequence[Sequence[Cell]]) -> list[str]:
    """Heads the table of each group: the snapshot, and its terms that are not those of the others.

    Args:
        groups: as `groups_on_equal_terms` makes them.
    """
    told: list[list[str]] = [[] for _ in groups]
    for name, values in _terms_of_groups(groups).items():
        if len({repr(value) for value in values.values()}) > 1:
            for number, value in values.items():
                text = str(value)
                text = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
                told[number].append(f"{name}: {text}")
    headings: list[str] = []
    met: list[str] = []
    for group, parts in zip(groups, told, strict=True):
        heading = ", ".join([group[0]["snapshot"], *parts])
        met.append(heading)
        if (count := met.count(heading)) > 1:
            heading += f", table {count} on the same terms: it has a record of the same name"
        headings.append(heading)
    return headings


def _terms_of_groups(groups: Sequence[Sequence[Cell]]) -> dict[str, dict[int, object]]:
    """By term its value in each group that has one, by the group's number."""
    found = [terms_of(group[0]) for group in groups]
    names = dict.fromkeys(name for terms in found for name in terms)
    values = {name: {n: terms.get(name) for n, terms in enumerate(found)} for name in names}
    for number, group in enumerate(groups):
        for scene in scenes_of(group):
            first = next(cell for cell in group if cell["scene"] == scene)
            for name, value in terms_in_scene(first).items():
                values.setdefault(f"{name} in {scene}", {})[number] = value
    return values
