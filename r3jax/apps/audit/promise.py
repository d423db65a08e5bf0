"""Corrects the simulated gain of suggested pictures by the shortfall measured in an experiment.

An audit simulates each suggested picture and computes the share of the surface that is then seen
well enough. The real share is smaller: pictures are taken slightly beside the suggested pose, and
they show surfaces that no picture had shown before, which count as new gaps. The shortfall was
measured by taking ten suggested pictures in embedded scenes and auditing again
(`python -m experiments.audit_promise`); a test compares these numbers with its result.
"""

from typing import NamedTuple

import numpy as np

from r3jax.apps.audit.suggest import SuggestedViews

LOSS = (0.036, 0.049, 0.113)
"""Shortfall of the simulated share: 10th percentile, median and 90th percentile."""

LOSS_RANDOM = (-0.019, 0.015, 0.043)
"""The same for pictures at random places and in random directions."""

_MEASURED = 10
"""Pictures taken in the experiment; with fewer, the shortfall is proportionally smaller."""


class Promise(NamedTuple):
    """Expected shares of the surface that are seen well enough after more pictures."""

    low: float
    middle: float
    high: float


def promise(plan: SuggestedViews) -> Promise:
    """Computes the interval that contained most captures of the experiment after the pictures."""
    return expected(plan.after.fine_share, len(plan.views), LOSS)


def random_promise(plan: SuggestedViews) -> Promise:
    """Computes the same for pictures at random places."""
    return expected(plan.random_fine[-1], len(plan.views), LOSS_RANDOM)


def expected(simulated: float, pictures: int, loss: tuple[float, float, float]) -> Promise:
    """Subtracts the expected shortfall from a simulated share.

    Args:
        simulated: share seen well enough after the pictures, as simulated.
        pictures: number of pictures.
        loss: percentiles of the shortfall, ascending.
    """
    part = min(1.0, pictures / _MEASURED)
    low, middle, high = np.clip([simulated - part * x for x in reversed(loss)], 0.0, 1.0)
    return Promise(float(low), float(middle), float(high))
