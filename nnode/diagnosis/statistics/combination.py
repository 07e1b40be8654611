"""The combined evidence of exploration and confirmation clusters.

An effect is chosen by its score in the exploration clusters, with a p-value that is corrected for
all effects. The confirmation clusters share no agent with them. So both p-values are independent if
the effect does not exist, and Stouffer's weighted sum of their normal quantiles keeps the level.
The weights, square roots of the numbers of clusters, are fixed before anything is tested. A test at
5 % in both parts would need about twice as many clusters for the same power.

Source: Stouffer et al. 1949; Lipták 1958 (weights).
"""

from __future__ import annotations

import math

import numpy as np
from scipy import stats

from nnode.data.clusters import least_number
from nnode.diagnosis import thresholds


def combined(
    exploration: np.ndarray | float,
    confirmation: np.ndarray | float,
    n_exploration: int,
    n_confirmation: int,
) -> np.ndarray:
    """The p-value of both parts together.

    Args:
        exploration, confirmation: p-values of each part.
        n_exploration, n_confirmation: numbers of clusters.
    """
    # a p-value of 1 is finite evidence against the effect
    first, second = (
        stats.norm.isf(np.minimum(p_value, 1 - 1e-12)) for p_value in (exploration, confirmation)
    )
    weighted = math.sqrt(n_exploration) * first + math.sqrt(n_confirmation) * second
    return np.asarray(stats.norm.sf(weighted / math.sqrt(n_exploration + n_confirmation)))


def least_confirmation() -> int:
    """The number of confirmation clusters whose sign flips can reach the level that each part must
    reach on its own."""
    return least_number(thresholds.EACH, sided=1)
