"""Models without compiled code: the same states and the exact discrete gradient."""

from __future__ import annotations

import logging

import pytest
import torch
from torch import Tensor

from nnode.model import Crowd, Law, System, Traffic, make_law
from nnode.model.term import State, Term
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from tests.builders import social_forces
from tests.simulation.fused.compare import single
from tests.simulation.scenes import crowd

DT = 0.02


class Sway(Term):
    """A made-up term: every agent is drawn to everybody's mean place, more and more in time."""

    name = "sway"
    formula = "c tanh(mean(x) - x) (1 + t)"
    source = "none"

    def __init__(self, c: float = 0.4) -> None:
        super().__init__()
        self.declare("c", c, unit="m/s")
        self.c: Tensor

    def forward(self, state: State) -> Tensor:
        real = state.scene.agent[..., None]
        mean = (state.x * real).sum(1, keepdim=True) / state.scene.count
        return self.c * torch.tanh(0.05 * (mean - state.x)) * (1 + state.t) * real


def network() -> Law:
    return make_law("network_speed", hidden=3, v0=18.0, generator=torch.Generator().manual_seed(3))


MODELS = {
    "sway": lambda: Traffic([make_law("lin", v0=18.0, L=4.0), Sway()]),
    "two_laws": lambda: Traffic([make_law("lin", v0=18.0, L=4.0), network()]),
    "measured": lambda: Traffic([network(), Sway()], leader="measured"),
    "crowd": lambda: Crowd(
        [make_law("relaxation"), make_law("social_force", A=2.0, k=30.0, kappa=9.0, B=0.1), Sway()]
    ),
}


def test_models_are_not_touched(ragged) -> None:  # type: ignore[no-untyped-def]
    model: System = Traffic([make_law("lin", v0=18.0, L=4.0), Sway()])
    stacked = {"terms.1.c": torch.tensor([0.1, 0.2], dtype=torch.float64)}
    FusedSolver(DT).ensemble(model, stacked, single(ragged))
    assert model.terms[1].c.item() == 0.4
    assert [name for name, _ in model.named_parameters()] == [
        "terms.0.v0",
        "terms.0.L",
        "terms.1.c",
    ]


SAID = {
    "sway": "it does not cover sway",
    "two_laws": "it covers models that begin with a law",
    "measured": "it does not cover sway",
    "crowd": "it does not cover sway",
}


@pytest.mark.parametrize("name", MODELS)
def test_it_is_said_once_in_a_run_and_why(name, ragged, caplog) -> None:  # type: ignore[no-untyped-def]
    system, solver = MODELS[name](), FusedSolver()
    batch = single([crowd(3, samples=4)] if system.domain == "crowd" else ragged)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            simulated = solver(system, batch).x
    assert torch.equal(simulated, TorchdiffeqSolver(gradient="discrete")(system, batch).x)
    assert simulated.requires_grad
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    for words in ("in PyTorch", SAID[name], "docs/performance.md"):
        assert words in record.getMessage()
    assert solver.uncompiled in record.getMessage()


def test_compiled_models_and_the_baseline_without_forces_say_nothing(ragged, caplog) -> None:  # type: ignore[no-untyped-def]
    solver = FusedSolver()
    with caplog.at_level(logging.INFO):
        solver(Traffic([make_law("lin", v0=18.0, L=4.0)]), single(ragged))
        solver(
            Crowd(social_forces(B=0.1)),
            single([crowd(3, samples=4)]),
        )
        solver(Crowd([make_law("relaxation")]), single([crowd(3, samples=4)]))
    assert not caplog.records
    assert solver.uncompiled == ""
