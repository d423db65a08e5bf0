"""Lazy greedy selection (Minoux 1978): finds the best candidate with few evaluations.

If gains do not increase by other choices, an old gain is an upper bound: only candidates whose old
gain exceeds the best new one are evaluated again.
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
        bound: latest known gains, [C]; -inf for forbidden candidates, inf for those never
            evaluated. Changed in place.
        is_new: True where the bound is the current gain, [C]. Changed in place.
        renew: computes the gains of some candidates [k], [k].
        at_once: number of candidates to evaluate together.
        least: smaller gains do not count.

    Returns:
        The best candidate, the first one on ties; None if none is allowed and gains enough.
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
