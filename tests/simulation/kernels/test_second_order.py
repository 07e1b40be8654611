"""Laws of first and second order that are one formula, against loops."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from nnode.data.sequence import Batch, Sequence, collate
from nnode.errors import ConfigError
from nnode.model import build_model
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from nnode.simulation.kernels import lanes
from tests.builders import lane
from tests.model.following import idm, model, parameters_of
from tests.simulation.fused.compare import difference, gradient, single

DT = 0.02
OWN = {
    "term": "formula",
    "name": "mine",
    "leader": "constant",
    "effects": [],
    "law": {"parameters": {"v0": "64.8 km/h", "L": "4 m"}, "rate": {"x": "v0*(1 - L/gap)"}},
}


def loop(batch: Batch, b: int, p: Any, substeps: int, ballistic: bool) -> np.ndarray:
    """Positions of platoon b behind its measured leader, by IDM."""
    n, k = int(batch.agent[b].sum()), int(batch.valid[:, b].any(-1).sum())
    place, speed = (values[:k, b, :n, 0].numpy() for values in (batch.x, batch.v))
    x, v, h = place[0].copy(), speed[0].copy(), batch.dt / substeps
    states = [x.copy()]
    for step in range(1, substeps * (k - 1) + 1):
        x[-1], v[-1] = (
            np.interp((step - 1) / substeps, np.arange(k), path[:, -1]) for path in (place, speed)
        )
        a = idm(np.diff(x), v[:-1], v[1:], p)
        x[:-1] += h * (v[:-1] + (h * a / 2 if ballistic else 0))
        v[:-1] += h * a
        if step % substeps == 0:
            states.append(np.append(x[:-1], place[step // substeps, -1]))
    return np.array(states)


@pytest.mark.parametrize("method", ["euler", "ballistic"])
def test_idm_by_loop(method: str, ragged: list[Sequence]) -> None:
    batch, system = single(ragged), model("idm")
    assert list(system.physical()) == [f"idm.{name}" for name in ("v0", "T", "s0", "a", "b")]
    formula = lanes.supports(system, batch)
    y = lanes.simulate(system, formula, batch, 10, method=method)[:, 0]
    x, v = system.observe(y, batch)
    assert v is not None
    for b in range(len(batch.names)):
        expected = loop(batch, b, parameters_of(system), 10, method == "ballistic")
        simulated = x[: len(expected), b, : expected.shape[1], 0].detach().numpy()
        np.testing.assert_allclose(simulated, expected, rtol=1e-12)


def test_equilibrium_gap_is_constant() -> None:
    """At speed v the gap is (s0 + v T) / sqrt(1 - (v / v0)^4)."""
    system = model("idm")
    v, (v0, T, s0) = 15.0, (30.0, 1.2, 2.0)
    gap = (s0 + v * T) / np.sqrt(1 - (v / v0) ** 4)
    x = np.array([0.0, gap, 2 * gap]) + v * 0.1 * np.arange(50)[:, None]
    batch = collate([lane(x, 0.1)])
    with torch.no_grad():
        x = FusedSolver(0.01)(system, batch).x
    np.testing.assert_allclose(x.numpy(), batch.x.numpy(), rtol=0, atol=1e-9)


@pytest.mark.parametrize("effects", [[], [{"name": "relative_speed", "kappa": 0.3}]])
def test_formula_equals_built_in_law(effects: list[Any], ragged: list[Sequence]) -> None:
    batch = single(ragged)
    lin = {"name": "lin", "term": "lin", "leader": "constant", "v0": 18.0, "L": 4.0, "L_min": 2}
    path, slope = gradient(build_model({**OWN, "effects": effects}), FusedSolver(DT), batch)
    solver = TorchdiffeqSolver("euler", "discrete", DT)
    exact, exact_slope = gradient(build_model({**lin, "effects": effects}), solver, batch)
    torch.testing.assert_close(path.x, exact.x, rtol=1e-13, atol=1e-9)
    assert difference(slope, exact_slope) < 1e-10


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
        (
            {"parameters": {"L": "4 m", "w": "18 m/s"}, "rate": {"x": "w*(1 - L/gap)"}},
            "parameter v0",
        ),
    ],
)
def test_invalid_laws(change: dict[str, Any], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        build_model({**OWN, "law": {**OWN["law"], **change}})


def test_formula_without_a_law() -> None:
    with pytest.raises(ConfigError, match="needs parameters and rate"):
        build_model({**OWN, "law": None})
