"""Nonparametric curves of the deviations over each variable."""

from __future__ import annotations

import copy
from dataclasses import replace
from functools import partial

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.data.clusters import group_sums
from nnode.diagnosis import thresholds
from nnode.diagnosis.residuals.engine import Engine, square_of
from nnode.diagnosis.residuals.fit import ROUGH, Fit, grams, refine
from nnode.diagnosis.residuals.variables import Curve, Curves, Variable
from nnode.diagnosis.statistics.bias import mean_scores, simulated_fits
from nnode.diagnosis.statistics.paired import compare, heldout
from nnode.diagnosis.statistics.score import Screen, at_least
from nnode.errors import SimulationError
from nnode.model.system import System
from nnode.model.term import State

#: Approximate numbers of bends of a curve, which set the strengths of smoothing.
BENDS = (2, 5, 12)
#: Ridge of the heights, as a share of their mean information.
RIDGE = 1e-3
#: Number of sign flips of curves' p-values; it is large because there are many curves.
FLIPS = 7999
#: Largest number of curves that are calibrated with the model, the best first.
MOST = 6
#: Ridge against rounding, as a share of the total information.
UNKNOWN = 1e-9
#: Number of waves that are fitted at once.
WAVES = 16


def columns_of(engine: Engine, fit: Fit, variable: Variable) -> np.ndarray:
    """``(n, M)`` derivatives of the residuals by the curve's coefficients."""

    def rates(state: State) -> list[Tensor]:
        weights, direction = variable.weights(state), variable.direction(state)
        return list((weights.movedim(-1, 0)[..., None] * direction).unbind())

    columns: np.ndarray = engine.response(fit.system, torch.from_numpy(fit.row), rates).numpy().T
    return columns


def curves(engine: Engine, fit: Fit, variables: list[Variable], seed: int = 0) -> list[Curves]:
    """The best curve or wave of every variable, ordered by decreasing gain; cached in the fit.

    Args:
        seed: of the sign flips, see :mod:`nnode.diagnosis.statistics.score`.
    """
    if fit.curves is None:
        fit.curves = _curves(engine, fit, variables, seed)
    return fit.curves


def _curves(engine: Engine, fit: Fit, variables: list[Variable], seed: int) -> list[Curves]:
    if not variables:
        return []
    screen = Screen(fit, engine.cluster, seed, FLIPS)
    before = heldout(fit, engine.cluster)
    fits = [_CurveFits(engine, fit, screen, variable) for variable in variables]
    every = np.stack([squares for variable_fit in fits for squares in variable_fit.squares])
    share = np.stack([at_least(row) for row in every])
    smallest = share.min(0)
    best_curves, offset = [], 0
    simulated: list[tuple[Engine, Fit]] | None = None
    for variable_fit in fits:
        p_curve = share[offset : offset + len(variable_fit.squares), 0].min()
        offset += len(variable_fit.squares)
        p_value = float((smallest <= p_curve + 1e-12).mean())
        if p_value < thresholds.STRICT and not variable_fit.variable.lengths:
            simulated = simulated_fits(engine, fit, seed) if simulated is None else simulated
            columns = partial(columns_of, variable=variable_fit.variable)
            bias = mean_scores(simulated, columns, engine.cluster)
            corrected = _CurveFits(engine, fit, screen, variable_fit.variable, bias)
            p_curve = min(at_least(row)[0] for row in corrected.squares)
            p_value = max(p_value, float((smallest <= p_curve + 1e-12).mean()))
        best_curves.append(variable_fit.best(before, p_value))
    return sorted(best_curves, key=lambda curve: -curve.gain.gain)


class _CurveFits:
    """All curves of one variable.

    Args:
        bias: ``(G, M)`` bias of the scores of a curve's coefficients.

    Attributes:
        squares: per kind of curve ``(F,)`` explained squares in the data and under sign flips: one
            kind per strength of smoothing, or the best of all waves.
    """

    def __init__(
        self,
        engine: Engine,
        fit: Fit,
        screen: Screen,
        variable: Variable,
        bias: np.ndarray | float = 0.0,
    ) -> None:
        self.engine, self.fit, self.variable, self.bias = engine, fit, variable, bias
        self.screen, self.squares = screen, list[np.ndarray]()
        if variable.lengths:
            self._fit_waves()
        else:
            self._fit_smooth_curves()
        # the columns of all variables would need too much memory
        self.grams = grams(self.z, engine.cluster)
        del self.z

    def _null_scores(self, variable: Variable) -> tuple[np.ndarray, np.ndarray]:
        """Columns of a variable's coefficients, and their scores ``(F, M)`` under sign flips."""
        columns = columns_of(self.engine, self.fit, variable)
        self.z = self.screen.adjusted(columns)
        parts = self.screen.parts(self.z, self.engine.cluster) - self.bias
        return columns, self.screen.flipped(parts)

    def _store_scores(self, columns: np.ndarray) -> None:
        """Store the scores of the coefficients with these columns."""
        self.parts = group_sums(self.z, self.engine.cluster, self.fit.residual) - self.bias
        self.absorbed = np.linalg.lstsq(self.fit.jacobian, columns, rcond=1e-9)[0]

    def _fit_smooth_curves(self) -> None:
        columns, total = self._null_scores(self.variable)
        self._store_scores(columns)
        whole = self.z.T @ self.z
        number = len(whole)
        bend = np.diff(np.eye(number), 2, axis=0)
        size = max(float(np.trace(whole)) / number, 1e-300)
        self.penalties = []
        for bends in BENDS:
            smooth = (number / (np.pi * bends)) ** 4 * bend.T @ bend
            self.penalties.append(size * (smooth + RIDGE * np.eye(number)))
            solved = np.linalg.solve(whole + self.penalties[-1], total.T)
            self.squares.append((total.T * solved).sum(0))

    def _fit_waves(self) -> None:
        """Fit waves in blocks, because there may be many, and keep the best one."""
        lengths, best = self.variable.lengths, 0
        largest, best_square = np.full(0, -np.inf), -np.inf
        for first in range(0, len(lengths), WAVES):
            block = replace(self.variable, lengths=lengths[first : first + WAVES])
            squares = self._squares(self._null_scores(block)[1])
            if squares[0].max() > best_square:
                best, best_square = first + int(np.argmax(squares[0])), squares[0].max()
            squares_max = squares.max(1)
            largest = np.maximum(largest, squares_max) if len(largest) else squares_max
        self.squares.append(largest)
        self.variable = self.variable.wave(best)
        self._store_scores(self._null_scores(self.variable)[0])
        self.penalties = [np.zeros((2, 2))]

    def _squares(self, total: np.ndarray) -> np.ndarray:
        """``(F, waves)`` explained squares under sign flips, from the scores ``(F, 2 waves)``."""
        sine, cosine = self.z[:, ::2], self.z[:, 1::2]
        a, b = (sine**2).sum(0), (sine * cosine).sum(0)
        c = (cosine**2).sum(0)
        determinant = np.maximum(a * c - b**2, 1e-12 * (a * c + 1e-300))
        s, t = total[:, ::2], total[:, 1::2]
        explained: np.ndarray = (c * s**2 - 2 * b * s * t + a * t**2) / determinant
        return explained

    def best(self, before: np.ndarray, p_value: float) -> Curves:
        """The curve with the smoothing that predicts best.

        Args:
            before: ``(G,)`` held-out costs without a curve.
            p_value: corrected for all variables.
        """
        label = self.engine.cluster
        plain = group_sums(self.fit.residual**2, label)
        count, number = len(plain), self.grams.shape[1]
        gram, score = self.grams, -self.parts
        whole, total = gram.sum(0), score.sum(0)
        change, penalty = np.full(count, np.inf), self.penalties[0]
        for penalised in self.penalties:
            # a direction that only one cluster identifies cannot be predicted by the others
            penalised = penalised + UNKNOWN * np.trace(whole) * np.eye(number)
            heights = np.linalg.solve(whole - gram + penalised, (total - score)[..., None])[..., 0]
            new = np.einsum("sm,smn,sn->s", heights, gram, heights) - 2 * (heights * score).sum(1)
            if new.sum() < change.sum():
                change, penalty = new, penalised
        # relative to the model's own held-out cost
        losses = before * np.maximum(1 + change / np.maximum(plain, 1e-300), 0.0)
        inverse = np.linalg.inv(whole + penalty)
        amounts = inverse @ total
        shape = self.variable.heights(np.eye(number))
        residual_scores = score - np.einsum("gmn,n->gm", gram, amounts)
        residual_scores = residual_scores * np.sqrt(count / max(count - 1, 1))
        cov = shape @ inverse @ (residual_scores.T @ residual_scores) @ inverse @ shape.T
        return Curves(
            variable=self.variable,
            amounts=amounts,
            heights=shape @ amounts,
            errors=np.sqrt(np.maximum(np.diag(cov), 1e-300)),
            losses=losses,
            gain=compare(before, losses),
            p_value=p_value,
            shift=-self.absorbed @ amounts,
        )


def with_curve(fit: Fit, curve: Curves) -> System:
    """A model with a curve as one more term, and its parameters changed accordingly."""
    extended = copy.deepcopy(fit.system)
    vector = ParameterVector(extended)
    vector.fill_(np.clip(fit.row + curve.shift, *vector.bounds))
    extended.terms.append(Curve(curve.variable, curve.amounts))
    return extended


def significant_curves(
    engine: Engine, fit: Fit, candidates: list[Curves], alpha: float
) -> list[Curves]:
    """The curves that are significant at level ``alpha``, with the shares that they remove.

    The linear response overshoots if a curve is strong, so its scale is calibrated with the model.
    """
    before = square_of(engine, fit.system)
    significant: list[Curves] = []
    for curve in candidates:
        if curve.p_value >= alpha or curve.gain.gain <= 0:
            continue
        if len(significant) == MOST:
            break
        try:
            system = refine(engine, with_curve(fit, curve), tolerance=ROUGH).system
            removed = 1 - square_of(engine, system) / before
            relevant = engine.relevant(fit.system, system, before)
        except SimulationError:
            continue
        significant.append(replace(curve, removed=removed, relevant=relevant))
    return sorted(significant, key=lambda curve: -curve.removed)


def tail(curve: Curves, number: int) -> np.ndarray:
    """Two-sided p-values of a curve's heights by Student's t, corrected for ``number`` of them."""
    degrees = max(curve.clusters - 1, 1)
    p_values: np.ndarray = np.minimum(
        1.0, 2 * stats.t.sf(np.abs(curve.statistic), degrees) * number
    )
    return p_values
