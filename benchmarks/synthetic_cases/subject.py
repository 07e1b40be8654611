"""Cases with their strength: the noise of drivers or walkers beside which an effect shows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import least_squares

from benchmarks.synthetic_cases.case import STRENGTHS, Case
from benchmarks.synthetic_cases.catalogue import CATALOGUES, Coefficients

#: Two effects hidden together should not differ in their misfit by more than this factor.
_BALANCE = 3.0
#: A share is reached where it is this close.
_CLOSE = 0.02
_ROUNDS = 6
#: So often coefficients are rescaled; the misfit is not quite quadratic in them.
_RESCALINGS = 3


class Range(NamedTuple):
    """Standard deviations of the noise of drivers or walkers.

    Attributes:
        preferred: coefficients are rescaled to keep it here,
        extreme: and it goes no farther than this where that does not suffice.
        idle: where there is nothing for it to be set against.
        probe: so small that displacements are linear in it.
    """

    preferred: tuple[float, float]
    extreme: tuple[float, float]
    idle: tuple[float, float]
    probe: float


class Truth(NamedTuple):
    """What acts in a case.

    Attributes:
        effects: coefficients by effect; nuisances are part of it.
        amplitude: standard deviation of the noise of drivers (m/s) or walkers (m/s²).
        smooth: of the variant ``smooth``: in traffic the width over which the edges of a zone or
            period are smeared, m or s; in crowds 1, places act by a bell curve.
    """

    effects: dict[str, Coefficients]
    amplitude: float = 0.0
    smooth: float = 0.0


@dataclass(frozen=True)
class Costs:
    """Mean squared errors (m²) on measured data.

    Attributes:
        base: ``(S,)`` of the recalibrated base law.
        oracle: ``(S,)`` of the truth without noise of drivers or walkers.
        floor: of the measurement.
    """

    base: np.ndarray
    oracle: np.ndarray
    floor: float

    @property
    def share(self) -> float:
        """Of the excess over the floor, what the truth removes."""
        excess = float(self.base.mean()) - self.floor
        return float(self.base.mean() - self.oracle.mean()) / excess if excess > 0 else 0.0


class Subject(ABC):
    """Platoons or crowds of a case, with what is hidden in them.

    Attributes:
        case: what was asked for.
        truth: what acts.
        strength: how the noise was chosen: ``share`` of the excess cost that an oracle should
            remove, and what it ``reached``; ``misfit``, mean squared misfit of the recalibrated
            base model without noise, ``alone`` that of each effect without the others, and
            ``spread``, mean squared displacement by noise of amplitude 1, m².
        model, base: what the diagnosis is given of the base model, and its true parameters.
        clocks: ``(S,)`` time of the first samples, s.
        correlation: correlation time of the noise, s.
        error: error of the measured positions, of variance 1.
        walls: ``(W, 4)`` m; empty without walls.
        unit, range: of the noise.
        some: the sequences that show how large a misfit or a displacement is about.
        lowest, tolerance: least parameters of the recalibrated base law; the fit ends where a step
            lowers its cost by less than this share.
    """

    case: Case
    truth: Truth
    strength: dict[str, Any]
    model: dict[str, Any]
    base: dict[str, float]
    clocks: np.ndarray
    correlation: float
    error: np.ndarray
    walls: np.ndarray = np.empty((0, 4))
    unit: str
    range: Range
    some: slice = slice(None)
    lowest: Any = 0.0
    tolerance: float

    @abstractmethod
    def simulate(self, truth: Truth, some: slice = slice(None)) -> Any:
        """How agents really move: ``x``, positions at the samples (m), and what :meth:`errors`
        needs besides."""

    @abstractmethod
    def errors(
        self, motion: Any, measured: np.ndarray, parameters: Any, truth: Truth | None = None
    ) -> np.ndarray:
        """Simulated minus measured positions, m, sequences first.

        Args:
            parameters: of the base law.
            truth: acts beside the base law, but for its noise.
        """

    @abstractmethod
    def squares(self, error: np.ndarray) -> np.ndarray:
        """Squared distances (m²) of the agents that the model moves."""

    @abstractmethod
    def columns(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """The columns of the table, from measured positions."""

    def fields(self, truth: Truth) -> dict[str, float]:
        """What the equations of motion take of the effects."""
        effects = CATALOGUES[self.case.domain].effects
        fields: dict[str, float] = {}
        for name, values in truth.effects.items():
            fields |= effects[name].acting(values)
        return fields

    def rescaled(self, name: str, values: Coefficients, factor: float) -> Coefficients:
        """An effect's coefficients with its size times a factor, as far as its range goes."""
        return CATALOGUES[self.case.domain].effects[name].rescaled(values, factor)

    def cost(self, error: np.ndarray) -> np.ndarray:
        """``(S,)`` mean squared distance, m²."""
        squares = self.squares(error)
        return squares.mean(axis=tuple(range(1, squares.ndim)))

    def base_cost(self, motion: Any, measured: np.ndarray) -> np.ndarray:
        """``(S,)`` cost (m²) of the base law with the parameters that fit best."""
        errors = partial(self.errors, motion, measured)
        return self.cost(errors(self.recalibrated(errors)))

    def recalibrated(self, errors: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
        """The parameters of the base law that fit best, from the true ones."""
        start = np.array(list(self.base.values()))
        fit = least_squares(
            lambda parameters: errors(parameters).ravel(),
            start,
            bounds=(self.lowest, np.inf),
            x_scale=start,
            diff_step=1e-5,
            ftol=self.tolerance,
        )
        return fit.x

    def oracle_cost(self, motion: Any, measured: np.ndarray, truth: Truth) -> np.ndarray:
        """``(S,)`` cost (m²) of the truth without the noise of drivers or walkers."""
        return self.cost(self.errors(motion, measured, list(self.base.values()), truth))

    def measured(self) -> np.ndarray:
        """Measured positions, m."""
        return self.simulate(self.truth).x + self.case.sigma * self.error

    def costs(self, truth: Truth) -> Costs:
        """Costs on measured data."""
        motion = self.simulate(truth)
        x = motion.x + self.case.sigma * self.error
        floor = float(self.squares(x - motion.x).mean())
        return Costs(self.base_cost(motion, x), self.oracle_cost(motion, x, truth), floor)

    def misfit(self, names: list[str]) -> float:
        """Mean squared misfit (m²) of the recalibrated base law to some of the effects alone."""
        kept = {k: v for k, v in self.truth.effects.items() if k in names}
        motion = self.simulate(self.truth._replace(effects=kept, amplitude=0.0), self.some)
        return float(self.base_cost(motion, motion.x).mean())

    def spread(self) -> float:
        """Mean squared displacement (m²) by noise of amplitude 1, probed with a smaller one."""
        truth = self.truth._replace(amplitude=self.range.probe)
        motion = self.simulate(truth, self.some)
        return float(self.oracle_cost(motion, motion.x, truth).mean()) / self.range.probe**2

    def rescale(self, factors: dict[str, float]) -> bool:
        """Scale effects as far as their ranges go; whether anything changed."""
        effects = self.truth.effects
        changed = effects | {
            name: self.rescaled(name, effects[name], factor) for name, factor in factors.items()
        }
        self.truth = self.truth._replace(effects=changed)
        return changed != effects

    def set_strength(self, rng: np.random.Generator) -> None:
        """Choose the noise of drivers or walkers, and where it must the coefficients."""
        case, share = self.case, STRENGTHS[self.case.strength]
        self.strength = {"share": share, "reached": None, "misfit": 0.0, "spread": 0.0, "alone": {}}
        silent = case.arm == "no_excitation" or case.variant == "white"
        if silent or (case.effects and share == 1.0):
            return
        if not case.effects:
            self.truth = self.truth._replace(amplitude=float(rng.uniform(*self.range.idle)))
            return
        for left in range(_RESCALINGS, -1, -1):
            misfit = self.misfit(list(case.effects))
            alone = dict.fromkeys(case.effects, misfit)
            if len(alone) > 1:
                alone = {name: self.misfit([name]) for name in case.effects}
            spread = self.spread()
            # beside this noise an effect makes up the share of the excess: a² V s = M (1 - s)
            wanted = float(np.sqrt(misfit * (1 - share) / (share * spread)))
            within = float(np.clip(wanted, *self.range.preferred))
            # the misfit grows about as the square of the coefficient, as noise does
            if not left or not self.rescale(scaled(alone, within / wanted)):
                break
        self.strength |= {"misfit": misfit, "spread": spread, "alone": alone}

        def reached(amplitude: float) -> float:
            return self.costs(self.truth._replace(amplitude=amplitude)).share

        limits = self.range.extreme
        amplitude = refined(float(np.clip(wanted, *limits)), share, reached, limits)
        self.truth = self.truth._replace(amplitude=amplitude)


def refined(
    first: float, share: float, reached: Callable[[float], float], limits: tuple[float, float]
) -> float:
    """An amplitude that is corrected until the share that is reached is the one asked for.

    Noise displaces by more than its own linear share, starts are measured with an error, and by
    chance noise looks like the effect or like its opposite. The odds s / (1 - s) go with a⁻²;
    once amplitudes on both sides are known, the next lies between them.
    """
    tried: dict[float, float] = {}
    value = first
    for _ in range(_ROUNDS):
        tried[value] = reached(value)
        if abs(tried[value] - share) < _CLOSE:
            break
        low = [a for a, got in tried.items() if got > share]
        high = [a for a, got in tried.items() if got <= share]
        if low and high:
            value = float(np.sqrt(max(low) * min(high)))
        else:
            got = min(max(tried[value], 0.02), 0.98)
            odds = got / (1 - got) * (1 - share) / share
            value = float(np.clip(value * np.sqrt(odds), *limits))
        if value in tried:
            break
    return min(tried, key=lambda amplitude: abs(tried[amplitude] - share))


def scaled(misfits: dict[str, float], factor: float) -> dict[str, float]:
    """Factors on effects that together change their misfit by ``factor`` squared.

    One that outweighs the others is made smaller, so that none hides in the shadow of another;
    and one that is outweighed is not made smaller still.

    Args:
        misfits: mean squared misfit that each effect causes alone, m².
    """
    smallest, largest = max(min(misfits.values()), 1e-12), max(misfits.values())
    factors = {}
    for name, misfit in misfits.items():
        even = min(1.0, float(np.sqrt(_BALANCE * smallest / max(misfit, 1e-12))))
        outweighed = len(misfits) > 1 and misfit < 0.5 * largest
        factors[name] = even * (max(factor, 1.0) if outweighed else factor)
    return factors
