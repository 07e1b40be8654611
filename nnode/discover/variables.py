"""What a deviation may depend on, and how much of it there is: curves without a formula."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy import stats
from torch import Tensor

from nnode.discover.compare import Comparison, compare, heldout
from nnode.discover.engine import Engine, fill, square_of
from nnode.discover.fit import ROUGH, Fit, grams, limits, refine, sums
from nnode.discover.score import Screen, at_least
from nnode.errors import SimulationError
from nnode.models.system import System
from nnode.models.term import Interval, State, Term

#: A curve may bend about so many times; several are tried.
BENDS = (2, 5, 12)
#: Heights are drawn to zero by this share of their mean information.
RIDGE = 1e-3
#: Sign flips that p-values of curves come from: there are many curves.
FLIPS = 7999
#: At most so many curves are calibrated with the model, those that predict best.
MOST = 6
#: A share of the knowledge of a height that is none, but for rounding.
UNKNOWN = 1e-9
#: Columns that are computed at once.
CHUNK = 128
#: Knots over which a wave is reported, and its lengths that they span.
WAVE_KNOTS, WAVES = 17, 2.0


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
        lengths: of waves, in ``unit``, that are looked for in place of a curve.
    """

    name: str
    unit: str
    value: Callable[[State], Tensor]
    knots: tuple[float, ...]
    direction: Callable[[State], Tensor]
    level: str = ""
    lengths: tuple[float, ...] = ()

    def weights(self, state: State) -> Tensor:
        """``(B, N, M)`` of the M heights of a curve, or sine and cosine of every wave."""
        value = self.value(state)
        if self.lengths:
            turn = 2 * torch.pi / torch.tensor(self.lengths, dtype=value.dtype)
            angle = value[..., None] * turn
            return torch.stack([angle.sin(), angle.cos()], -1).flatten(-2)
        return hats(value, self.knots)

    def wave(self, number: int) -> Variable:
        """One wave alone."""
        length = self.lengths[number]
        first = self.knots[0]
        knots = tuple(first + float(s) * length for s in np.linspace(0, WAVES, WAVE_KNOTS))
        return replace(self, lengths=(length,), knots=knots)

    def heights(self, amounts: np.ndarray) -> np.ndarray:
        """``(knots, ...)`` a curve at the knots by the amounts ``(M, ...)`` of its weights."""
        if not self.lengths:
            return amounts
        turn = 2 * np.pi * np.array(self.knots) / self.lengths[0]
        found: np.ndarray = np.stack([np.sin(turn), np.cos(turn)], 1) @ amounts
        return found


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


def clock(state: State) -> Tensor:
    """``(B, N)`` s: the time of the recording."""
    return (state.scene.start + state.t)[:, None].expand(state.x.shape[:2])


def since_start(first: dict[str, float]) -> Callable[[State], Tensor]:
    """``(B, N)`` s: the time since the first sample of the sequence.

    Args:
        first: clock time of that sample, s, by the sequence's name.
    """

    def value(state: State) -> Tensor:
        start = torch.tensor([first[name] for name in state.scene.names], dtype=state.x.dtype)
        return (state.scene.start - start + state.t)[:, None].expand(state.x.shape[:2])

    return value


def lengths_of(shortest: float, longest: float, span: float, most: int = 600) -> tuple[float, ...]:
    """Lengths of waves that data over ``span`` tell apart; the shorter ones are left out where
    there are too many."""
    if not span > 0:
        return ()
    low, high = 1 / min(longest, span / 2), 1 / shortest
    number = min(int((high - low) * 2 * span), most)
    return tuple(1 / (low + k / (2 * span)) for k in range(number))


def waves_of(
    name: str,
    unit: str,
    value: Callable[[State], Tensor],
    seen: Tensor,
    between: tuple[float, float],
    directions: dict[str, Callable[[State], Tensor]],
) -> list[Variable]:
    """Waves of a variable in each direction; none where the data span too little of it.

    Args:
        seen: values that occur.
        between: the shortest and the longest wave.
        directions: by level, see :class:`Variable`.
    """
    low, high = float(seen.min()), float(seen.max())
    lengths = lengths_of(*between, high - low)
    return [
        Variable(f"waves of {name}", unit, value, (low, high), direction, level, lengths)
        for level, direction in directions.items() if lengths
    ]  # fmt: skip


@dataclass
class Curves:
    """A curve of one variable in the residuals of a calibrated model.

    Attributes:
        variable: see :class:`Variable`; the best wave of several.
        amounts: ``(M,)`` of the variable's weights, beyond what the model can do.
        heights, errors: at the knots, m/s or m/s².
        losses: ``(G,)`` held-out costs with the curve.
        gain: over the model without it.
        p_value: that there is nothing, with regard to all variables.
        shift: ``(K,)`` of the model's own parameters beside the curve.
        removed: share of the squared errors of positions that it removes; NaN until it is asked
            for, see :func:`weighed`.
    """

    variable: Variable
    amounts: np.ndarray
    heights: np.ndarray
    errors: np.ndarray
    losses: np.ndarray
    gain: Comparison
    p_value: float
    shift: np.ndarray
    removed: float = float("nan")

    @property
    def clusters(self) -> int:
        """That the curve was compared on."""
        return len(self.losses)

    @property
    def statistic(self) -> np.ndarray:
        """Of each knot, in its standard error."""
        found: np.ndarray = self.heights / self.errors
        return found


class Curve(Term):
    """A curve as a term of a model: the flexible fit of what is left."""

    name = "curve"
    formula = "f(variable)"
    source = "a curve without a formula, fitted to what a model leaves"

    def __init__(self, variable: Variable, amounts: np.ndarray) -> None:
        super().__init__()
        self.variable = variable
        self.amounts = torch.from_numpy(amounts)
        self.declare("scale", 1.0, unit="1", bounds=Interval(0.0, 2.0))
        self.scale: Tensor

    def forward(self, state: State) -> Tensor:
        amount = self.scale * (self.variable.weights(state) @ self.amounts)
        return amount[..., None] * self.variable.direction(state)


def columns_of(engine: Engine, fit: Fit, variable: Variable) -> np.ndarray:
    """``(n, M)`` changes of the residuals per unit of the curve's weights."""
    total = 2 * len(variable.lengths) or len(variable.knots)
    row, found = torch.from_numpy(fit.row), []
    for first in range(0, total, CHUNK):
        part = slice(first, first + CHUNK)

        def rates(state: State, part: slice = part) -> list[Tensor]:
            weights, way = variable.weights(state)[..., part], variable.direction(state)
            return [weight[..., None] * way for weight in weights.unbind(-1)]

        found.append(engine.response(fit.system, row, rates).numpy().T)
    return np.concatenate(found, 1)


def curves(engine: Engine, fit: Fit, variables: list[Variable], seed: int = 0) -> list[Curves]:
    """The best curve or wave of every variable, the one that explains most first.

    They are kept with the fit, which is looked at more than once.

    Args:
        seed: of the sign flips, see :mod:`nnode.discover.score`.
    """
    if fit.curves is None:
        fit.curves = _curves(engine, fit, variables, seed)
    return fit.curves


def _curves(engine: Engine, fit: Fit, variables: list[Variable], seed: int) -> list[Curves]:
    if not variables:
        return []
    screen = Screen(fit, engine.cluster, seed, FLIPS)
    before = heldout(fit, engine.cluster)
    looks = [_Look(engine, fit, screen, variable) for variable in variables]
    every = np.stack([squares for look in looks for squares in look.squares])
    share = np.stack([at_least(row) for row in every])
    least = share.min(0)
    found, first = [], 0
    for look in looks:
        own = share[first : first + len(look.squares), 0].min()
        first += len(look.squares)
        found.append(look.best(before, float((least <= own + 1e-12).mean())))
    return sorted(found, key=lambda one: -one.gain.gain)


class _Look:
    """All curves of one variable.

    Attributes:
        squares: per kind of curve ``(F,)`` what it explains in the data and under sign flips:
            of a curve one per strength of smoothing, of waves the largest of all.
    """

    def __init__(self, engine: Engine, fit: Fit, screen: Screen, variable: Variable) -> None:
        self.engine, self.fit, self.variable = engine, fit, variable
        columns = columns_of(engine, fit, variable)
        self.z = screen.beyond(columns)
        self.parts = sums(self.z * fit.residual[:, None], engine.cluster)
        self.total = screen.flipped(screen.parts(self.z, engine.cluster))
        self.absorbed = np.linalg.lstsq(fit.jacobian, columns, rcond=1e-9)[0]
        self.squares: list[np.ndarray] = []
        if variable.lengths:
            self._look_for_waves()
        else:
            self._look_for_curves()

    def _look_for_curves(self) -> None:
        whole = self.z.T @ self.z
        number = len(whole)
        bend = np.diff(np.eye(number), 2, axis=0)
        size = max(float(np.trace(whole)) / number, 1e-300)
        self.penalties = []
        for bends in BENDS:
            smooth = (number / (np.pi * bends)) ** 4 * bend.T @ bend
            self.penalties.append(size * (smooth + RIDGE * np.eye(number)))
            solved = np.linalg.solve(whole + self.penalties[-1], self.total.T)
            self.squares.append((self.total.T * solved).sum(0))

    def _look_for_waves(self) -> None:
        z, total = self.z, self.total
        sine, cosine = z[:, ::2], z[:, 1::2]
        a, b = (sine**2).sum(0), (sine * cosine).sum(0)
        c = (cosine**2).sum(0)
        determinant = np.maximum(a * c - b**2, 1e-12 * (a * c + 1e-300))
        s, t = total[:, ::2], total[:, 1::2]
        squares = (c * s**2 - 2 * b * s * t + a * t**2) / determinant
        self.squares.append(squares.max(1))
        best = int(np.argmax(squares[0]))
        own = slice(2 * best, 2 * best + 2)
        self.variable = self.variable.wave(best)
        self.z, self.parts, self.absorbed = z[:, own], self.parts[:, own], self.absorbed[:, own]
        self.penalties = [np.zeros((2, 2))]

    def best(self, before: np.ndarray, p_value: float) -> Curves:
        """With the smoothing that predicts best.

        Args:
            before: ``(G,)`` held-out costs without a curve.
            p_value: with regard to all variables.
        """
        label = self.engine.cluster
        plain = sums(self.fit.residual**2, label)
        count, number = len(plain), self.z.shape[1]
        gram, score = grams(self.z, label), -self.parts
        whole, total = gram.sum(0), score.sum(0)
        change, penalty = np.full(count, np.inf), self.penalties[0]
        for tried in self.penalties:
            # what one cluster alone knows of cannot be predicted by the others
            tried = tried + UNKNOWN * np.trace(whole) * np.eye(number)
            heights = np.linalg.solve(whole - gram + tried, (total - score)[..., None])[..., 0]
            new = np.einsum("sm,smn,sn->s", heights, gram, heights) - 2 * (heights * score).sum(1)
            if new.sum() < change.sum():
                change, penalty = new, tried
        # relative to the model's own held-out cost
        losses = before * np.maximum(1 + change / np.maximum(plain, 1e-300), 0.0)
        inverse = np.linalg.inv(whole + penalty)
        amounts = inverse @ total
        shape = self.variable.heights(np.eye(number))
        rest = score - np.einsum("gmn,n->gm", gram, amounts)
        rest = rest * np.sqrt(count / max(count - 1, 1))
        cov = shape @ inverse @ (rest.T @ rest) @ inverse @ shape.T
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
    """A model with a curve as one more term, its own parameters moved to make room for it."""
    found = copy.deepcopy(fit.system)
    low, high = limits(found)
    fill(found, torch.from_numpy(np.clip(fit.row + curve.shift, low, high)))
    found.terms.append(Curve(curve.variable, curve.amounts))
    return found


def weighed(engine: Engine, fit: Fit, found: list[Curves], alpha: float) -> list[Curves]:
    """The curves that are no chance at probability ``alpha``, with what they remove.

    The linear response overshoots where a curve is strong: its scale is calibrated with the
    model.
    """
    before = square_of(engine, fit.system)
    sure: list[Curves] = []
    for one in found:
        if one.p_value >= alpha or one.gain.gain <= 0:
            continue
        if len(sure) == MOST:
            break
        try:
            after = square_of(engine, refine(engine, with_curve(fit, one), tolerance=ROUGH).system)
        except SimulationError:
            continue
        sure.append(replace(one, removed=1 - after / before))
    return sorted(sure, key=lambda one: -one.removed)


def tail(one: Curves, number: int) -> np.ndarray:
    """Two-sided p-values of a curve's heights by Student's t, corrected for ``number`` of them."""
    degrees = max(one.clusters - 1, 1)
    found: np.ndarray = np.minimum(1.0, 2 * stats.t.sf(np.abs(one.statistic), degrees) * number)
    return found
