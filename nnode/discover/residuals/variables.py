"""What a deviation may depend on, and what is known of a curve or a wave in it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor, nn

from nnode.discover.residuals.comparison import Comparison
from nnode.model.term import Interval, State, Term

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
        """A curve by the amounts ``(M,)`` of its weights, at values of any shape."""
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
        """``(knots, ...)`` a curve at the knots by the amounts ``(M, ...)`` of its weights."""
        if not self.lengths:
            return amounts
        turn = 2 * np.pi * np.array(self.knots) / self.lengths[0]
        heights: np.ndarray = np.stack([np.sin(turn), np.cos(turn)], 1) @ amounts
        return heights


class Curve(Term):
    """A curve as the last term of a model: the flexible fit of what is left."""

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
    """``(..., M)`` weights of the M knots in a curve that is linear between them."""
    at = torch.tensor(knots, dtype=value.dtype)
    inside = value.clamp(float(at[0]), float(at[-1]))[..., None]
    left, right = at[:-1], at[1:]
    share = ((inside - left) / (right - left)).clamp(0, 1)
    ones = torch.ones_like(share[..., :1])
    return torch.cat([ones, share], -1) - torch.cat([share, 0 * ones], -1)


def knots_of(values: np.ndarray, most: int = 9) -> tuple[float, ...]:
    """Quantiles of observed values, apart from each other; two at least."""
    quantiles = np.unique(np.quantile(values, np.linspace(0.01, 0.99, most)).round(6))
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
        first: clock time of that sample, s, by the sequence's name.
    """

    def value(state: State) -> Tensor:
        start = torch.tensor([start_of[name] for name in state.scene.names], dtype=state.x.dtype)
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
    observed: Tensor,
    length_range: tuple[float, float],
    directions: dict[str, Callable[[State], Tensor]],
) -> list[Variable]:
    """Waves of a variable in each direction; none where the data span too little of it.

    Args:
        seen: values that occur.
        between: the shortest and the longest wave.
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
        amounts: ``(M,)`` of the variable's weights, beyond what the model can do.
        heights, errors: at the knots, m/s or m/s².
        losses: ``(G,)`` held-out costs with the curve.
        gain: over the model without it.
        p_value: that there is nothing, with regard to all variables.
        shift: ``(K,)`` of the model's own parameters beside the curve.
        removed: share of the squared errors of positions that it removes; NaN until it is asked
            for, see :func:`nnode.discover.locate.curves.significant_curves`.
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
        ratio: np.ndarray = self.heights / self.errors
        return ratio
