"""The share seen well enough that suggested pictures can be expected to bring: less than simulated.

An audit simulates each suggested picture and finds the share of the surface that is then seen well
enough. Fewer percent come: pictures are taken a little aside, and they show surfaces that no
picture had shown, which are new gaps. How many fewer was measured by taking ten suggested pictures
in embedded scenes, and auditing again (`python -m experiments.audit_promise`); a test holds these
numbers to its result.
"""

from typing import NamedTuple

import numpy as np

from r3jax.apps.audit.suggest import SuggestedViews

LOSS = (0.036, 0.049, 0.113)
"""Shares by which less came than was simulated: 10th percentile, median and 90th percentile."""

LOSS_RANDOM = (-0.019, 0.015, 0.043)
"""The same of pictures at random places and directions."""

_MEASURED = 10
"""Pictures that were taken; of fewer, proportionally less is lost."""


class Promise(NamedTuple):
    """Shares of the surface that are seen well enough once pictures are taken."""

    low: float
    middle: float
    high: float


def promise(plan: SuggestedViews) -> Promise:
    """Computes the interval in which most captures of the experiment were after the pictures."""
    return expected(plan.after.fine_share, len(plan.views), LOSS)


def random_promise(plan: SuggestedViews) -> Promise:
    """Computes the same for pictures at random places."""
    return expected(plan.random_fine[-1], len(plan.views), LOSS_RANDOM)


def expected(simulated: float, pictures: int, loss: tuple[float, float, float]) -> Promise:
    """Subtracts what is lost from a simulated share.

    Args:
        simulated: share seen well enough, once the pictures are taken.
        pictures: their number.
        loss: percentiles of what is lost, ascending.
    """
    part = min(1.0, pictures / _MEASURED)
    low, middle, high = np.clip([simulated - part * x for x in reversed(loss)], 0.0, 1.0)
    return Promise(float(low), float(middle), float(high))
