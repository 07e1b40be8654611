"""Laws whose parameters are at bounds."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.statistics.bounds import parameters_at_bounds, required_beyond_bounds
from tests.diagnosis.platoons import lin

CLUSTERS, SIZE = 24, 20
NAMES = ["terms.0.v0", "terms.0.L"]
CLUSTER = np.repeat(np.arange(CLUSTERS), SIZE)
ENGINE: Any = SimpleNamespace(cluster=CLUSTER)


def at_a_bound(seed: int, beyond: float, side: int = 1) -> Fit:
    """A regression on two correlated columns whose second parameter is held at a bound.

    Args:
        beyond: distance of its true value from the bound.
        side: sign of the values that are not admissible.
    """
    rng = np.random.default_rng(seed)
    jacobian = rng.normal(size=(CLUSTERS * SIZE, 2))
    jacobian[:, 1] += 0.5 * jacobian[:, 0]
    measured = rng.normal(size=len(jacobian)) - side * beyond * jacobian[:, 1]
    free = jacobian[:, :1]
    residual = measured - free @ np.linalg.lstsq(free, measured, rcond=None)[0]
    admissible = (jacobian[:, 1] @ residual) * side > 0  # of the best value
    return Fit(lin(), NAMES, np.zeros(2), residual, jacobian, np.array([True, admissible]))


@pytest.mark.parametrize("side", [-1, 1])
def test_true_value_beyond_bound_is_detected(side: int) -> None:
    assert required_beyond_bounds(at_a_bound(0, 0.3, side), CLUSTER) == {"lin.L"}


def test_level_for_true_value_at_bound() -> None:
    """The level is 1 %: the p-value is one-sided, and half of the estimates are admissible."""
    rejected = [bool(required_beyond_bounds(at_a_bound(k, 0.0), CLUSTER)) for k in range(400)]
    assert 1 <= sum(rejected) <= 10


def test_effects_and_free_parameters_are_ignored() -> None:
    fit = at_a_bound(0, 0.3)
    fit.names = ["terms.0.v0", "terms.1.kappa"]
    assert required_beyond_bounds(fit, CLUSTER) == set()
    fit.names, fit.free[1] = NAMES, True
    assert required_beyond_bounds(fit, CLUSTER) == set()


def test_bounds_reached_with_effects_only() -> None:
    fit = at_a_bound(0, -0.3)
    assert parameters_at_bounds(fit.system, fit, ENGINE, 0) == set()
    base, people = lin(), lin()
    people.domain = "crowd"
    with torch.no_grad():
        fit.system.terms[0].L.fill_(base.terms[0].bounds["L"].low)
    assert parameters_at_bounds(base, fit, ENGINE, 0) == {"lin.L"}
    assert parameters_at_bounds(people, fit, ENGINE, 0) == set()
    assert parameters_at_bounds(fit.system, fit, ENGINE, 0) == set()


def test_mean_scores_of_simulated_paths_are_subtracted() -> None:
    """The same fit as its own simulation has the same bias."""
    fit = at_a_bound(0, 0.3)
    assert required_beyond_bounds(fit, CLUSTER) == {"lin.L"}
    assert required_beyond_bounds(fit, CLUSTER, [fit]) == set()
    unbiased = replace(fit, residual=np.zeros_like(fit.residual))
    assert required_beyond_bounds(fit, CLUSTER, [unbiased, unbiased]) == {"lin.L"}
