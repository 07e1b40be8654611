"""Laws that are one formula, of first and of second order, against plain loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from nnode.data.sequence import collate
from nnode.errors import ConfigError
from nnode.model import build_model
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from nnode.simulation.kernels import lanes
from tests.builders import lane
from tests.model.following import model
from tests.simulation.fused.compare import difference, gradient, single

DT = 0.02
OWN = {
    "term": "formula",
    "name": "mine",
    "leader": "constant",
    "effects": [],
    "law": {"parameters": {"v0": "64.8 km/h", "L": "4 m"}, "rate": {"x": "v0*(1 - L/gap)"}},
}


def idm(v: float, gap: float, dv: float, row: list[float]) -> float:
    """The formula of Treiber, Hennecke & Helbing 2000."""
    v0, T, s0, a, b = row
    wish = s0 + max(v * T + v * dv / (2 * np.sqrt(a * b)), 0.0)
    return float(a * (1 - (v / v0) ** 4 - (wish / gap) ** 2))


def loop(batch: Any, b: int, row: list[float], per: int, ballistic: bool) -> np.ndarray:
    """Places of a platoon behind its measured leader, one vehicle and step after the other."""
    n, k = int(batch.agent[b].sum()), int(batch.valid[:, b].any(-1).sum())
    place, speed = (values[:k, b, :n, 0].numpy() for values in (batch.x, batch.v))
    x, v, h = place[0].copy(), speed[0].copy(), batch.dt / per
    states = [x.copy()]
    for step in range(per * (k - 1)):
        x[-1], v[-1] = (np.interp(step / per, np.arange(k), path[:, -1]) for path in (place, speed))
        a = [idm(v[j], x[j + 1] - x[j], v[j] - v[j + 1], row) for j in range(n - 1)]
        for j in range(n - 1):
            x[j] += h * (v[j] + (h * a[j] / 2 if ballistic else 0))
            v[j] += h * a[j]
        if (step + 1) % per == 0:
            states.append(np.append(x[:-1], place[(step + 1) // per, -1]))
    return np.array(states)


@pytest.mark.parametrize("method", ["euler", "ballistic"])
def test_the_intelligent_driver_is_what_its_formula_says(method: str, ragged: Any) -> None:
    batch, system = single(ragged), model("idm")
    row = [float(p.detach()) for _, p in system.named_parameters()]
    assert list(system.physical()) == [f"idm.{name}" for name in ("v0", "T", "s0", "a", "b")]
    formula = lanes.supports(system, batch)
    assert formula is not None
    y = lanes.simulate(system, formula, batch, 10, method=method)[:, 0]
    x, v = system.observe(y, batch)
    assert v is not None
    for b in range(len(batch.names)):
        wanted = loop(batch, b, row, 10, method == "ballistic")
        simulated = x[: len(wanted), b, : wanted.shape[1], 0].detach().numpy()
        np.testing.assert_allclose(simulated, wanted, rtol=1e-12)


def test_a_platoon_keeps_the_gap_of_equilibrium() -> None:
    """At speed v the gap is (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    system = model("idm")
    v, (v0, T, s0) = 15.0, (30.0, 1.2, 2.0)
    gap = (s0 + v * T) / np.sqrt(1 - (v / v0) ** 4)
    assert idm(v, gap, 0.0, [v0, T, s0, 1.3, 1.7]) == pytest.approx(0, abs=1e-14)
    x = np.array([0.0, gap, 2 * gap]) + v * 0.1 * np.arange(50)[:, None]
    batch = collate([lane(x, 0.1)])
    with torch.no_grad():
        simulated_x = FusedSolver(0.01)(system, batch).x
    np.testing.assert_allclose(simulated_x.numpy(), batch.x.numpy(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("effects", [[], [{"name": "relative_speed", "kappa": 0.3}]])
def test_one_line_is_the_law_that_the_package_has(effects: list[Any], ragged: Any) -> None:
    batch, own = single(ragged), build_model({**OWN, "effects": effects})
    lin = {"name": "lin", "term": "lin", "leader": "constant", "v0": 18.0, "L": 4.0, "L_min": 2}
    path, slope = gradient(own, FusedSolver(DT), batch)
    solver = TorchdiffeqSolver("euler", "discrete", DT)
    exact, wanted = gradient(build_model({**lin, "effects": effects}), solver, batch)
    torch.testing.assert_close(path.x, exact.x, rtol=1e-13, atol=1e-9)
    assert difference(slope, wanted) < 1e-10


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"rate": {"x": "v0*gap"}}, r"mine = mine\.v0\*gap has the unit m²/s, expected m/s"),
        ({"rate": {"y": "v0"}}, "must have two entries"),
        ({"rate": "v0"}, "must be one entry"),
        ({"rate": {"x": "v0*(1 - M/gap)"}}, "M is unknown; there are L, "),
        ({"rate": {"x": "__import__('os').system('true')"}}, "not allowed"),
        ({"parameters": {"v0": "fast"}}, "no quantity"),
        ({"parameters": {"v0": {"low": "1 m/s"}}}, "expected a quantity"),
        ({"parameters": {"v0": {"value": "1 m/s", "low": "2 s"}}}, "one kind of unit"),
        (
            {"parameters": {"v0": {"value": "-1 m/s", "low": "2 m/s", "high": "9 m/s"}}},
            "a start value of v0 must be at least 2 m/s and at most 9 m/s",
        ),
        ({"parameters": {"a b": "1"}}, "cannot be a name"),
        ({"colour": "red"}, "unknown entries colour"),
    ],
)
def test_what_is_wrong_with_a_law_is_said(change: dict[str, Any], problem: str) -> None:
    law = {**OWN["law"], **change}  # type: ignore[dict-item]
    with pytest.raises(ConfigError, match=problem):
        build_model({**OWN, "law": law})
    with pytest.raises(ConfigError, match="needs parameters and rate"):
        build_model({**OWN, "law": None})
    without = {"parameters": {"L": "4 m", "w": "18 m/s"}, "rate": {"x": "w*(1 - L/gap)"}}
    with pytest.raises(ConfigError, match="parameter v0"):
        build_model({**OWN, "law": without})
