"""A whole diagnosis in memory: what is hidden is named, and what is not is bounded."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nnode.data.sequence import Sequence
from nnode.diagnosis.options import DiscoverOptions
from nnode.diagnosis.outcome import DiagnosisOutcome
from nnode.diagnosis.report.files import verdict
from nnode.diagnosis.single_law import _verdict, diagnose_law
from tests.diagnosis.conftest import KAPPA, MANY
from tests.diagnosis.platoons import LENGTH, V0, lin, platoons, relative_speed

LAW = lin(v0=25.0, length=7.0)


def test_a_hidden_effect_is_named_with_its_coefficient_and_what_it_changes(
    hidden_reaction: tuple[list[Sequence], DiscoverOptions, DiagnosisOutcome],
) -> None:
    sequences, _, found = hidden_reaction
    d = found.diagnosis
    assert d.verdict == "named"
    (effect,) = d.effects
    assert (effect.name, effect.where) == ("relative_speed", "everybody, everywhere")
    assert effect.p_value < 0.05
    assert effect.gain > 0
    kappa = effect.coefficients["kappa"]
    assert kappa.value == pytest.approx(KAPPA, abs=0.05)
    assert kappa.low < KAPPA < kappa.high
    assert kappa.unit == "1"
    (zone,) = d.absences
    assert zone.name == "speed_zone"
    # judged where half of the intervals of the usual length are known better
    assert zone.testable
    assert "half of the intervals" in zone.reason
    assert d.hypotheses == d.agents == d.data_faults == []
    # eleven open clusters: no two-sided p-value is below 2^-10
    assert (d.clusters.exploration, d.clusters.confirmation) == (d.screen.clusters, 5) == (11, 5)
    assert d.screen.floor == 2**-10
    assert d.screen.floor <= effect.p_value
    assert (d.screen.effect, d.screen.p_value) == ("relative_speed", effect.p_value)
    # five confirmation sequences, all predicted better: the smallest p-value that they allow
    assert d.confirmation.confirmed
    assert d.confirmation.p_value == effect.confirmed == 2**-5
    assert sorted(d.split["exploration"] + d.split["confirmation"]) == sorted(
        s.name for s in sequences
    )
    assert [one["name"] for one in d.confirmation_errors] == d.split["confirmation"]
    assert len(d.split["confirmation"]) == 5
    assert all(one["after"] < one["before"] for one in d.confirmation_errors)
    gap = d.gap
    assert gap.closed == pytest.approx((gap.before - gap.after) / (gap.before - gap.noise_floor))
    assert gap.closed > 0.3
    assert d.notes == []
    names = [term.name for term in found.extended.terms if hasattr(term, "name")]
    assert "relative_speed" in names


@pytest.mark.thorough
def test_nothing_is_named_where_the_law_is_right() -> None:
    sequences = platoons(**MANY)
    options = DiscoverOptions(effects=["relative_speed", "speed_zone", "free_flow_speed"])
    d = diagnose_law(LAW, sequences, options).diagnosis
    assert (d.verdict, d.effects, d.hypotheses, d.unknown) == ("none", [], [], None)
    assert (d.confirmation.confirmed, d.confirmation.p_value) == (None, None)
    absent = {one.name: one for one in d.absences}
    assert set(absent) == set(options.effects)
    kappa, cap = absent["relative_speed"], absent["free_flow_speed"]
    assert kappa.testable
    assert kappa.bound is not None
    assert kappa.bound < KAPPA
    # nobody keeps to a lower speed, of those that were tried in the open sequences
    speeds = np.concatenate([np.diff(s.x[:, :-1, 0], axis=0).ravel() / 0.2 for s in sequences])
    assert cap.testable
    assert cap.bound is not None
    assert np.quantile(speeds, 0.4) < cap.bound < speeds.max()
    assert d.base["lin.v0"]["after"] == pytest.approx(V0, rel=0.05)
    assert d.base["lin.L"]["after"] == pytest.approx(LENGTH, rel=0.05)
    assert d.gap.after == d.gap.before


@pytest.mark.thorough
def test_a_desired_speed_that_never_binds_cannot_be_tested() -> None:
    options = DiscoverOptions(effects=["free_flow_speed"], structure=False)
    d = diagnose_law(LAW, platoons(**MANY, calm=0.05, noise=0.1), options).diagnosis
    assert (d.verdict, d.not_testable) == ("not_testable", ["free_flow_speed"])
    (cap,) = d.absences
    assert (cap.testable, cap.bound, cap.detectable) == (False, None, None)
    assert cap.reason == "it acts too rarely, or in too few clusters, to be named"


@pytest.mark.parametrize(
    ("left", "removed", "verdict"),
    [([], 0.9, "named"), ([], -0.1, "named"), ([0.1], 0.9, "named"), ([0.5], 0.2, "unknown")],
)
def test_structure_that_is_left_makes_the_verdict_unknown(
    left: list[float], removed: float, verdict: str
) -> None:
    """Errors of positions may grow with a confirmed effect, without any structure that is left."""
    selection = SimpleNamespace(steps=[SimpleNamespace(rivals=[])])
    curves = [SimpleNamespace(removed=share) for share in left]
    given: Any = (selection, curves, removed, False, True, False, [])
    assert _verdict(*given) == verdict


def test_a_law_with_parameters_at_bounds_makes_effects_hypotheses(
    hidden_reaction: tuple[list[Sequence], DiscoverOptions, DiagnosisOutcome],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sequences, options, _ = hidden_reaction
    module = sys.modules[diagnose_law.__module__]
    monkeypatch.setattr(module, "parameters_at_bounds", lambda base, fit, cluster: {"lin.L"})
    found = diagnose_law(LAW, sequences, options)
    d = found.diagnosis
    assert (d.verdict, d.effects, d.law_at_bounds) == ("unknown", [], ["lin.L"])
    assert [effect.name for effect in d.hypotheses] == ["relative_speed"]
    assert d.gap.after == d.gap.before
    assert "lin.L ends at a bound of the admissible values, with relative_speed" in verdict(d)


@pytest.mark.thorough
def test_smoothed_positions_are_used_one_second_apart_with_drivers_who_differ() -> None:
    sequences = platoons(relative_speed(KAPPA), **MANY | {"noise": 0.0})
    options = DiscoverOptions(effects=["relative_speed"], structure=False, smoothed=True)
    found = diagnose_law(LAW, sequences, options)
    d = found.diagnosis
    assert d.verdict == "named"
    assert d.effects[0].coefficients["kappa"].value == pytest.approx(KAPPA, abs=0.05)
    assert {"push", "push_time", "measurement"} <= {row.name for row in d.drivers}
    assert "behind the measured paths of the vehicles ahead" in d.gap.definition
