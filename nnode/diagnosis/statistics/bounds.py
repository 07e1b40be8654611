"""Whether a law whose parameters are at bounds can be the law of the data.

Effects that lead parameters of the law to their bounds replace a part of the law. And where the
cost still falls significantly toward values that are not admissible, the law is wrong in a way that
no admissible value describes. Both concern the law, whichever effects were selected.

Source: Silvey 1959 (the Lagrange multiplier test).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nnode.calibrate.intervals import at_bounds
from nnode.data.clusters import better, group_sums
from nnode.diagnosis import thresholds
from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.statistics.bias import simulated_fits
from nnode.diagnosis.statistics.leverage import leverage_adjusted, orthonormal, without_span
from nnode.model.system import System
from nnode.model.term import physical_bounds


def parameters_at_bounds(base: System, fit: Fit, engine: Engine, seed: int) -> set[str]:
    """Names of the law's parameters whose bounds show that the law is wrong: those that are at
    bounds only with the effects, and those for which values beyond are required.

    In crowds, only the latter count: laws of people contain simpler ones at bounds, such as the
    circular force in ``esf``, to which an effect leads if they are true. There they must also be
    required without the bias of the scores, because people react to each other.

    Args:
        base: the calibrated model without effects.
        fit: the calibrated model with effects.
        engine: of the residuals.
        seed: of the simulations that estimate the bias.
    """
    required = required_beyond_bounds(fit, engine.cluster)
    if base.domain == "crowd":
        if required:
            simulated = [each for _, each in simulated_fits(engine, fit, seed)]
            required &= required_beyond_bounds(fit, engine.cluster, simulated)
        return required
    return required | (_at_bounds(fit.system) - _at_bounds(base))


def _at_bounds(system: System) -> set[str]:
    limits, prefix = physical_bounds(system), f"{system.term_list[0].name}."
    values = {
        name: float(x) for name, (x, _) in system.physical().items() if name.startswith(prefix)
    }
    return {
        name
        for name, x in values.items()
        if at_bounds(x, limits[name].low, limits[name].high, 1e-6 + 1e-3 * abs(x)) != ""
    }


def required_beyond_bounds(
    fit: Fit, cluster: np.ndarray, simulated: Sequence[Fit] = ()
) -> set[str]:
    """Names of the law's parameters at bounds with a significant score toward values beyond.

    The one-sided p-value by sign flips of clusters, multiplied by the number of these parameters,
    is at most :data:`~nnode.diagnosis.thresholds.STRICT`.

    Args:
        fit: a calibrated model, whose first term is the law.
        cluster: ``(n,)`` see :class:`~nnode.diagnosis.residuals.engine.Engine`.
        simulated: the same model in its own simulated paths, whose mean scores are subtracted.
    """
    held = [
        k
        for k, name in enumerate(fit.names)
        if name.startswith("terms.0.") and not fit.free[k] and fit.jacobian[:, k].any()
    ]
    if not held:
        return set()
    scores = _scores(fit, fit.free, held, cluster)
    if simulated:
        scores = scores - np.mean([_scores(each, fit.free, held, cluster) for each in simulated], 0)
    # the cost falls against the gradient
    scores = scores * np.sign(fit.jacobian[:, held].T @ fit.residual)
    law = fit.system.term_list[0].name
    return {
        f"{law}.{fit.names[k].removeprefix('terms.0.')}"
        for k, score in zip(held, scores.T, strict=True)
        if len(held) * better(score) <= thresholds.STRICT
    }


def _scores(fit: Fit, free: np.ndarray, held: list[int], cluster: np.ndarray) -> np.ndarray:
    """``(G, H)`` scores of parameters that are held, by cluster."""
    basis = orthonormal(fit.jacobian[:, free])
    residual = leverage_adjusted(fit.residual, basis, cluster)
    return group_sums(without_span(fit.jacobian[:, held], basis) * residual[:, None], cluster)
