"""Lanes by their formula against the same lanes by PyTorch, term by term as code would run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.calibrate.parameters import ParameterVector
from nnode.data.sequence import Sequence
from nnode.diagnosis.lanes.engine import TrafficEngine
from nnode.diagnosis.residuals.variables import Curve
from nnode.model import System
from nnode.model.arrays import Formulas
from nnode.model.build import add_effects, build_model
from nnode.model.effects import CATALOGUE, IndividualEffect
from nnode.model.effects.lane import DriverHeterogeneity
from nnode.model.parse import parse
from nnode.simulation import rhs
from tests.diagnosis.platoons import LENGTH, V0, platoons, relative_speed
from tests.model.test_tensors import FORMULAS

LIN = {"term": "lin", "name": "lin", "v0": V0, "L": LENGTH, "L_min": 1.0}
LOG = {"term": "log", "name": "log", "v0": 18.0, "L": LENGTH, "L_min": 1.0}
N4 = {"term": "network_speed", "name": "n4", "hidden": 4, "v0": 20.0, "box": None}
EFFECTS: dict[str, dict[str, float]] = {
    "relative_speed": {"kappa": 0.3},
    "time_gap": {"h": 0.2},
    "multi_anticipation": {"c": 0.2},
    "reaction_delay": {"T": 0.5},
    "inertia": {"tau_v": 0.6},
    "speed_zone": {"alpha": 0.8, "a": 300.0, "b": 400.0},
    "speed_period": {"alpha": 0.8, "a": 104.0, "b": 110.0},
    "free_flow_speed": {"v_max": 18.0},
    "asymmetric_response": {"kappa_open": 0.2, "kappa_close": 0.3},
    "leader_speed": {"weight": 0.3},
    "leader_length": {"beta": 0.4},
    "driver_heterogeneity": {"sigma": 0.1},
    "vehicle_class": {"phi": 0.9},
}
CASES = [
    (LIN, "measured", ()),
    (LIN, "constant", ()),
    (LOG, "measured", ("relative_speed",)),
    (LOG, "constant", ("leader_speed", "relative_speed")),
    (N4, "measured", ("speed_zone",)),
    (N4, "constant", ("reaction_delay",)),
    (LIN, "measured", ("speed_period", "leader_length", "vehicle_class")),
    (LIN, "measured", ("driver_heterogeneity", "free_flow_speed", "multi_anticipation")),
    (LIN, "measured", ("reaction_delay", "time_gap", "inertia")),
    (LIN, "constant", ("multi_anticipation", "time_gap", "asymmetric_response")),
]


@pytest.fixture(scope="module")
def sequences() -> list[Sequence]:
    """Platoons of 5, 3 and 2 vehicles: padding and missing second vehicles are a case."""
    found, rng = [], np.random.default_rng(0)
    made = platoons(relative_speed(0.2), number=3, driver=0.2, seconds=8.0)
    for one, n in zip(made, (5, 3, 2), strict=True):
        kind = ("truck", *["car"] * 4)
        given = replace(one, length=rng.uniform(4, 9, 5), kind=kind)
        found.append(given.select(np.arange(5) < n))
    return found


def model(law: dict[str, Any], leader: str, effects: tuple[str, ...]) -> System:
    torch.manual_seed(0)
    found = build_model({**law, "leader": leader}).double()
    people = {f"r/{s}": [0.1, -0.1, 0.05, 0.0, 0.0] for s in range(3)}
    own = {"driver_heterogeneity": {"people": people}}
    add_effects(found, [{"name": n, **EFFECTS[n], **own.get(n, {})} for n in effects])
    return found


@contextmanager
def as_code() -> Iterator[None]:
    """Every model is taken for one with terms that are code."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rhs, "formula_of", lambda *args: None)
        yield


def both(sequences: list[Sequence], ask: Any) -> tuple[Tensor, Tensor]:
    found = ask(TrafficEngine(sequences))
    with as_code():
        return found, ask(TrafficEngine(sequences))


def same(found: Tensor, expected: Tensor, close: float = 1e-9) -> None:
    assert found.shape == expected.shape
    torch.testing.assert_close(found, expected, rtol=0.0, atol=close * float(expected.abs().max()))


def rows_of(system: System) -> Tensor:
    row = ParameterVector(system).row
    return torch.stack([row, 1.01 * row, row + 0.01])


@pytest.mark.parametrize("text", FORMULAS)
def test_a_straight_line_function(text: str) -> None:
    rng, node = np.random.default_rng(3), parse(text)
    values = {name: rng.uniform(0.3, 2.0, 50) for name in "abc"}
    (found,) = Formulas([node])(values)
    tensors = {name: torch.from_numpy(value) for name, value in values.items()}
    same(torch.from_numpy(found), Formulas([node])(tensors)[0], close=1e-14)


@pytest.mark.parametrize(("law", "leader", "effects"), CASES)
def test_runs_and_tangents(
    sequences: list[Sequence], law: dict[str, Any], leader: str, effects: tuple[str, ...]
) -> None:
    system = model(law, leader, effects)
    assert rhs.formula_of(system) is not None
    rows = rows_of(system)
    same(*both(sequences, lambda engine: engine.residuals(system, rows)))
    same(*both(sequences, lambda engine: engine.tangents(system, rows[0])))


@pytest.mark.parametrize("leader", ["measured", "constant"])
@pytest.mark.parametrize("effects", [(), ("relative_speed",), ("inertia",)])
def test_screens(sequences: list[Sequence], leader: str, effects: tuple[str, ...]) -> None:
    system = model(LIN, leader, effects)
    row = ParameterVector(system).row

    def ask(engine: TrafficEngine) -> Tensor:
        found = [
            engine.screen_columns(system, row, effect, probe)
            for effect in CATALOGUE.of("traffic")
            if effect.name not in effects and not issubclass(effect, IndividualEffect)
            for probe in effect.probes(engine.batch, system)[:12]
        ]
        return torch.cat([columns / columns.abs().max().clamp(min=1e-9) for columns in found])

    same(*both(sequences, ask), close=1e-8)  # of differences of rates


def test_individual_effects(sequences: list[Sequence]) -> None:
    system = model(LIN, "measured", ("relative_speed",))
    row = ParameterVector(system).row
    same(*both(sequences, lambda e: e.individual(system, row, DriverHeterogeneity, {})), close=1e-8)


def test_a_model_with_a_memory_starts_where_it_is(sequences: list[Sequence]) -> None:
    system = model(LIN, "measured", ("inertia",))
    found = TrafficEngine(sequences).regression_start(system)
    assert ParameterVector(found).row.tolist() == ParameterVector(system).row.tolist()


@pytest.mark.thorough
@pytest.mark.parametrize("leader", ["measured", "constant"])
def test_curves(sequences: list[Sequence], leader: str) -> None:
    system = model(LIN, leader, ("relative_speed",))
    for variable in TrafficEngine(sequences).variables():
        if variable.lengths:
            variable = variable.wave(len(variable.lengths) // 2)
        rng = np.random.default_rng(1)
        amounts = rng.normal(0, 0.2, 2 if variable.lengths else len(variable.knots))

        def ask(engine: TrafficEngine, variable: Any = variable) -> Tensor:
            def rates(state: Any) -> list[Tensor]:
                way = variable.direction(state)
                return [w[..., None] * way for w in variable.weights(state).unbind(-1)]

            return engine.response(system, ParameterVector(system).row, rates)

        same(*both(sequences, ask))
        bent = model(LIN, leader, ("relative_speed",))
        bent.terms.append(Curve(variable, amounts))
        rows = rows_of(bent)
        same(*both(sequences, lambda e, bent=bent, rows=rows: e.residuals(bent, rows)))
        same(*both(sequences, lambda e, bent=bent, rows=rows: e.tangents(bent, rows[0])))
