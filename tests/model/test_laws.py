"""Follow-the-leader laws against the paper's formulas."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch

from nnode.data.sequence import Batch, collate
from nnode.model import Scene, State, Traffic, make_law
from tests.builders import lane
from tests.model.following import rates

GAPS = [2.5, 5.0, 7.3, 18.0, 60.0]


def at_rest(*platoons: list[float]) -> Batch:
    """Platoons at rest at positions (m), the leader last."""
    return collate([lane([p, p], name=str(i)) for i, p in enumerate(platoons)])


@pytest.mark.parametrize("gap", GAPS)
@pytest.mark.parametrize(
    ("name", "expected"),
    [("lin", lambda gap: 27.0 * (1 - 4.0 / gap)), ("log", lambda gap: 27.0 * math.log(gap / 4.0))],
)
def test_speeds_of_laws(name: str, expected: Callable[[float], float], gap: float) -> None:
    speed = make_law(name, v0=27.0, L=4.0).speed(torch.tensor(gap, dtype=torch.float64))
    assert speed.item() == pytest.approx(expected(gap), rel=1e-14)


@pytest.mark.parametrize("gap", [0.0, -3.0, -1e6])
def test_log_and_its_gradient_without_a_gap(gap: float) -> None:
    term = make_law("log")
    at = torch.tensor(gap, dtype=torch.float64, requires_grad=True)
    speed = term.speed(at)
    gradients = torch.autograd.grad(speed, [at, *term.parameters()])
    assert speed.isfinite()
    assert speed < 0
    assert all(g.isfinite() for g in gradients)


def test_network_speed() -> None:
    term = make_law("network_speed", hidden=2, generator=torch.Generator().manual_seed(1))
    (w1, w2), (b1, b2) = (
        [getattr(layer, name).detach().numpy() for layer in term.network.layers]
        for name in ("weight", "bias")
    )
    gap = 11.0
    expected = (w2 @ np.log(1 + np.exp(w1[:, 0] * gap + b1)) + b2).item()
    assert term.speed(torch.tensor([gap], dtype=torch.float64)).item() == pytest.approx(
        expected, rel=1e-8
    )


def test_speeds_in_padded_platoons() -> None:
    term = make_law("lin", v0=20.0, L=4.0)
    batch = at_rest([0.0, 8.0, 28.0, 30.0], [5.0, 15.0], [3.0])
    speeds = term(State(torch.zeros(()), batch.x[0], None, Scene.of(batch)))[..., 0].detach()
    expected = [
        [20 * (1 - 4 / 8), 20 * (1 - 4 / 20), 20 * (1 - 4 / 2), 20.0],
        [20 * (1 - 4 / 10), 20.0, 0.0, 0.0],
        [20.0, 0.0, 0.0, 0.0],
    ]
    np.testing.assert_allclose(speeds, expected, rtol=1e-14)


def test_rate_of_a_measured_leader_is_zero() -> None:
    model = Traffic([make_law("lin", v0=20.0, L=4.0)], leader="measured")
    np.testing.assert_allclose(rates(model, at_rest([0.0, 8.0]))[0, :, 0], [10.0, 0.0])


def test_terms_add_up() -> None:
    model = Traffic([make_law("lin", v0=20.0, L=4.0), make_law("lin", v0=3.0, L=2.0)])
    np.testing.assert_allclose(rates(model, at_rest([0.0, 8.0]))[0, :, 0], [10.0 + 2.25, 23.0])


@pytest.mark.parametrize("law", ["lin", "log"])
@pytest.mark.parametrize(("start", "length"), [(0.5, 2.0), (7.25, 7.25)])
def test_length_is_projected_onto_its_bound(law: str, start: float, length: float) -> None:
    term = make_law(law, v0=-3.0, L=start, L_min=2.0)
    term.project_()
    assert (term.L.item(), term.v0.item()) == (length, -3.0)


def test_box_bounds_only_the_weights() -> None:
    term = make_law(
        "network_speed", hidden=4, v0=30.0, box=0.25, generator=torch.Generator().manual_seed(0)
    )
    before = {name: p.detach().clone() for name, p in term.named_parameters()}
    term.project_()
    for name, p in term.named_parameters():
        expected = before[name] if name == "v0" else before[name].clip(-0.25, 0.25)
        assert torch.equal(p, expected)
    assert max(p.abs().max() for n, p in term.named_parameters() if n != "v0") == 0.25


def test_unknown_leader() -> None:
    with pytest.raises(ValueError, match="leader=first"):
        Traffic([make_law("lin")], leader="first")
