"""What a deviation may depend on, and how much of it there is: curves without a formula."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from nnode.discover.compare import Comparison, compare, heldout
from nnode.discover.engine import Engine
from nnode.discover.fit import Fit, sums
from nnode.discover.score import Screen
from nnode.models.term import State

#: Strengths of smoothing of a curve, relative to its information, that are tried.
RIDGES = (1e-3, 1e-2, 1e-1, 1.0)


@dataclass(frozen=True)
class Variable:
    """Something that a deviation may depend on.

    Attributes:
        name: in words.
        unit: of its values.
        value: of a state, ``(B, N)``.
        knots: values at which a curve has a number of its own, linear in between; outside of
            them it is constant.
        direction: of a state, ``(B, N, D)``: the deviation is a number times this.
        level: names of the direction, for pages.
    """

    name: str
    unit: str
    value: Callable[[State], Tensor]
    knots: tuple[float, ...]
    direction: Callable[[State], Tensor]
    level: str = ""


def hats(value: Tensor, knots: tuple[float, ...]) -> Tensor:
    """``(..., M)`` weights of the M knots in a curve that is linear between them."""
    at = torch.tensor(knots, dtype=value.dtype)
    inside = value.clamp(float(at[0]), float(at[-1]))[..., None]
    left, right = at[:-1], at[1:]
    share = ((inside - left) / (right - left)).clamp(0, 1)
    one = torch.ones_like(share[..., :1])
    return torch.cat([one, share], -1) - torch.cat([share, 0 * one], -1)


def knots_of(values: np.ndarray, most: int = 9) -> tuple[float, ...]:
    """Quantiles of observed values, apart from each other; two at least."""
    found = np.unique(np.quantile(values, np.linspace(0.01, 0.99, most)).round(6))
    wide = 1e-3 * max(float(np.ptp(values)), 1e-9)
    kept = [found[0]]
    for knot in found[1:]:
        if knot - kept[-1] > wide:
            kept.append(knot)
    if len(kept) < 2:
        kept = [kept[0], kept[0] + 1.0]
    return tuple(float(knot) for knot in kept)


@dataclass
class Curves:
    """A curve of one variable in the residuals of a calibrated model.

    Attributes:
        variable: see :class:`Variable`.
        heights, errors: at the knots, beyond what the model can do, m/s or m/s².
        gain: over the model without it, held out by sequence.
        p_value: that it is no better, for this variable alone.
        statistic: ``(M,)`` of each knot, in its standard error.
    """

    variable: Variable
    heights: np.ndarray
    errors: np.ndarray
    gain: Comparison
    statistic: np.ndarray

    @property
    def p_value(self) -> float:
        """One-sided, of the held-out gain."""
        return self.gain.p_value


def columns_of(engine: Engine, fit: Fit, variable: Variable) -> np.ndarray:
    """``(n, M)`` changes of the residuals per unit of the curve's heights."""

    def rates(state: State) -> list[Tensor]:
        weights, way = hats(variable.value(state), variable.knots), variable.direction(state)
        return [weight[..., None] * way for weight in weights.unbind(-1)]

    return engine.response(fit.system, torch.from_numpy(fit.row), rates).numpy().T


def curves(engine: Engine, fit: Fit, variables: list[Variable]) -> list[Curves]:
    """The curve of every variable by itself, the one that explains most first."""
    screen = Screen(fit, engine.block)
    before = heldout(fit, engine.sequence)
    found = [_curve(engine, fit, screen, before, variable) for variable in variables]
    return sorted(found, key=lambda one: -one.gain.gain)


def _curve(
    engine: Engine, fit: Fit, screen: Screen, before: np.ndarray, variable: Variable
) -> Curves:
    z = screen.beyond(columns_of(engine, fit, variable))
    sequence = engine.sequence
    count = int(sequence.max()) + 1
    gram = np.zeros((count, z.shape[1], z.shape[1]))
    score = np.zeros((count, z.shape[1]))
    for s in range(count):
        own = sequence == s
        gram[s], score[s] = z[own].T @ z[own], -z[own].T @ fit.residual[own]
    whole, total = gram.sum(0), score.sum(0)
    size = float(np.trace(whole)) / len(whole)
    plain = sums(fit.residual**2, sequence)
    best: np.ndarray | None = None
    chosen = RIDGES[0]
    for ridge in RIDGES:
        penalty = ridge * size * np.eye(len(whole))
        heights = np.linalg.solve(whole - gram + penalty, (total - score)[..., None])[..., 0]
        change = np.einsum("sm,smn,sn->s", heights, gram, heights) - 2 * (heights * score).sum(1)
        if best is None or change.sum() < best.sum():
            best, chosen = change, ridge
    assert best is not None
    # relative to the model's own held-out cost
    losses = before * np.maximum(1 + best / np.maximum(plain, 1e-300), 0.0)
    inverse = np.linalg.inv(whole + chosen * size * np.eye(len(whole)))
    heights = inverse @ total
    blocks = sums(z * fit.residual[:, None], engine.block)
    errors = np.sqrt(np.maximum(np.diag(inverse @ (blocks.T @ blocks) @ inverse), 1e-300))
    return Curves(variable, heights, errors, compare(before, losses), heights / errors)


def significant(found: list[Curves], alpha: float, floor: float) -> list[Curves]:
    """The curves that remove more than ``floor`` of the held-out cost, with regard to all
    variables that were looked at."""
    share = alpha / max(1, len(found))
    return [
        one for one in found
        if one.gain.gain > floor and one.p_value < share and one.gain.low > 0
    ]  # fmt: skip


def normal_tail(statistic: np.ndarray, number: int) -> np.ndarray:
    """Two-sided p-values of standardised heights, corrected for ``number`` of them."""
    found: np.ndarray = np.minimum(1.0, 2 * stats.norm.sf(np.abs(statistic)) * number)
    return found
