"""Results do not depend on the origin of coordinates, also in float32."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.app.python.inputs import model_options
from nnode.calibrate.cost import sequence_costs
from nnode.calibrate.ensemble import EnsembleCost
from nnode.calibrate.parameters import ParameterVector
from nnode.calibrate.problem import ResidualProblem
from nnode.data.sequence import Batch, Sequence, collate
from nnode.errors import ConfigError
from nnode.model import Crowd, System, Traffic, make_law
from nnode.model.build import add_effects, build_model
from nnode.model.effects import CATALOGUE
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS, Law, law_from
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from nnode.simulation.base import simulated_batch
from tests.builders import lane, social_forces, straight

#: Distances of the origin in coordinates of a country and of UTM, m.
AWAY = (1e5, 7e6)
SOLVERS = {
    "torchdiffeq": TorchdiffeqSolver("euler", "discrete", 0.02),
    "fused": FusedSolver(0.02),
}


def people(shift: float = 0.0) -> Sequence:
    """Two opposite streams of people in contact, between two walls."""
    start = np.array([[0.0, 0.0], [1.2, 0.3], [4.0, 0.62], [5.0, -0.4], [2.5, 1.0]])
    speed = np.array([[1.3, 0.0], [1.1, 0.0], [-1.2, 0.0], [-1.0, 0.0], [0.9, -0.3]])
    walls = np.array([[-5.0, -1.0, 15.0, -1.0], [15.0, 2.0, -5.0, 2.0]])
    return replace(straight(start + shift, speed, 21, 0.1, walls=walls + shift), v=None)


def cars(shift: float = 0.0, number: int = 5) -> Sequence:
    time = 0.2 * np.arange(36)[:, None]
    x = 25.0 * np.arange(number) + 15 * time + 8 * np.sin(time / 4)
    return lane(x + shift, name=f"cars {number}")


def crowd(dtype: torch.dtype) -> System:
    return Crowd(social_forces(k=100.0, kappa=10.0)).to(dtype)


def lin(dtype: torch.dtype) -> System:
    return Traffic([make_law("lin", v0=25.0, L=5.0)]).to(dtype)


def idm(dtype: torch.dtype) -> System:
    return Traffic([law_from("idm", CAR_FOLLOWING_LAWS["idm"])], leader="measured").to(dtype)


def platoons(shift: float) -> Batch:
    return collate([cars(shift), cars(shift + 3e4, 3)])


CASES = {
    "people": (crowd, lambda shift: collate([people(shift)])),
    "lin": (lin, platoons),
    "idm": (idm, platoons),
}


def single(batch: Batch) -> Batch:
    return batch.to(dtype=torch.float32)


def gradient(model: System, solver: object, batch: Batch) -> tuple[Tensor, Tensor]:
    path = solver(model, batch)
    parts = torch.autograd.grad(sequence_costs(path, batch).sum(), list(model.parameters()))
    return path.x.detach(), torch.cat([part.flatten() for part in parts])


@pytest.mark.thorough
@pytest.mark.parametrize("kind", SOLVERS)
@pytest.mark.parametrize("case", CASES)
def test_float32_does_not_depend_on_the_origin(case: str, kind: str) -> None:
    build, make = CASES[case]
    exact = SOLVERS[kind](build(torch.float64), make(0.0)).x.detach()
    near, slope = gradient(build(torch.float32), SOLVERS[kind], single(make(0.0)))
    real = make(0.0).valid[..., None].expand_as(exact)
    assert (near - exact)[real].abs().max() < 0.01
    for shift in AWAY:
        far, far_slope = gradient(build(torch.float32), SOLVERS[kind], single(make(shift)))
        # measured positions have rounding errors of 1e-9 m at 7,000 km in float64, which can
        # change the last digit in float32
        assert (far - shift - near)[real].abs().max() < 1e-3
        torch.testing.assert_close(far_slope, slope, rtol=1e-3, atol=1e-3)


def test_ensemble_costs_and_tangents_far_away() -> None:
    model, solver = idm(torch.float32), FusedSolver()
    batches = [single(platoons(shift)) for shift in (0.0, 7e6)]
    row = ParameterVector(model).row[None]
    near, far = (EnsembleCost(model, batch, solver).costs(row) for batch in batches)
    torch.testing.assert_close(near, far, rtol=1e-4, atol=1e-6)
    near, far = (ResidualProblem(model, batch, solver)(row[0].numpy()) for batch in batches)
    np.testing.assert_allclose(near.cost, far.cost, rtol=1e-4)
    scale = np.abs(near.gradient).max()
    np.testing.assert_allclose(near.gradient, far.gradient, atol=1e-3 * scale)


def test_float64_positions_are_not_shifted() -> None:
    batch = collate([people(1e5)])
    simulated, origin = simulated_batch(crowd(torch.float64), batch)
    assert simulated is batch
    assert origin is None


def test_float32_positions_are_shifted_in_simulations_only() -> None:
    batch = collate([people(7e6), replace(people(-3e6), walls=None)])
    moved = single(batch)
    for name in ("x", "destination", "walls"):
        torch.testing.assert_close(
            getattr(moved, name), getattr(batch, name), rtol=0, atol=0, equal_nan=True
        )
    near, origin = simulated_batch(crowd(torch.float32), moved)
    assert origin is not None
    assert (origin == origin.round()).all()
    assert near.x.dtype == near.walls.dtype == near.destination.dtype == torch.float32
    for name, ends in (("x", 1), ("destination", 1), ("walls", 2)):
        restored = getattr(near, name).double() + origin.repeat(1, ends)[:, None]
        torch.testing.assert_close(
            restored, getattr(batch, name), rtol=0, atol=1e-5, equal_nan=True
        )


def test_measured_leader_has_no_rounding_error() -> None:
    batch = single(collate([cars(7e6), cars(7e6, 3)]))
    x = FusedSolver()(idm(torch.float32), batch).x
    for b, last in enumerate((4, 2)):
        assert torch.equal(x[:, b, last], batch.x[:, b, last])


@pytest.mark.parametrize(
    "name", ["lin", "log", "n4", "sf", "nn", *CAR_FOLLOWING_LAWS, *PEDESTRIAN_LAWS]
)
def test_laws_do_not_depend_on_position(name: str) -> None:
    assert not build_model(model_options(name)).depends_on_position


PLACES = {"speed_zone", "slope", "obstacle", "attraction"}


@pytest.mark.parametrize(
    ("kind", "leader"), [("lin", "measured"), ("idm", "measured"), ("sf", None)]
)
def test_effects_that_depend_on_position(kind: str, leader: str | None) -> None:
    catalogue = CATALOGUE.of("crowd" if kind == "sf" else "traffic", every=True)
    dependent = {}
    for effect in (e for e in catalogue if e.__module__.startswith("nnode.")):
        with suppress(ConfigError):  # effects on laws of the other order
            model = build_model(model_options(kind, leader, [effect.name]))
            dependent[effect.name] = model.depends_on_position
    assert dependent == {name: name in PLACES for name in dependent}


def test_terms_in_code_may_depend_on_position() -> None:
    class Windy(Law):
        def forward(self, state):
            return super().forward(state) + state.x * 1e-3

    assert Crowd([Windy("relaxation")]).depends_on_position


def test_zone_far_away() -> None:
    def simulated(shift: float, dtype: torch.dtype, zones: int = 1) -> Tensor:
        model = Traffic([make_law("lin", v0=25.0, L=5.0)], leader="measured")
        zone = {"name": "speed_zone", "alpha": 0.5, "a": shift + 60.0, "b": shift + 160.0}
        add_effects(model, zones * [zone])
        batch = platoons(shift).to(dtype=dtype)
        return SOLVERS["torchdiffeq"](model.to(dtype), batch).x.detach()[:, 0] - shift

    exact = simulated(0.0, torch.float64)
    assert (exact - simulated(0.0, torch.float64, zones=0)).abs().max() > 1
    for shift, limit in ((0.0, 0.02), (4096.0, 0.2)):
        assert (simulated(shift, torch.float32) - exact).abs().max() < limit
