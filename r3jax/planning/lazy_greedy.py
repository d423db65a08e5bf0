"""Lazy greedy (Minoux 1978): the best of many, of which only a few are evaluated again.

Where a gain hardly ever grows by other choices, an old one is as good as an upper bound: only
candidates whose old gain is above the best new one need to be evaluated again.
"""

from collections.abc import Callable

import numpy as np


def renew_best(
    bound: np.ndarray,
    is_new: np.ndarray,
    renew: Callable[[np.ndarray], np.ndarray],
    at_once: int,
    least: float = -np.inf,
) -> int | None:
    """Evaluates candidates in the order of their bounds until the best is up to date.

    Args:
        bound: gains as far as they are known, [C]; -inf for those that may not be chosen, inf for
            those never evaluated. Changed in place.
        is_new: True where the bound is the gain as it is now, [C]. Changed in place.
        renew: computes the gains of some candidates [k], [k].
        at_once: candidates that are evaluated together.
        least: smaller gains are none.

    Returns:
        The best one, the first of several; None where none may be chosen or gains enough.
    """
    while True:
        best = int(np.argmax(bound)) if len(bound) else None
        if best is None or bound[best] == -np.inf or bound[best] < least:
            return None
        if is_new[best]:
            return best
        never = np.flatnonzero(np.isposinf(bound) & ~is_new)
        stale = np.flatnonzero(~is_new & (bound > -np.inf))
        ids = never if len(never) else stale[np.argsort(-bound[stale], kind="stable")][:at_once]
        bound[ids], is_new[ids] = renew(ids), True
