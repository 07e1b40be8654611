"""Confirmation of the selected effects on held-back clusters, after everything else is decided."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import numpy as np

from nnode.data.clusters import better
from nnode.data.sequence import Sequence
from nnode.diagnosis import thresholds
from nnode.diagnosis.division import Part
from nnode.diagnosis.held_out import MODELS, HeldOutErrors, held_out_errors
from nnode.diagnosis.model_comparison import ModelComparison, engine_of, too_few
from nnode.diagnosis.outcome import Simulation
from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import Fit, refine
from nnode.diagnosis.result import Agents, Confirmation, Gap, NamedEffect
from nnode.diagnosis.search import Selection, Step, without_steps
from nnode.diagnosis.statistics.bias import corrected_for_bias
from nnode.diagnosis.statistics.combination import combined
from nnode.diagnosis.statistics.paired import gains
from nnode.diagnosis.statistics.random_effects import (
    IndividualEstimate,
    agent_parameters,
    with_agent_parameters,
)
from nnode.diagnosis.verdict import named
from nnode.errors import SimulationError
from nnode.model.extend import without
from nnode.model.system import System


@dataclass(frozen=True)
class _ModelTest:
    """A comparison of two models on the confirmation clusters.

    Attributes:
        p_value: of exploration and confirmation clusters together.
        confirmation: one-sided p-value of the confirmation clusters alone, of the score test of the
            first model toward the second.
        alpha: level of ``p_value``.
        likelihood_rises: whether the predictive likelihood of the second model is larger.
        errors_fall: whether the errors of positions become smaller; required only if the first
            model has no effect.
        before, after: mean square errors of positions, m².
    """

    p_value: float
    confirmation: float
    alpha: float
    likelihood_rises: bool
    errors_fall: bool
    before: float
    after: float

    @property
    def confirmed(self) -> bool:
        significant = self.p_value <= self.alpha and self.confirmation <= thresholds.EACH
        return significant and self.likelihood_rises and self.errors_fall

    def weakness(self) -> tuple[bool, float]:
        """A sort key: larger if the evidence for the second model is weaker."""
        return not self.confirmed, self.p_value

    @property
    def reason(self) -> str:
        if self.confirmation > thresholds.EACH:
            return (
                "the residuals of the confirmation clusters do not correlate with its predicted "
                f"change (one-sided p = {self.confirmation:.3f}, required {thresholds.EACH:g})"
            )
        if self.p_value > self.alpha:
            return (
                "exploration and confirmation clusters together are not significant "
                f"(p = {self.p_value:.3f}, required {self.alpha:g})"
            )
        if not self.likelihood_rises:
            return "the confirmation clusters are not predicted better with it"
        if not self.confirmed:
            return (
                "the errors of positions on the confirmation sequences do not decrease with it "
                f"({self.before:.3g} and {self.after:.3g} m²)"
            )
        return ""


#: Simulations of a confirmation sequence with the given model and with the extended one.
SimulationPair = tuple[Simulation | None, Simulation | None]

_SIMULATED = {
    "traffic": "of each follower at each sample after the first. The platoon is simulated from its "
    "first positions behind its leader's measured path, both smoothed",
    "drivers": "of each follower at each sample after the first. They are simulated behind the "
    "measured paths of the vehicles ahead, smoothed, each with the parameters and the start that "
    "are most likely for that driver",
    "crowd": "of each person at each compared sample. Everyone is simulated for about 1 s at a "
    "time among the measured paths of the others, from the smoothed place and velocity and with "
    "the desired velocity and relaxation time that are most likely for that person",
}


def defined(compared: str, individual: bool) -> str:
    """The definition of the error that a report states before and after.

    Args:
        compared: people (``crowd``), platoons (``traffic``), or followers one by one (``drivers``).
        individual: whether the model has agent-specific parameters.
    """
    last_part = (
        " The error is that of the last 40 % of the agents' time in each sequence; each agent's "
        "number is taken from the first 40 %."
    )
    return (
        "The error is the mean square distance between measured and simulated position (m²) "
        f"{_SIMULATED[compared]}. It is averaged within each confirmation sequence, then over "
        f"the sequences.{last_part if individual else ''}"
    )


class ConfirmationSet:
    """Compares models on the confirmation sequences.

    Args:
        engine: of the exploration sequences.
        base: the model as it was given, calibrated.
        exploration: sequences. confirmation: sequences with their clusters.
        clusters: the number of them that are independent of the exploration clusters.
        alpha: level of exploration and confirmation clusters together.
        seed: of simulations.

    Attributes:
        tests: by effect, the comparison with the weakest evidence for it.
    """

    def __init__(
        self,
        engine: Engine,
        base: System,
        exploration: list[Sequence],
        confirmation: Part,
        clusters: int,
        alpha: float,
        seed: int,
    ) -> None:
        self.alpha, self.n_exploration = alpha, int(engine.cluster.max()) + 1
        self.domain = str(base.domain)
        self.base, self.exploration = base, exploration
        self.sequences, self.label = confirmation.sequences, confirmation.label
        self.clusters, self.seed = clusters, seed
        self.comparison = ModelComparison(
            engine_of(base, self.sequences, self.label, like=engine), base
        )
        self.before = self.comparison.squares(base)
        self.tests: dict[str, _ModelTest] = {}
        self._confirmed_fit: Fit | None = None
        self._held_out: dict[str, HeldOutErrors] = {}

    def confirmed(
        self, engine: Engine, selection: Selection
    ) -> tuple[Selection, list[NamedEffect]]:
        """The selection with the confirmed effects only, and the unconfirmed effects as they are
        in the model with all selected effects."""
        if not selection.steps:
            return selection, []
        full_fit = self._confirmed_fit = selection.fit
        self.tests = self._closed_tests(engine, selection, full_fit)
        unconfirmed = [
            step for step in selection.steps if not self.tests[step.chosen.name].confirmed
        ]
        if not unconfirmed:
            return selection, []
        reduced = None
        if len(unconfirmed) < len(selection.steps):
            reduced = self._without(engine, selection.fit, unconfirmed)
            kept = [step for step in selection.steps if step not in unconfirmed]
            test = self._compared(self.base, reduced.system, kept)
            if not test.confirmed:
                reduced, unconfirmed = None, selection.steps
                self.tests = {step.chosen.name: test for step in unconfirmed}
        # the intervals need the whitening of the full model, which without_steps refits
        hypotheses = [self.named(engine, full_fit, step) for step in unconfirmed]
        remaining = without_steps(engine, selection, unconfirmed, self.base)
        self._confirmed_fit = reduced or remaining.fit
        return remaining, hypotheses

    def named(self, engine: Engine, fit: Fit, step: Step) -> NamedEffect:
        """An effect with its coefficients in a fit and its weakest test."""
        test = self.tests[step.chosen.name]
        return named(engine, fit, step, test.confirmation, test.p_value)

    def _closed_tests(
        self, engine: Engine, selection: Selection, full_fit: Fit
    ) -> dict[str, _ModelTest]:
        """For every effect, the comparison with the weakest evidence for it, over all subsets of
        effects that contain it: the full model against the model without the subset."""
        weakest: dict[str, _ModelTest] = {}
        sizes = range(len(selection.steps), 0, -1)
        for subset in (s for number in sizes for s in combinations(selection.steps, number)):
            names = [step.chosen.name for step in subset]
            if all(name in weakest and not weakest[name].confirmed for name in names):
                continue
            reduced = self.base
            if len(subset) < len(selection.steps):
                reduced = self._without(engine, selection.fit, list(subset)).system
            test = self._compared(reduced, full_fit.system, subset)
            for name in names:
                weakest[name] = max(weakest.get(name, test), test, key=_ModelTest.weakness)
        return weakest

    def _compared(self, before: System, after: System, steps: Iterable[Step]) -> _ModelTest:
        """The tests of two models.

        Args:
            steps: the effects in which they differ. The weakest one stands for the evidence of the
                exploration clusters.
        """
        scores, squares = self.comparison.scores, self.comparison.squares
        confirmation = 1.0
        if not too_few(self.clusters):
            confirmation = better(self.comparison.score_toward(before, after))
        exploration = max(step.chosen.score.p_value for step in steps)
        likelihood_rises = bool(gains(scores(before), scores(after)).mean() > 0)
        error_before, error_after = (
            float(np.nanmean(squares(system))) for system in (before, after)
        )
        errors_fall = (
            error_after < error_before or before is not self.base or self.comparison.agents_differ
        )
        return _ModelTest(
            float(combined(exploration, confirmation, self.n_exploration, self.clusters)),
            confirmation,
            self.alpha,
            likelihood_rises,
            errors_fall,
            error_before,
            error_after,
        )

    def _without(self, engine: Engine, fit: Fit, steps: list[Step]) -> Fit:
        return refine(engine, without(fit.system, *(step.chosen.name for step in steps)))

    def corrected(self, engine: Engine, selection: Selection) -> Fit:
        """The fit with the confirmed effects, corrected for its bias by simulation."""
        if self._confirmed_fit is None or not selection.steps:
            return selection.fit
        return corrected_for_bias(engine, self._confirmed_fit, self.seed)

    def confirmation(self, agents: list[Agents]) -> Confirmation:
        """The weakest test of the selected effects: of the population, or else of individuals."""
        shortage = too_few(self.clusters)
        results = [(item.confirmed, item.named, item.reason) for item in agents if item.found]
        if self.tests:
            tests = sorted(self.tests.values(), key=_ModelTest.weakness)
            results = [
                (test.confirmation, test.confirmed, shortage or test.reason) for test in tests
            ]
        if not results:
            return Confirmation(None, self.clusters, None, shortage)
        p_value, confirmed, reason = results[-1]
        return Confirmation(p_value, self.clusters, confirmed, reason)

    def agents(
        self,
        estimate: IndividualEstimate,
        system: System,
        structure: bool,
        enough: bool,
    ) -> Agents:
        """Test whether agent-specific parameters predict the last part of the confirmation
        sequences.

        Args:
            structure: whether unexplained structure remains, which these parameters would absorb.
            enough: whether there are enough clusters to name anything.
        """
        (name,) = estimate.effect.strengths
        low, high = estimate.interval()
        errors = None
        if estimate.sigma and (estimate.p_value <= self.alpha or not enough):
            errors = held_out_errors(
                self.domain, self.base, system, estimate, self.sequences, self.label
            )
        p_value, means = 1.0, {}
        if errors is not None:
            self._held_out[estimate.effect.name] = errors
            means = {model: float(np.nanmean(costs)) for model, costs in errors.costs.items()}
            scores = [errors.score_toward[model] for model in (MODELS[0], MODELS[2])]
            if not too_few(min(len(scores[0]), self.clusters)):
                p_value = max(better(score) for score in scores)
            if means[MODELS[1]] >= min(means[MODELS[0]], means[MODELS[2]]):
                p_value = 1.0
        rejected = _rejection_reason(estimate, self.alpha, structure, enough)
        reason = rejected or _not_confirmed_reason(p_value, errors, self.clusters)
        return Agents(
            name=estimate.effect.name,
            strength=estimate.sigma,
            low=low,
            high=high,
            unit=estimate.effect.strengths[name].unit,
            p_value=estimate.p_value,
            lasts=estimate.lasts,
            share=estimate.share,
            lags=estimate.lags,
            common=estimate.common,
            later=means,
            confirmed=float("nan") if errors is None else p_value,
            found=not rejected,
            named=not reason,
            reason=reason,
        )

    def with_agents(self, engine: Engine, fit: Fit, confirmed: list[IndividualEstimate]) -> System:
        """The model with the agents' parameters in the exploration sequences, recalibrated."""
        system = fit.system
        for estimate in confirmed:
            system = with_agent_parameters(
                system, estimate, agent_parameters(engine, system, estimate)
            )
        if not confirmed:
            return system
        try:
            return refine(engine, system).system
        except SimulationError:
            return fit.system

    def gap(
        self, extended: System, individual: list[IndividualEstimate]
    ) -> tuple[Gap, list[dict[str, Any]], list[SimulationPair]]:
        """The mean errors before and after, the errors of each sequence, and their simulations."""
        if individual:
            held_out = self._held_out[individual[0].effect.name]
            used, floor = held_out.used, held_out.floor
            before, after = held_out.costs["base"], held_out.costs[MODELS[1]]
            simulated_before, simulated_after = held_out.simulated
        else:
            used, floor = list(range(len(self.sequences))), self.comparison.floor
            before, simulated_before = self.before, self.comparison.simulated(self.base)
            after, simulated_after = before, simulated_before
            if extended is not self.base:
                after = self.comparison.squares(extended)
                simulated_after = self.comparison.simulated(extended)
        mean_before, mean_after = float(np.nanmean(before)), float(np.nanmean(after))
        closed = float("nan")
        if mean_before > floor:
            closed = (mean_before - mean_after) / (mean_before - floor)
        errors = [
            {"name": self.sequences[i].name, "before": float(a), "after": float(b)}
            for i, a, b in zip(used, before, after, strict=True)
        ]
        compared = "drivers" if self.comparison.followers else self.domain
        gap = Gap(
            mean_before, mean_after, floor, closed, definition=defined(compared, bool(individual))
        )
        if not individual:
            gap.plain = gap.plain_after = self._plain(self.base)
            if extended is not self.base:
                gap.plain_after = self._plain(extended)
        return gap, errors, list(zip(simulated_before, simulated_after, strict=True))

    def _plain(self, system: System) -> float:
        """Mean square error of positions, m², after a calibration to whole exploration sequences
        from a model's parameters; NaN in crowds, and if the simulation diverges."""
        if self.domain == "crowd":
            return float("nan")
        try:
            engine = engine_of(self.base, self.exploration, whole=True)
            calibrated = refine(engine, copy.deepcopy(system)).system
        except SimulationError:
            return float("nan")
        return float(np.nanmean(self.comparison.squares(calibrated)))


def _rejection_reason(
    estimate: IndividualEstimate, alpha: float, structure: bool, enough: bool
) -> str:
    """Why the exploration clusters do not support agent-specific parameters; empty if they do."""
    if not enough:
        return "there are too few clusters to test it"
    if estimate.p_value > alpha or not estimate.interval()[0] > 0:
        return "the differences between agents that persist over time are not significant"
    if structure:
        return "unexplained structure remains, which agent-specific parameters would absorb"
    return ""


def _not_confirmed_reason(p_value: float, errors: HeldOutErrors | None, clusters: int) -> str:
    """Why the confirmation clusters do not confirm them; empty if they do."""
    if errors is None:
        return "the confirmation sequences are too short to be divided"
    if p_value > thresholds.LEVEL:
        return too_few(clusters) or (
            "agent-specific parameters do not predict the last part of the confirmation sequences "
            f"better than none, or than one per sequence (one-sided p = {p_value:.3f})"
        )
    return ""
