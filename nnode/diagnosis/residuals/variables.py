"""Variables on which deviations may depend, and curves and waves of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from nnode.diagnosis.residuals.comparison import Comparison
from nnode.model.term import Interval, State, Term

#: Number of knots over which a wave is reported, and the number of wavelengths that they span.
WAVE_KNOTS, WAVES = 17, 2.0


@dataclass(frozen=True)
class Variable:
    """A variable on which a deviation may depend.

    Attributes:
        name: in words.
        unit: of its values.
        value: of a state, ``(B, N)``.
        knots: of the piecewise linear curve, which is constant outside of them.
        direction: of a state, ``(B, N, D)``: the deviation is the curve times this.
        level: name of the direction, for pages.
        lengths: wavelengths, in ``unit``, if waves are fitted in place of a curve.
    """

    name: str
    unit: str
    value: Callable[[State], Tensor]
    knots: tuple[float, ...]
    direction: Callable[[State], Tensor]
    level: str = ""
    lengths: tuple[float, ...] = ()

    def weights(self, state: State) -> Tensor:
        """``(B, N, M)`` basis functions: hats at the knots, or sine and cosine of every wave."""
        value = self.value(state)
        if self.lengths:
            turn = 2 * torch.pi / torch.tensor(self.lengths, dtype=value.dtype)
            # a clock is the same for all agents
            values = value[..., :1] if value.stride(-1) == 0 else value
            angle = values[..., None] * turn
            waves = torch.stack([angle.sin(), angle.cos()], -1).flatten(-2)
            return waves.expand(*value.shape, -1)
        return hats(value, self.knots)

    def wave(self, number: int) -> Variable:
        """One wave alone."""
        length = self.lengths[number]
        start = self.knots[0]
        knots = tuple(start + float(s) * length for s in np.linspace(0, WAVES, WAVE_KNOTS))
        return replace(self, lengths=(length,), knots=knots)

    def curve(self, value: Tensor, amounts: Tensor) -> Tensor:
        """The curve with coefficients ``(M,)``, at values of any shape."""
        if self.lengths:
            turn = 2 * torch.pi / torch.tensor(self.lengths, dtype=value.dtype)
            angle = value[..., None] * turn
            return angle.sin() @ amounts[::2] + angle.cos() @ amounts[1::2]
        knots = torch.tensor(self.knots, dtype=value.dtype)
        slope = nn.functional.pad(amounts.diff() / knots.diff(), (1, 1))
        part = torch.bucketize(value.detach().contiguous(), knots)
        left = (part - 1).clamp(min=0)
        return amounts[left] + slope[part] * (value - knots[left])

    def heights(self, amounts: np.ndarray) -> np.ndarray:
        """``(knots, ...)`` the curve with coefficients ``(M, ...)`` at the knots."""
        if not self.lengths:
            return amounts
        turn = 2 * np.pi * np.array(self.knots) / self.lengths[0]
        heights: np.ndarray = np.stack([np.sin(turn), np.cos(turn)], 1) @ amounts
        return heights


class Curve(Term):
    """A curve as the last term of a model: a nonparametric fit of unexplained structure."""

    name = "curve"
    formula = "f(variable)"
    source = "a curve without a formula, fitted to what a model leaves"
    side_by_side = True

    def __init__(self, variable: Variable, amounts: np.ndarray) -> None:
        super().__init__()
        self.variable = variable
        self.amounts = torch.from_numpy(amounts)
        self.declare("scale", 1.0, unit="1", bounds=Interval(0.0, 2.0))
        self.scale: Tensor

    def forward(self, state: State) -> Tensor:
        height = self.variable.curve(self.variable.value(state), self.amounts)
        return self.scale * height[..., None] * self.variable.direction(state)


def hats(value: Tensor, knots: tuple[float, ...]) -> Tensor:
    """``(..., M)`` hat functions of M knots."""
    at = torch.tensor(knots, dtype=value.dtype)
    inside = value.clamp(float(at[0]), float(at[-1]))[..., None]
    left, right = at[:-1], at[1:]
    share = ((inside - left) / (right - left)).clamp(0, 1)
    ones = torch.ones_like(share[..., :1])
    return torch.cat([ones, share], -1) - torch.cat([share, 0 * ones], -1)


def knots_of(values: np.ndarray, n_quantiles: int = 9) -> tuple[float, ...]:
    """At least two distinct quantiles of observed values."""
    quantiles = np.unique(np.quantile(values, np.linspace(0.01, 0.99, n_quantiles)).round(6))
    separation = 1e-3 * max(float(np.ptp(values)), 1e-9)
    kept = [quantiles[0]]
    for knot in quantiles[1:]:
        if knot - kept[-1] > separation:
            kept.append(knot)
    if len(kept) < 2:
        kept = [kept[0], kept[0] + 1.0]
    return tuple(float(knot) for knot in kept)


def clock(state: State) -> Tensor:
    """``(B, N)`` s: the time of the recording."""
    return (state.scene.start + state.t)[:, None].expand(state.x.shape[:2])


def since_start(start_of: dict[str, float]) -> Callable[[State], Tensor]:
    """``(B, N)`` s: the time since the first sample of the sequence.

    Args:
        start_of: clock time of that sample, s, by the sequence's name.
    """

    def value(state: State) -> Tensor:
        start = torch.tensor([start_of[name] for name in state.scene.names], dtype=state.x.dtype)
        return (state.scene.start - start + state.t)[:, None].expand(state.x.shape[:2])

    return value


def lengths_of(
    shortest: float, longest: float, span: float, max_number: int = 600
) -> tuple[float, ...]:
    """Wavelengths that data over ``span`` can distinguish; the shortest are left out if there are
    too many."""
    if not span > 0:
        return ()
    low, high = 1 / min(longest, span / 2), 1 / shortest
    number = min(int((high - low) * 2 * span), max_number)
    return tuple(1 / (low + k / (2 * span)) for k in range(number))


def waves_of(
    name: str,
    unit: str,
    value: Callable[[State], Tensor],
    observed: Tensor,
    length_range: tuple[float, float],
    directions: dict[str, Callable[[State], Tensor]],
) -> list[Variable]:
    """Waves of a variable in each direction; none if the data span too small a range.

    Args:
        observed: values of the variable in the data.
        length_range: the shortest and the longest wave.
        directions: by level, see :class:`Variable`.
    """
    low, high = float(observed.min()), float(observed.max())
    lengths = lengths_of(*length_range, high - low)
    return [
        Variable(f"waves of {name}", unit, value, (low, high), direction, level, lengths)
        for level, direction in directions.items()
        if lengths
    ]


@dataclass
class Curves:
    """A curve of one variable in the residuals of a calibrated model.

    Attributes:
        variable: see :class:`Variable`; the best wave of several.
        amounts: ``(M,)`` coefficients, orthogonal to the model's tangents.
        heights, errors: at the knots, m/s or m/s².
        losses: ``(G,)`` held-out costs with the curve.
        gain: over the model without it.
        p_value: corrected for all variables.
        shift: ``(K,)`` change of the model's parameters that the curve entails.
        removed: share of the squared errors of positions that it removes; NaN until computed, see
            :func:`nnode.diagnosis.curves.significant_curves`.
        relevant: see :meth:`nnode.diagnosis.residuals.engine.Engine.relevant`; False until
            computed.
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
    relevant: bool = False

    @property
    def clusters(self) -> int:
        """The number of clusters of the comparison."""
        return len(self.losses)

    @property
    def statistic(self) -> np.ndarray:
        """Heights over standard errors at the knots."""
        ratio: np.ndarray = self.heights / self.errors
        return ratio
