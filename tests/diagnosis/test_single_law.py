"""Diagnoses of one law: hidden effects are named, and absent ones bounded."""

from __future__ import annotations

import sys
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from nnode.data.sequence import Sequence
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.report.files import verdict
from nnode.diagnosis.residuals.engine import Engine
from nnode.diagnosis.residuals.fit import Fit
from nnode.diagnosis.residuals.variables import Curves
from nnode.diagnosis.single_law import diagnose_law
from nnode.model.extend import effects_of
from tests.diagnosis.conftest import KAPPA, MANY
from tests.diagnosis.platoons import LENGTH, V0, lin, platoons, relative_speed

LAW = lin(v0=25.0, length=7.0)


def test_hidden_effect_is_named(
    hidden_reaction: tuple[list[Sequence], DiscoverOptions, DiagnosisOutcome],
) -> None:
    sequences, _, outcome = hidden_reaction
    d = outcome.diagnosis
    assert d.verdict == "named"
    (effect,) = d.effects
    assert (effect.name, effect.where) == ("relative_speed", "all agents, everywhere")
    assert effect.p_value < 0.05
    assert effect.gain > 0
    kappa = effect.coefficients["kappa"]
    assert kappa.value == pytest.approx(KAPPA, abs=0.05)
    assert kappa.low < KAPPA < kappa.high
    assert kappa.unit == "1"
    (zone,) = d.absences
    assert zone.name == "speed_zone"
    assert zone.testable
    assert "half of the intervals" in zone.reason
    assert d.hypotheses == d.agents == d.data_faults == []
    # no two-sided p-value of eleven exploration clusters is below 2^-10
    assert (d.clusters.exploration, d.clusters.confirmation) == (d.screen.clusters, 5) == (11, 5)
    assert d.screen.floor == 2**-10
    assert d.screen.floor <= effect.p_value
    assert (d.screen.effect, d.screen.p_value) == ("relative_speed", effect.p_value)
    # the errors of all five confirmation clusters fall
    assert d.confirmation.confirmed
    assert d.confirmation.p_value == effect.confirmed == 2**-5
    assert sorted(d.split["exploration"] + d.split["confirmation"]) == sorted(
        s.name for s in sequences
    )
    assert [row["name"] for row in d.confirmation_errors] == d.split["confirmation"]
    assert len(d.split["confirmation"]) == 5
    assert all(row["after"] < row["before"] for row in d.confirmation_errors)
    gap = d.gap
    assert gap.closed == pytest.approx((gap.before - gap.after) / (gap.before - gap.noise_floor))
    assert gap.closed > 0.3
    assert d.notes == []
    assert "relative_speed" in {effect.name for effect in effects_of(outcome.extended)}


@pytest.mark.thorough
def test_no_effect_of_true_law_is_named() -> None:
    sequences = platoons(**MANY)
    options = DiscoverOptions(effects=["relative_speed", "speed_zone", "free_flow_speed"])
    d = diagnose_law(LAW, sequences, options).diagnosis
    assert (d.verdict, d.effects, d.hypotheses, d.unknown) == ("none", [], [], None)
    assert (d.confirmation.confirmed, d.confirmation.p_value) == (None, None)
    absent = {absence.name: absence for absence in d.absences}
    assert set(absent) == set(options.effects)
    kappa, cap = absent["relative_speed"], absent["free_flow_speed"]
    assert kappa.testable
    assert kappa.bound is not None
    assert kappa.bound < KAPPA
    # the bound is a speed that vehicles exceed
    speeds = np.concatenate([np.diff(s.x[:, :-1, 0], axis=0).ravel() / 0.2 for s in sequences])
    assert cap.testable
    assert cap.bound is not None
    assert np.quantile(speeds, 0.4) < cap.bound < speeds.max()
    assert d.base["lin.v0"]["after"] == pytest.approx(V0, rel=0.05)
    assert d.base["lin.L"]["after"] == pytest.approx(LENGTH, rel=0.05)
    assert d.gap.after == d.gap.before


@pytest.mark.thorough
def test_free_flow_speed_that_is_not_reached_is_not_testable() -> None:
    options = DiscoverOptions(effects=["free_flow_speed"], structure=False)
    d = diagnose_law(LAW, platoons(**MANY, calm=0.05, noise=0.1), options).diagnosis
    assert (d.verdict, d.not_testable) == ("not_testable", ["free_flow_speed"])
    (cap,) = d.absences
    assert (cap.testable, cap.bound, cap.detectable) == (False, None, None)
    assert cap.reason == "it acts too rarely, or in too few clusters, to be named"


@pytest.mark.parametrize(
    ("share", "hypotheses", "verdict"),
    [(0.1, [], "named"), (0.4, ["relative_speed"], "unknown")],
)
def test_effects_that_leave_structure_are_hypotheses(
    hidden_reaction: tuple[list[Sequence], DiscoverOptions, DiagnosisOutcome],
    monkeypatch: pytest.MonkeyPatch,
    share: float,
    hypotheses: list[str],
    verdict: str,
) -> None:
    """The effect lowers held-out costs by a third, a curve that remains by a share of the rest."""
    sequences, options, _ = hidden_reaction
    module = sys.modules[diagnose_law.__module__]
    monkeypatch.setattr(module, "significant_curves", partial(first_curve, share))
    d = diagnose_law(LAW, sequences, replace(options, structure=True)).diagnosis
    assert d.verdict == verdict
    assert [effect.name for effect in d.hypotheses] == hypotheses
    assert (d.gap.after == d.gap.before) == bool(hypotheses)
    assert any("deviations by" in note for note in d.notes) == bool(hypotheses)


def first_curve(
    share: float, engine: Engine, fit: Fit, candidates: list[Curves], alpha: float
) -> list[Curves]:
    """The first curve, as one that lowers the costs by a share."""
    gain = replace(candidates[0].gain, gain=share)
    return [replace(candidates[0], gain=gain, removed=0.1, relevant=True)]


def test_effects_of_law_with_parameters_at_bounds_are_hypotheses(
    hidden_reaction: tuple[list[Sequence], DiscoverOptions, DiagnosisOutcome],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sequences, options, _ = hidden_reaction
    module = sys.modules[diagnose_law.__module__]
    monkeypatch.setattr(module, "parameters_at_bounds", lambda *arguments: {"lin.L"})
    d = diagnose_law(LAW, sequences, options).diagnosis
    assert (d.verdict, d.effects, d.law_at_bounds) == ("unknown", [], ["lin.L"])
    assert [effect.name for effect in d.hypotheses] == ["relative_speed"]
    assert d.gap.after == d.gap.before
    assert "lin.L ends at a bound of the admissible values, with relative_speed" in verdict(d)


@pytest.mark.thorough
def test_diagnosis_of_smoothed_positions() -> None:
    sequences = platoons(relative_speed(KAPPA), **MANY | {"noise": 0.0})
    options = DiscoverOptions(effects=["relative_speed"], structure=False, smoothed=True)
    d = diagnose_law(LAW, sequences, options).diagnosis
    assert d.verdict == "named"
    assert d.effects[0].coefficients["kappa"].value == pytest.approx(KAPPA, abs=0.05)
    assert {"push", "push_time", "measurement"} <= {row.name for row in d.drivers}
    assert "behind the measured paths of the vehicles ahead" in d.gap.definition
