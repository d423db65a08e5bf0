"""Chooses frames one after another, each by its gain in the objective (`objective`).

Lazy greedy: R is not submodular (a direction that closes kappa's box is more useful after its
counterpart), so that an old gain is not an exact bound. `is_exact` evaluates every candidate before
each choice; docs/howto/select.md reports how often the results differ.

The first frame and ties follow a rule that does not depend on the order of the frames: the largest
gain; among equals the sharper frame, then the one nearer to the center of the cameras, then the
name.

Shape symbols: n frames; k chosen; T targets.
"""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from r3jax.apps.select.objective import Objective
from r3jax.apps.select.observations import Observed
from r3jax.apps.select.targets import Targets
from r3jax.planning.lazy_greedy import renew_best

_AT_ONCE = 8
"""Number of candidates evaluated together."""

_EQUAL = 1e-7
"""Relative difference below which gains are equal, as rounding depends on the order of sums."""


@dataclass(frozen=True)
class Choice:
    """Frames in the order in which they were chosen."""

    order: np.ndarray
    """Indices of the frames, [k] int64."""

    gain: np.ndarray
    """By how much each frame raised the mean renderability when it was chosen, [k]."""

    per_target: np.ndarray
    """Renderability of each target after each frame, [k, T] float32."""

    of_all: np.ndarray
    """Renderability of each target after all frames, [T]."""

    left: np.ndarray
    """By how much each frame would still raise it at the end, [n]; 0 for those chosen."""

    is_complete: bool = True
    """False if the selection was interrupted."""

    @property
    def renderability(self) -> np.ndarray:
        """Mean renderability of the targets after each frame, [k]."""
        return self.per_target.mean(axis=1, dtype=np.float64)

    @property
    def share(self) -> np.ndarray:
        """The mean renderability as a share of that with all frames, [k]."""
        return self.renderability / max(float(self.of_all.mean()), 1e-9)


def tie_ranks(sharpness: np.ndarray, positions: np.ndarray, names: Sequence[str]) -> np.ndarray:
    """Ranks frames to break ties, [n]: the lowest rank wins.

    Args:
        sharpness: larger is sharper, [n].
        positions: camera positions, [n, 3].
        names: names of the frames.
    """
    from_middle = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    order = np.lexsort((np.argsort(np.argsort(names)), np.round(from_middle, 6), -sharpness))
    ranks = np.empty(len(order), np.int64)
    ranks[order] = np.arange(len(order))
    return ranks


def choose(
    observed: Observed,
    targets: Targets,
    num: int,
    *,
    gain: float | None = None,
    keep: Sequence[int] = (),
    allowed: np.ndarray | None = None,
    ranks: np.ndarray | None = None,
    is_exact: bool = False,
    on_choice: Callable[[], bool] = lambda: False,
) -> Choice:
    """Chooses frames.

    Args:
        observed: observations of every frame.
        targets: views whose renderability counts.
        num: maximum number of frames, including those to keep.
        gain: share of the mean renderability with all allowed frames at which to stop; None to
            stop at `num`.
        keep: frames that are chosen first, regardless of their gain.
        allowed: False for frames that may not be chosen, [n].
        ranks: tie-breaking ranks, [n], see `tie_ranks`; None: the order of the frames.
        is_exact: evaluate every candidate before each choice.
        on_choice: called after each frame; True ends the choice.
    """
    count = len(observed)
    allowed = np.ones(count, dtype=bool) if allowed is None else allowed.copy()
    allowed[list(keep)] = True
    ranks = np.arange(count) if ranks is None else ranks
    of_all = _after(observed, targets, np.flatnonzero(allowed))
    stop = np.inf if gain is None else gain * float(of_all.mean())
    quotas = _Quotas(component_of(observed), allowed, num)
    objective = Objective(observed, targets)
    bound, is_new = np.where(allowed, np.inf, -np.inf), np.zeros(count, dtype=bool)
    bound[quotas.full()] = -np.inf
    order, gains, values = list[int](), list[float](), list[np.ndarray]()
    firsts = [*keep, *itertools.repeat(None, max(0, min(num, allowed.sum()) - len(keep)))]
    is_complete = True
    for first in firsts:
        if first is None and objective.value >= stop:
            break
        if is_exact:
            bound[np.isfinite(bound)] = np.inf
        best = _best(bound, is_new, objective, ranks) if first is None else first
        before = objective.value
        objective.add(best)
        order.append(best)
        gains.append(objective.value - before)
        values.append(objective.per_target.astype(np.float32))
        bound[best], is_new[:] = -np.inf, False
        quotas.take(best)
        bound[quotas.full()] = -np.inf
        if on_choice():
            is_complete = len(order) == len(firsts)
            break
    rest = np.setdiff1d(np.arange(count), order)
    left = np.zeros(count)
    left[rest] = objective.gains(rest)
    per_target = np.array(values, np.float32).reshape(len(order), len(targets))
    return Choice(np.array(order, np.int64), np.array(gains), per_target, of_all, left, is_complete)


def _best(bound: np.ndarray, is_new: np.ndarray, objective: Objective, ranks: np.ndarray) -> int:
    """Finds the frame with the largest gain; the lowest rank breaks ties."""
    while True:
        best = renew_best(bound, is_new, objective.gains, _AT_ONCE)
        assert best is not None  # callers choose at most as many frames as are allowed
        equal = np.flatnonzero(bound >= bound[best] - _EQUAL * abs(bound[best]))
        stale = equal[~is_new[equal]]
        if not len(stale):
            return int(equal[np.argmin(ranks[equal])])
        bound[stale], is_new[stale] = objective.gains(stale), True


def _after(observed: Observed, targets: Targets, frames: np.ndarray) -> np.ndarray:
    """Computes the renderability of each target on the map of some frames, [T]."""
    objective = Objective(observed, targets)
    for frame in frames.tolist():
        objective.add(frame)
    return objective.per_target


def component_of(observed: Observed) -> np.ndarray:
    """Labels the scene of each frame, [n]: frames connected by a chain of shared surfaces."""
    count = len(observed)
    first_of = np.full(observed.num_rows, -1, np.int64)  # the first frame that shows a row
    links: list[np.ndarray] = []
    for frame in range(count):
        part = slice(int(observed.first[frame]), int(observed.first[frame + 1]))
        row = observed.row[part][observed.is_colored[part]]
        first_of[row[first_of[row] < 0]] = frame
        shown = np.unique(first_of[row])
        links.append(np.stack([np.full(len(shown), frame), shown]))
    pairs = np.concatenate(links, axis=1)
    graph = sparse.coo_matrix((np.ones(pairs.shape[1], dtype=bool), tuple(pairs)), (count, count))
    return connected_components(graph, directed=False)[1]


def in_proportion(sizes: np.ndarray, num: int) -> np.ndarray:
    """Splits a number in proportion to sizes (largest remainders), no part above its size.

    Args:
        sizes: upper limits of the parts, [g].
        num: number to split, at most the sum of the sizes.
    """
    exact = num * sizes / max(int(sizes.sum()), 1)
    parts = np.floor(exact).astype(np.int64)
    for group in np.argsort(parts - exact, kind="stable")[: num - int(parts.sum())]:
        parts[group] += 1
    return parts


class _Quotas:
    """Number of frames of each scene that may still be chosen."""

    def __init__(self, component: np.ndarray, allowed: np.ndarray, num: int):
        self._component = component
        sizes = np.bincount(component[allowed], minlength=component.max(initial=0) + 1)
        self._left = in_proportion(sizes, min(num, int(sizes.sum())))

    def take(self, frame: int) -> None:
        """Counts a chosen frame."""
        self._left[self._component[frame]] -= 1

    def full(self) -> np.ndarray:
        """Returns the frames that may not be chosen because their scene has reached its quota."""
        return np.flatnonzero(self._left[self._component] <= 0)
