"""Models without compiled code are simulated in PyTorch."""

from __future__ import annotations

import logging

import pytest
import torch
from torch import Tensor

from nnode.model import Crowd, Traffic, make_law
from nnode.model.term import State, Term
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from tests.builders import social_forces
from tests.simulation.fused.compare import single
from tests.simulation.scenes import LAWS, crowd

DT = 0.02


class Sway(Term):
    """A force towards the mean position, which grows in time."""

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


#: Models, and the reason why they are not compiled.
MODELS = {
    "sway": (lambda: Traffic([LAWS["lin"](), Sway()]), "it does not cover sway"),
    "two_laws": (
        lambda: Traffic([LAWS["lin"](), LAWS["n4"]()]),
        "it covers models that begin with a law",
    ),
    "measured": (
        lambda: Traffic([LAWS["n4"](), Sway()], leader="measured"),
        "it does not cover sway",
    ),
    "crowd": (lambda: Crowd([*social_forces(B=0.1), Sway()]), "it does not cover sway"),
}


def test_ensembles_do_not_change_the_model(ragged) -> None:
    model = MODELS["sway"][0]()
    stacked = {"terms.1.c": torch.tensor([0.1, 0.2], dtype=torch.float64)}
    FusedSolver(DT).ensemble(model, stacked, single(ragged))
    assert model.terms[1].c.item() == 0.4
    assert [name for name, _ in model.named_parameters()] == [
        "terms.0.v0",
        "terms.0.L",
        "terms.1.c",
    ]


@pytest.mark.parametrize("name", MODELS)
def test_one_warning_per_solver(name, ragged, caplog) -> None:
    build, reason = MODELS[name]
    system, solver = build(), FusedSolver()
    batch = single([crowd(3, samples=4)] if system.domain == "crowd" else ragged)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            simulated = solver(system, batch).x
    assert torch.equal(simulated, TorchdiffeqSolver(gradient="discrete")(system, batch).x)
    assert simulated.requires_grad
    (record,) = caplog.records
    assert record.levelname == "WARNING"
    for text in ("in PyTorch", reason, "docs/performance.md", solver.uncompiled):
        assert text in record.getMessage()


def test_no_warning_for_compiled_models_and_models_without_forces(ragged, caplog) -> None:
    solver, people = FusedSolver(), single([crowd(3, samples=4)])
    with caplog.at_level(logging.INFO):
        solver(Traffic([LAWS["lin"]()]), single(ragged))
        solver(Crowd(social_forces(B=0.1)), people)
        solver(Crowd([make_law("relaxation")]), people)
    assert not caplog.records
    assert solver.uncompiled == ""
