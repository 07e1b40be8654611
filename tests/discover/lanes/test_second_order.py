"""Laws that say an acceleration: their runs, derivatives, and effects, against other ways."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.app.python.inputs import model_options
from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence, collate
from nnode.discover.eligibility import not_offered
from nnode.discover.lanes.engine import TrafficEngine
from nnode.discover.residuals.variables import Curve
from nnode.model import System, build_model
from nnode.model.build import add_effects
from nnode.model.effects import CATALOGUE
from nnode.model.effects.lane import DriverHeterogeneity, Memory, RelativeSpeed, SpeedZone
from nnode.model.extend import extended
from nnode.simulation import TorchdiffeqSolver
from tests.discover.platoons import platoons

LAWS = ["idm", "fvdm", "gipps", "krauss", "helly"]


def model(law: str, *effects: dict[str, Any]) -> System:
    found = build_model(model_options(law, "measured"), 0).double()
    add_effects(found, list(effects))
    return found


@pytest.fixture(scope="module")
def sequences() -> list[Sequence]:
    found = platoons(number=3, noise=0.0)
    length = np.full(5, 4.5)
    return [
        replace(one, x=one.x[:, :n], length=length[:n])
        for one, n in zip(found, (5, 3, 2), strict=True)
    ]


def differences(engine: TrafficEngine, system: System, k: int) -> Tensor:
    """``(n,)`` central differences of the residuals by the k-th parameter."""
    row = ParameterVector(system).row
    step = 1e-4 * max(float(row[k].abs()), 0.1)
    both = row.repeat(2, 1)
    both[0, k] += step
    both[1, k] -= step
    first, second = engine.residuals(system, both)
    return (first - second) / (2 * step)


def near(found: Tensor, expected: Tensor, share: float) -> None:
    assert float(expected.norm()) > 0
    assert float((found - expected).norm()) < share * float(expected.norm())


@torch.no_grad()
@pytest.mark.parametrize(
    ("law", "close"),
    [
        ("idm", 2e-3),
        pytest.param("fvdm", 1e-3, marks=pytest.mark.thorough),
        pytest.param("gipps", 1e-2, marks=pytest.mark.thorough),
    ],
)
def test_runs_are_those_of_small_steps(sequences: list[Sequence], law: str, close: float) -> None:
    system, engine = model(law), TrafficEngine(sequences, np.inf)
    found = engine.simulate(system, ParameterVector(system).row[None])[0][..., 0]
    exact = TorchdiffeqSolver("rk4", dt=0.01)(system, collate(sequences_smoothed(engine))).x[..., 0]
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


@pytest.mark.parametrize("law", LAWS)
def test_tangents_are_differences(sequences: list[Sequence], law: str) -> None:
    system, engine = model(law), TrafficEngine(sequences)
    found = engine.tangents(system, ParameterVector(system).row)
    for k, name in enumerate(ParameterVector(system).names):
        expected = differences(engine, system, k)
        if float(expected.norm()) > 1e-2:  # else a bound of the formula holds everywhere
            # the trapezoidal rule at the samples against Runge and Kutta's between them
            near(found[k], expected, 0.06 if law in ("krauss", "gipps") else 0.01)
        else:
            assert float(found[k].norm()) < 2e-2, name


def test_tangents_with_effects_and_what_they_remember(sequences: list[Sequence]) -> None:
    effects = ({"name": "memory", "tau_m": 8.0}, {"name": "relative_speed", "kappa": 0.2})
    system, engine = model("idm", *effects), TrafficEngine(sequences)
    found = engine.tangents(system, ParameterVector(system).row)
    for k in range(len(found)):
        near(found[k], differences(engine, system, k), 0.02)


def test_weak_effects_are_seen_as_they_act(sequences: list[Sequence]) -> None:
    system, engine = model("idm"), TrafficEngine(sequences)
    row = ParameterVector(system).row
    now = engine.residuals(system, row[None])[0]
    for effect in (RelativeSpeed, SpeedZone):
        probe = effect.probes(engine.batch, system)[len(effect.probes(engine.batch, system)) // 2]
        (column,) = engine.screen_columns(system, row, effect, probe)
        ((name, step),) = probe.steps.items()
        value = effect.strengths[name].neutral + step
        changed, _ = extended(system, effect(**{**probe.options, name: value}))
        whole = (engine.residuals(changed, ParameterVector(changed).row[None])[0] - now) / step
        # an effect of this size bends the paths that its trace is taken along
        assert torch.nn.functional.cosine_similarity(column, whole, dim=0) > 0.99
        near(column, whole, 0.1)


def test_drivers_numbers_are_seen_as_they_act(sequences: list[Sequence]) -> None:
    system, engine = model("idm"), TrafficEngine(sequences)
    row = ParameterVector(system).row
    columns = engine.individual(system, row, DriverHeterogeneity, {})
    people = {name: [0.0, 1e-4] for name in engine.names}
    changed, _ = extended(system, DriverHeterogeneity(people=people, sigma=0.1))
    now = engine.residuals(system, row[None])[0]
    held = [
        k for k, name in enumerate(ParameterVector(changed).names) if not name.endswith("sigma")
    ]
    own = ParameterVector(changed).row
    own[held] = row
    near(columns[1], (engine.residuals(changed, own[None])[0] - now) / 1e-4, 0.03)


@pytest.mark.parametrize("what", ["gap", "speed difference"])
def test_a_curve_bends_the_acceleration(sequences: list[Sequence], what: str) -> None:
    engine, system = TrafficEngine(sequences), model("idm", {"name": "memory", "tau_m": 8.0})
    variable = next(one for one in engine.variables() if one.name == what)
    amounts = 0.1 * np.sin(np.linspace(0, np.pi, len(variable.knots)))
    system.terms.append(Curve(variable, amounts))
    found = engine.tangents(system, ParameterVector(system).row)
    for k, name in enumerate(ParameterVector(system).names):
        if "v0" not in name:  # of which these data hardly tell
            near(found[k], differences(engine, system, k), 0.05)


def test_what_is_offered_depends_on_the_law() -> None:
    assert not not_offered(RelativeSpeed, model("idm"))
    assert "T" in not_offered(Memory, model("ovm"))
    cap = CATALOGUE.effects["free_flow_speed"]
    assert "acceleration" in not_offered(cap, model("idm"))
    assert not not_offered(cap, build_model(model_options("lin", "measured"), 0))
    assert "memory" not in [one.name for one in CATALOGUE.of("traffic")]
    assert "memory" in [one.name for one in CATALOGUE.of("traffic", 2)]


def test_a_start_near_the_measured_accelerations() -> None:
    system = model("helly")
    engine = TrafficEngine(platoons(number=4, noise=0.01))
    before = engine.squares(system, ParameterVector(system).row).means().mean()
    found = engine.regression_start(system)
    assert engine.squares(found, ParameterVector(found).row).means().mean() < before
