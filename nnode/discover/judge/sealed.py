"""The sealed clusters: opened once, when everything else is decided."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from nnode.data.clusters import better
from nnode.data.sequence import Sequence
from nnode.discover.crowds.indirect_inference import unbiased
from nnode.discover.found import Simulation
from nnode.discover.judge.confirm import Comparing, engine_of, too_few
from nnode.discover.judge.held_out import MODELS, Later, later
from nnode.discover.judge.verdict import named
from nnode.discover.name.search import Search, Step, without_steps
from nnode.discover.residuals.engine import Engine
from nnode.discover.residuals.fit import Fit, refine
from nnode.discover.result import Agents, Confirmation, Gap, NamedEffect
from nnode.discover.rules import rules
from nnode.discover.statistics.paired import gains
from nnode.discover.statistics.random_effects import Individuals, numbers, with_people
from nnode.errors import SimulationError
from nnode.model.extend import without
from nnode.model.system import System


@dataclass(frozen=True)
class _Tried:
    """Two models on the sealed clusters.

    Attributes:
        p_value: one-sided, that residuals of the first lean towards the second.
        likelier: whether their predictive likelihood rises.
        nearer: whether the errors of positions become smaller; asked beside the model without any
            effect alone.
        before, after: mean square errors of positions, m².
    """

    p_value: float
    likelier: bool
    nearer: bool
    before: float
    after: float

    @property
    def good(self) -> bool:
        return self.p_value <= rules().level and self.likelier and self.nearer

    def doubt(self) -> tuple[bool, float]:
        """Grows the less is said for the second model."""
        return not self.good, self.p_value

    @property
    def reason(self) -> str:
        if self.p_value > rules().level:
            return (
                "the sealed clusters do not lean the way that it bends predictions "
                f"(one-sided p = {self.p_value:.3f}, asked for {rules().level:g})"
            )
        if not self.likelier:
            return "the sealed clusters are not predicted better with it"
        if not self.good:
            return (
                "the errors of positions on the sealed sequences do not become smaller with it "
                f"({self.before:.3g} and {self.after:.3g} m²)"
            )
        return ""


#: Simulations of a sealed sequence with the model as it was given and with the extended one.
Pair = tuple[Simulation | None, Simulation | None]

_SIMULATED = {
    "traffic": "of each follower at each sample after the first. The platoon is simulated from its "
    "first positions behind its leader's measured path, both smoothed",
    "drivers": "of each follower at each sample after the first. They are simulated behind the "
    "measured paths of the vehicles ahead, smoothed, each with the parameters and the start that "
    "are most likely for that driver",
    "crowd": "of each person at each compared sample. Everyone is simulated for about 1.5 s at a "
    "time among the measured paths of the others, and what an unknown start state explains is "
    "taken out",
}


def defined(compared: str, own: bool) -> str:
    """The definition of the error that a report states before and after.

    Args:
        compared: people (``crowd``), platoons (``traffic``), or followers one by one (``drivers``).
        own: whether agents have numbers of their own.
    """
    part = (
        " The error is that of the last 40 % of the agents' time in each sequence; each agent's "
        "number is taken from the first 40 %."
    )
    return (
        "The error is the mean square distance between measured and simulated position (m²) "
        f"{_SIMULATED[compared]}. It is averaged within each sealed sequence, then over the sealed "
        f"sequences.{part if own else ''}"
    )


class Sealed:
    """Compares models on the sealed sequences.

    Args:
        base: the model as it was given, calibrated.
        opened, sealed: sequences.
        label: ``(S,)`` clusters of the sealed ones.
        clusters: how many of them are independent of the open ones.
        seed: of simulations.

    Attributes:
        tried: by effect the comparison that speaks least for it.
    """

    def __init__(
        self,
        engine: Engine,
        base: System,
        opened: list[Sequence],
        sealed: list[Sequence],
        label: np.ndarray,
        clusters: int,
        seed: int,
    ) -> None:
        self.domain = str(base.domain)
        self.base, self.opened, self.sealed = base, opened, sealed
        self.label, self.clusters, self.seed = label, clusters, seed
        self.comparing = Comparing(engine_of(base, sealed, label, like=engine), base)
        self.before = self.comparing.squares(base)
        self.tried: dict[str, _Tried] = {}
        self._corrected: Fit | None = None
        self._later: dict[str, Later] = {}

    def confirmed(self, engine: Engine, found: Search) -> tuple[Search, list[NamedEffect]]:
        """A search with the effects that sealed clusters confirm, and those that they do not, as
        they are in the model with all that were found."""
        if not found.steps:
            return found, []
        whole = self._corrected = self._unbiased(found.fit)
        self.tried = self._closed(engine, found, whole)
        rest = [step for step in found.steps if not self.tried[step.chosen.name].good]
        if not rest:
            return found, []
        best = None
        if len(rest) < len(found.steps):
            best = self._unbiased(self._without(engine, found.fit, rest))
            alone = self._compared(self.base, best.system)
            if not alone.good:
                best, rest = None, found.steps
                self.tried = {step.chosen.name: alone for step in rest}
        # before the engine's filter is fitted to what the model leaves without them
        leads = [named(engine, whole, step, self.tried[step.chosen.name].p_value) for step in rest]
        kept = without_steps(engine, found, rest, self.base)
        self._corrected = best or kept.fit
        return kept, leads

    def _closed(self, engine: Engine, found: Search, whole: Fit) -> dict[str, _Tried]:
        """For every effect the comparison that speaks least for it: of the model with all effects
        with that without a set of them that holds it, over all such sets."""
        worst: dict[str, _Tried] = {}
        every = range(len(found.steps), 0, -1)
        for taken in (s for number in every for s in combinations(found.steps, number)):
            names = [step.chosen.name for step in taken]
            if all(name in worst and not worst[name].good for name in names):
                continue
            lacking = self.base
            if len(taken) < len(found.steps):
                lacking = self._unbiased(self._without(engine, found.fit, list(taken))).system
            tried = self._compared(lacking, whole.system)
            for name in names:
                worst[name] = max(worst.get(name, tried), tried, key=_Tried.doubt)
        return worst

    def _compared(self, before: System, after: System) -> _Tried:
        """What sealed clusters say of two models."""
        scores, squares = self.comparing.scores, self.comparing.squares
        p_value = 1.0 if too_few(self.clusters) else better(self.comparing.leaning(before, after))
        likelier = bool(gains(scores(before), scores(after)).mean() > 0)
        first, last = (float(np.nanmean(squares(one))) for one in (before, after))
        nearer = last < first or before is not self.base or self.comparing.drivers
        return _Tried(p_value, likelier, nearer, first, last)

    def _without(self, engine: Engine, fit: Fit, steps: list[Step]) -> Fit:
        return refine(engine, without(fit.system, *(step.chosen.name for step in steps)))

    def _unbiased(self, fit: Fit) -> Fit:
        return unbiased(fit, self.opened, self.seed) if self.domain == "crowd" else fit

    def corrected(self, found: Search) -> Fit:
        """The fit with the confirmed effects, without what simulations of it are off by."""
        return found.fit if self._corrected is None or not found.steps else self._corrected

    def confirmation(self, agents: list[Agents]) -> Confirmation:
        """What is said of the effects that were found: those of the population, or else those with
        numbers of agents."""
        few = too_few(self.clusters)
        tried = [(one.confirmed, one.named, one.reason) for one in agents if one.found]
        least = sorted(self.tried.values(), key=_Tried.doubt)
        tried = [(one.p_value, one.good, few or one.reason) for one in least] or tried
        if not tried:
            return Confirmation(None, self.clusters, None, few)
        p_value, good, reason = tried[-1]
        return Confirmation(p_value, self.clusters, good, reason)

    def agents(
        self, one: Individuals, system: System, alpha: float, structure: bool, enough: bool
    ) -> Agents:
        """What agents' own numbers are worth on the last part of the sealed sequences.

        Args:
            structure: whether something without a name is left, which numbers would absorb.
            enough: whether there are clusters enough to name anything.
        """
        (name,) = one.effect.strengths
        low, high = one.interval()
        found = None
        if one.spread and (one.p_value <= alpha or not enough):
            found = later(self.domain, self.base, system, one, self.sealed, self.label)
        p_value, means = 1.0, {}
        if found is not None:
            self._later[one.effect.name] = found
            means = {model: float(np.nanmean(costs)) for model, costs in found.costs.items()}
            others = [found.leaning[model] for model in (MODELS[0], MODELS[2])]
            if not too_few(min(len(others[0]), self.clusters)):
                p_value = max(better(other) for other in others)
            if means[MODELS[1]] >= min(means[MODELS[0]], means[MODELS[2]]):
                p_value = 1.0
        hindered = _hindered(one, alpha, structure, enough)
        reason = hindered or _why_not(p_value, found, self.clusters)
        return Agents(
            name=one.effect.name,
            strength=one.sigma,
            low=low,
            high=high,
            unit=one.effect.strengths[name].unit,
            p_value=one.p_value,
            lasts=one.lasts,
            share=one.share,
            lags=one.lags,
            common=one.common,
            later=means,
            confirmed=float("nan") if found is None else p_value,
            found=not hindered,
            named=not reason,
            reason=reason,
        )

    def with_numbers(self, engine: Engine, fit: Fit, own: list[Individuals]) -> System:
        """The model with everybody's numbers in the open sequences, calibrated with them."""
        system = fit.system
        for one in own:
            system = with_people(system, one, numbers(engine, system, one))
        if not own:
            return system
        try:
            return refine(engine, system).system
        except SimulationError:
            return fit.system

    def gap(
        self, extended: System, own: list[Individuals]
    ) -> tuple[Gap, list[dict[str, Any]], list[Pair]]:
        """The errors before and after, those of each sequence, and the simulations whose errors
        they are."""
        if own:
            known = self._later[own[0].effect.name]
            used, floor = known.used, known.floor
            before, after = known.costs["base"], known.costs[MODELS[1]]
            first_x, last_x = known.simulated
        else:
            used, floor = list(range(len(self.sealed))), self.comparing.floor
            before, first_x = self.before, self.comparing.simulated(self.base)
            after, last_x = before, first_x
            if extended is not self.base:
                after, last_x = self.comparing.squares(extended), self.comparing.simulated(extended)
        first, last = float(np.nanmean(before)), float(np.nanmean(after))
        closed = (first - last) / (first - floor) if first > floor else float("nan")
        each = [
            {"name": self.sealed[i].name, "before": float(a), "after": float(b)}
            for i, a, b in zip(used, before, after, strict=True)
        ]
        compared = "drivers" if self.comparing.drivers else self.domain
        gap = Gap(first, last, floor, closed, definition=defined(compared, bool(own)))
        if not own:
            gap.plain = gap.plain_after = self._plain(self.base)
            if extended is not self.base:
                gap.plain_after = self._plain(extended)
        return gap, each, list(zip(first_x, last_x, strict=True))

    def _plain(self, system: System) -> float:
        """Mean square error of positions, m², of a calibration to whole open sequences, from a
        model's parameters on; NaN in crowds, and where it blows up."""
        if self.domain == "crowd":
            return float("nan")
        try:
            engine = engine_of(self.base, self.opened, whole=True)
            found = refine(engine, copy.deepcopy(system)).system
        except SimulationError:
            return float("nan")
        return float(np.nanmean(self.comparing.squares(found)))


def _hindered(one: Individuals, alpha: float, structure: bool, enough: bool) -> str:
    """Why agents' own numbers are not found in the open clusters; empty where they are."""
    if not enough:
        return "there are too few clusters to test it"
    if one.p_value > alpha or not one.interval()[0] > 0:
        return "what an agent's numbers have in common over time does not stand out"
    if structure:
        return "something without a name is left, which numbers of agents would absorb"
    return ""


def _why_not(p_value: float, found: Later | None, clusters: int) -> str:
    """Why the sealed clusters do not confirm them; empty where they do."""
    if found is None:
        return "the sealed sequences are too short to be divided"
    if p_value > rules().level:
        return too_few(clusters) or (
            "the last part of the sealed sequences is not predicted better by own numbers than "
            f"without, or by one number per sequence (one-sided p = {p_value:.3f})"
        )
    return ""
