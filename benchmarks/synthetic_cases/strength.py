"""How strongly an effect shows: the noise of drivers or walkers beside it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from benchmarks.synthetic_cases.case import STRENGTHS, Case

#: Two effects hidden together should not differ in their misfit by more than this factor.
_BALANCE = 3.0
#: A share is reached where it is this close.
_CLOSE = 0.02
_ROUNDS = 6
#: So often coefficients are rescaled; the misfit is not quite quadratic in them.
_RESCALINGS = 3


@dataclass(frozen=True)
class Range:
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


@dataclass(frozen=True)
class Amplitude:
    """The noise of drivers or walkers.

    Attributes:
        share: of the excess cost that an oracle should remove.
        value: standard deviation of the noise, in its own unit.
        wanted: what the share asks for, within the limits or not.
        misfit: M, mean squared misfit of the recalibrated base model without noise, m².
        spread: V, mean squared displacement by noise of amplitude 1, m².
        reached: the share that an oracle really removes.
        alone: M of each effect without the others, m².
    """

    share: float
    value: float
    wanted: float = 0.0
    misfit: float = 0.0
    spread: float = 0.0
    reached: float | None = None
    alone: dict[str, float] = field(default_factory=dict)


def amplitude_for(
    misfit: float, spread: float, share: float, limits: tuple[float, float]
) -> Amplitude:
    """The noise beside which an effect makes up ``share`` of the excess: a² V s = M (1 - s)."""
    wanted = float(np.sqrt(misfit * (1 - share) / (share * spread)))
    return Amplitude(share, float(np.clip(wanted, *limits)), wanted, misfit, spread)


def refine(
    first: Amplitude, reached: Callable[[float], float], limits: tuple[float, float]
) -> Amplitude:
    """Correct an amplitude until the share that is reached is the one that was asked for.

    Noise displaces by more than its own linear share, starts are measured with an error, and by
    chance noise looks like the effect or like its opposite. The odds s / (1 - s) go with a⁻²;
    once amplitudes on both sides are known, the next lies between them.
    """
    tried: list[Amplitude] = []
    value = first.value
    for _ in range(_ROUNDS):
        tried.append(replace(first, value=value, reached=reached(value)))
        if abs(_got(tried[-1]) - first.share) < _CLOSE:
            break
        below = [t.value for t in tried if _got(t) > first.share]
        above = [t.value for t in tried if _got(t) <= first.share]
        if below and above:
            value = float(np.sqrt(max(below) * min(above)))
        else:
            got = min(max(_got(tried[-1]), 0.02), 0.98)
            odds = got / (1 - got) * (1 - first.share) / first.share
            value = float(np.clip(value * np.sqrt(odds), *limits))
        if any(t.value == value for t in tried):
            break
    return min(tried, key=lambda t: abs(_got(t) - first.share))


def _got(amplitude: Amplitude) -> float:
    return 0.0 if amplitude.reached is None else amplitude.reached


def scaled(misfits: dict[str, float], factor: float) -> dict[str, float]:
    """Factors on effects that together change their misfit by ``factor`` squared.

    One that outweighs the others is made smaller, so that none hides in the shadow of another;
    and one that is outweighed is not made smaller still.

    Args:
        misfits: mean squared misfit that each effect causes alone, m².
    """
    least = max(min(misfits.values()), 1e-12)
    found = {}
    for name, misfit in misfits.items():
        even = min(1.0, float(np.sqrt(_BALANCE * least / max(misfit, 1e-12))))
        outweighed = len(misfits) > 1 and misfit < 0.5 * max(misfits.values())
        found[name] = even * (max(factor, 1.0) if outweighed else factor)
    return found


class Subject:
    """A case whose strength is set: platoons or crowds with what is hidden in them.

    Attributes:
        case: what was asked for.
        truth: coefficients of all acting effects (``effects``), the noise of drivers or walkers
            (``amplitude``), and the shape of effects.
        amplitude: how the noise was chosen.
        catalogue: module with the domain's effects.
        unit: of the noise.
        clocks: ``(S,)`` time of the first samples, s.
        correlation: correlation time of the noise, s.
        walls: ``(W, 4)`` m; empty without walls.
    """

    case: Case
    truth: Any
    amplitude: Amplitude
    catalogue: Any
    unit: str
    clocks: np.ndarray
    correlation: float
    walls: np.ndarray = np.empty((0, 4))

    def measured(self, truth: Any) -> np.ndarray:
        """Measured positions, m."""
        raise NotImplementedError

    def misfit(self, names: list[str]) -> float:
        """Mean squared misfit (m²) of the recalibrated base law to some of the effects alone."""
        raise NotImplementedError

    def spread(self, probe: float) -> float:
        """Mean squared displacement (m²) by noise of amplitude 1, probed with a smaller one."""
        raise NotImplementedError

    def costs(self, truth: Any) -> Costs:
        """Costs on measured data."""
        raise NotImplementedError

    def columns(self, x: np.ndarray) -> dict[str, np.ndarray]:
        """The columns of the table, from measured positions."""
        raise NotImplementedError

    def base(self) -> dict[str, Any]:
        """What the diagnosis is told of the base ``model``, and its true parameters, ``base``."""
        raise NotImplementedError

    def rescaled(self, name: str, values: dict[str, float], factor: float) -> dict[str, float]:
        """An effect's coefficients with its size times a factor, as far as its range goes."""
        raise NotImplementedError

    def rescale(self, factors: dict[str, float]) -> bool:
        """Scale effects as far as their ranges go; whether anything changed."""
        effects = self.truth.effects
        scaled = {name: self.rescaled(name, effects[name], f) for name, f in factors.items()}
        changed = {**effects, **scaled}
        self.truth = replace(self.truth, effects=changed)
        return bool(changed != effects)


def set_strength(subject: Subject, rng: np.random.Generator, limits: Range) -> Amplitude:
    """Choose the noise of drivers or walkers, and where it must the coefficients.

    Both are set in ``subject.truth``.
    """
    case, share = subject.case, STRENGTHS[subject.case.strength]
    silent = case.arm == "no_excitation" or case.variant == "white"
    if silent or (case.effects and share == 1.0):
        return Amplitude(share=share, value=0.0)
    if not case.effects:
        value = float(rng.uniform(*limits.idle))
        subject.truth = replace(subject.truth, amplitude=value)
        return Amplitude(share=share, value=value)
    for left in range(_RESCALINGS, -1, -1):
        together = subject.misfit(list(case.effects))
        alone = dict.fromkeys(case.effects, together)
        if len(alone) > 1:
            alone = {name: subject.misfit([name]) for name in case.effects}
        first = amplitude_for(together, subject.spread(limits.probe), share, limits.extreme)
        within = float(np.clip(first.wanted, *limits.preferred))
        # the misfit grows about as the square of the coefficient, as noise does
        if not left or not subject.rescale(scaled(alone, within / first.wanted)):
            break

    def reached(value: float) -> float:
        return subject.costs(replace(subject.truth, amplitude=value)).share

    found = refine(replace(first, alone=alone), reached, limits.extreme)
    subject.truth = replace(subject.truth, amplitude=found.value)
    return found
