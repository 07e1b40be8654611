"""Runs, derivatives and effects of laws, mostly of accelerations, against other ways."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from nnode.app.python.inputs import model_options
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence, collate
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.residuals.variables import Curve
from nnode.model import System, build_model
from nnode.model.build import add_effects
from nnode.model.effects import Effect
from nnode.model.effects.lane import RelativeSpeed, SpeedZone
from nnode.model.extend import extended
from nnode.simulation import TorchdiffeqSolver
from tests.diagnosis.agreement import differences, distance, residuals
from tests.diagnosis.platoons import lin, platoons


def model(law: str, *effects: dict[str, Any]) -> System:
    if law == "lin":
        return lin(*effects).double()
    found = build_model(model_options(law, "measured"), 0).double()
    add_effects(found, list(effects))
    return found


@pytest.fixture(scope="module")
def sequences() -> list[Sequence]:
    found = platoons(number=3, noise=0.0)
    return [
        replace(one, length=np.full(5, 4.5)).select(np.arange(5) < n)
        for one, n in zip(found, (5, 3, 2), strict=True)
    ]


@pytest.mark.thorough
@torch.no_grad()
@pytest.mark.parametrize(("law", "close"), [("idm", 2e-3), ("fvdm", 1e-3), ("gipps", 1e-2)])
def test_runs_are_those_of_smaller_steps(sequences: list[Sequence], law: str, close: float) -> None:
    system, engine = model(law), TrafficEngine(sequences, np.inf)
    found = engine.simulate(system, ParameterVector(system).row[None])[0][..., 0]
    exact = TorchdiffeqSolver("rk4", dt=0.05)(system, collate(sequences_smoothed(engine))).x[..., 0]
    away = torch.where(engine.follows, found - exact, 0.0)
    assert float(away.abs().max()) < close


def sequences_smoothed(engine: TrafficEngine) -> list[Sequence]:
    batch = engine.smoothed
    return [
        replace(
            one,
            x=batch.x[: one.n_samples, i, : one.n_agents].numpy(),
            v=batch.v[: one.n_samples, i, : one.n_agents].numpy(),
        )
        for i, one in enumerate(engine.sequences)
    ]


MEMORY, REACTION = {"name": "memory", "tau_m": 8.0}, {"name": "relative_speed", "kappa": 0.2}


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("law", "effects", "share"),
    [
        ("lin", [], 0.06),
        ("lin", [REACTION], 0.06),
        ("lin", [{"name": "inertia", "tau_v": 0.6}], 0.06),
        ("lin", [{"name": "reaction_delay", "T": 0.5}], 0.06),
        ("lin", [{"name": "time_gap", "h": 0.1}], 0.06),
        ("lin", [{"name": "multi_anticipation", "c": 0.2}], 0.06),
        ("idm", [], 0.01),
        ("idm", [MEMORY, REACTION], 0.02),
        ("fvdm", [], 0.01),
        ("helly", [], 0.01),
        # the trapezoidal rule at the samples against Runge and Kutta's between them
        ("gipps", [], 0.06),
        ("krauss", [], 0.06),
    ],
)
def test_tangents_are_differences(
    sequences: list[Sequence], law: str, effects: list[dict[str, Any]], share: float
) -> None:
    made = platoons(number=4, driver=0.2) if law == "lin" else sequences
    system, engine = model(law, *effects), TrafficEngine(made)
    row = ParameterVector(system).row
    expected = differences(engine, system, row, 1e-4 * row.abs().clamp(min=0.1))
    each = zip(engine.tangents(system, row), expected, ParameterVector(system).names, strict=True)
    for tangent, difference, name in each:
        if float(difference.norm()) > 1e-2:  # else a bound of the formula holds everywhere
            assert distance(tangent, difference) < share, name
        else:
            assert float(tangent.norm()) < 2e-2, name


@pytest.mark.parametrize(
    ("law", "effect"), [("lin", RelativeSpeed), ("idm", RelativeSpeed), ("idm", SpeedZone)]
)
def test_weak_effects_are_seen_as_they_act(
    sequences: list[Sequence], law: str, effect: type[Effect]
) -> None:
    system, engine = model(law), TrafficEngine(sequences)
    probes = effect.probes(engine.batch, system)
    probe = probes[len(probes) // 2]
    (column,) = engine.screen_columns(system, ParameterVector(system).row, effect, probe)
    ((name, step),) = probe.steps.items()
    value = effect.strengths[name].neutral + step
    changed, _ = extended(system, effect(**{**probe.options, name: value}))
    whole = (residuals(engine, changed) - residuals(engine, system)) / step
    # an effect of this size bends the paths that its trace is taken along
    assert torch.nn.functional.cosine_similarity(column, whole, dim=0) > 0.99
    assert distance(column, whole) < 0.1


@pytest.mark.parametrize("what", ["gap", "speed difference"])
def test_a_curve_bends_the_acceleration(sequences: list[Sequence], what: str) -> None:
    engine, system = TrafficEngine(sequences), model("idm", {"name": "memory", "tau_m": 8.0})
    variable = next(one for one in engine.variables() if one.name == what)
    amounts = 0.1 * np.sin(np.linspace(0, np.pi, len(variable.knots)))
    system.terms.append(Curve(variable, amounts))
    row = ParameterVector(system).row
    tangents = engine.tangents(system, row)
    expected = differences(engine, system, row, 1e-4 * row.abs().clamp(min=0.1))
    for k, name in enumerate(ParameterVector(system).names):
        if "v0" not in name:  # of which these data hardly tell
            assert distance(tangents[k], expected[k]) < 0.05


def test_a_start_near_the_measured_accelerations() -> None:
    system = model("helly")
    engine = TrafficEngine(platoons(number=4, noise=0.01))
    before = engine.squares(system, ParameterVector(system).row).means().mean()
    found = engine.regression_start(system)
    assert engine.squares(found, ParameterVector(found).row).means().mean() < before
