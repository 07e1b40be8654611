"""Integration methods of accelerations: closed forms and orders of accuracy."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
import torch
from scipy.integrate import solve_ivp

from nnode.data.sequence import collate
from nnode.errors import ConfigError, SimulationError
from nnode.model import Traffic, make_law
from nnode.model.laws import CAR_FOLLOWING_LAWS
from nnode.model.steps import METHODS, STAGES, stepped
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from tests.builders import lane
from tests.model.following import DT, idm, model, parameters_of, platoon_behind, simulate

#: A car that brakes with b m/s², whatever is ahead.
BRAKE = {"parameters": {"b": "3 m/s²"}, "rate": {"v": "0*dv*b/gap - b"}}
SPEEDS = np.array([7.03, 0.2, 0.3, 0.0, 12.0, 1e-9])


def alone(system: Traffic, speeds: Any, seconds: float, method: str | None) -> tuple[Any, Any]:
    """Positions and speeds ``(K, B)`` of one car per platoon, each far behind its leader."""
    time = DT * np.arange(round(seconds / DT) + 1)[:, None]
    platoons = [
        lane(np.array([0.0, 500.0]) + time * [v, 0.0], DT, v=[v, 0.0], name=f"p{i}")
        for i, v in enumerate(speeds)
    ]
    path = simulate(system, collate(platoons), method)
    return path.x[:, :, 0, 0].numpy(), path.v[:, :, 0, 0].numpy()


@pytest.mark.parametrize("method", METHODS)
def test_constant_acceleration(method: str) -> None:
    """x_k after k steps of h with acceleration c: v k h + c h² (k² - k)/2, (k² + k)/2 or k²/2."""
    push = model({"parameters": {"c": "0.7 m/s²"}, "rate": {"v": "c"}})
    x, v = alone(push, [5.0], 3.0, method)
    k, c = np.arange(31), 0.7
    steps = k * k + {"euler": -k, "semi_implicit": k, "ballistic": 0, "rk4": 0}[method]
    expected = 5.0 * k * DT + c * DT**2 * steps / 2
    np.testing.assert_allclose(x[:, 0], expected, rtol=1e-13, atol=1e-13)
    np.testing.assert_allclose(v[:, 0], 5.0 + c * k * DT, rtol=1e-13)


@pytest.mark.parametrize("method", METHODS)
def test_braking_car_stops(method: str) -> None:
    x, v = alone(model(BRAKE), SPEEDS, 5.0, method)
    assert v.min() > -1e-15  # v - h (v/h) is 0 up to rounding
    assert np.diff(x, axis=0).min() > -1e-15
    if method == "rk4":
        # rates are at least -v/h: a step multiplies a speed by 1 - 1 + 1/2 - 1/6 + 1/24
        fast = SPEEDS > 1
        np.testing.assert_allclose(v[-9:, fast] / v[-10:-1, fast], 0.375, rtol=1e-6)
    else:
        assert v[-1].max() < 1e-15


def test_braking_distance() -> None:
    """Ballistic steps give v²/(2 b) exactly (Treiber & Kanagaraj 2015, section 3)."""
    x, _ = alone(model(BRAKE), SPEEDS, 5.0, None)
    np.testing.assert_allclose(x[-1] - x[0], SPEEDS**2 / 6, rtol=1e-12, atol=1e-14)
    for method, sign in (("euler", 1), ("semi_implicit", -1)):
        off = sign * (alone(model(BRAKE), SPEEDS, 5.0, method)[0][-1] - SPEEDS**2 / 6)
        assert off.min() > -1e-12
        assert (off <= SPEEDS * DT + 1e-12).all()


@pytest.mark.parametrize("method", METHODS)
def test_nan_acceleration_is_an_error(method: str) -> None:
    """The bound that stops a car does not hide NaN."""
    broken = model({"parameters": {"a": "1 m/s²", "L": "5 m"}, "rate": {"v": "a*sqrt(1 - gap/L)"}})
    time = DT * np.arange(8)
    near = np.stack([8 * time, 4 + 8 * time], 1)
    far = np.stack([8 * time, 4 + 16 * time], 1)
    fine, bad = (collate([lane(x, DT, v=8.0)]) for x in (near, far))
    for solver in (TorchdiffeqSolver(method, "discrete", DT), FusedSolver(DT, method=method)):
        assert solver(broken, fine).x.isfinite().all()
        with pytest.raises(SimulationError, match="is not a finite number"):
            solver(broken, bad)


@pytest.mark.thorough
def test_speeds_are_not_negative() -> None:
    """Cars that stand, touch and collide, and a leader that stops."""
    draw = np.random.default_rng(4)
    for law, method in itertools.product(("idm", "fvdm", "krauss", "helly"), METHODS):
        if (law, method) == ("krauss", "rk4"):
            continue
        batch = platoon_behind(lambda t: 6 * np.minimum(t, 3), draw.uniform(3.0, 12.0, 4), 8.0)
        batch.v[0, :, :-1] = torch.from_numpy(draw.uniform(0, 15, (1, 4, 1)))
        path = simulate(model(law), batch, method)
        assert path.v.min() > -1e-13, (law, method)
        assert torch.diff(path.x[:, 0, :-1, 0], dim=0).min() > -1e-13, (law, method)


@pytest.mark.thorough
def test_order_of_accuracy() -> None:
    """Position errors against DOP853 fall as h⁴ for Runge-Kutta steps, and as h for others."""
    system, seconds = model("idm", leader="constant"), 4.0
    p = parameters_of(system)
    start, speed = np.array([0.0, 27.0, 55.0]), np.array([15.0, 13.0, 14.0])

    def rates(t: float, y: np.ndarray) -> np.ndarray:
        x, v = np.append(y[:2], start[2] + 14 * t), np.append(y[2:], 14.0)
        return np.append(v[:2], idm(np.diff(x), v[:2], v[1:], p))

    exact = solve_ivp(
        rates, (0, seconds), [*start[:2], *speed[:2]], "DOP853", rtol=1e-12, atol=1e-12
    )
    errors: dict[str, list[float]] = {method: [] for method in METHODS}
    steps = [0.1, 0.05, 0.025]
    for step, method in itertools.product(steps, METHODS):
        time = step * np.arange(round(seconds / step) + 1)
        batch = collate([lane(start + speed * time[:, None], step, v=speed)])
        x = simulate(system, batch, method, step).x[-1, 0, :2, 0].numpy()
        errors[method].append(float(np.abs(x - exact.y[:2, -1]).max()))
    slopes = {m: np.polyfit(np.log(steps), np.log(e), 1)[0] for m, e in errors.items()}
    for method, order in {"euler": 1, "semi_implicit": 1, "ballistic": 1, "rk4": 4}.items():
        assert slopes[method] == pytest.approx(order, abs=0.3), (slopes, errors)


def test_laws_of_first_order_are_not_changed() -> None:
    formula = Traffic([make_law("lin")]).formula
    assert formula is not None
    assert all(stepped(formula, method) is formula for method in METHODS)
    assert set(STAGES) == set(METHODS)


def test_default_method() -> None:
    assert Traffic([make_law("lin")]).step == "euler"
    assert {law: model(law).step for law in CAR_FOLLOWING_LAWS} == {
        **dict.fromkeys(CAR_FOLLOWING_LAWS, "rk4"),
        "gipps": "ballistic",
        "krauss": "semi_implicit",
        "newell": "semi_implicit",
    }
    # effects with memory have no Runge-Kutta stages
    assert model("idm", {"name": "pure_delay", "T": 0.3}).step == "ballistic"
    assert model("idm", {"name": "reaction_delay", "T": 0.3}).step == "rk4"
    assert model(BRAKE).step == "ballistic"
    x, euler, ballistic = (
        alone(model(law), [5.0], 1.0, method)[0]
        for law, method in (({**BRAKE, "step": "euler"}, None), (BRAKE, "euler"), (BRAKE, None))
    )
    np.testing.assert_array_equal(x, euler)
    assert np.abs(x - ballistic).max() > 0.1


def test_law_without_a_step_is_ballistic() -> None:
    """Old checkpoints of smooth laws do not name a step; new ones name rk4."""
    without_step = {key: value for key, value in CAR_FOLLOWING_LAWS["idm"].items() if key != "step"}
    batch = platoon_behind(lambda t: 12 * t + np.sin(t), [25.0, 28.0], 3.0)
    assert model(without_step).step == "ballistic"
    x = simulate(model(without_step), batch).x
    assert torch.equal(x, simulate(model("idm"), batch, "ballistic").x)
    assert (x - simulate(model("idm"), batch).x).abs().max() > 1e-3


@pytest.mark.thorough
def test_default_method_for_half_a_minute() -> None:
    """IDM behind an oscillating leader against DOP853: Runge-Kutta steps of 0.1 s are right to
    5e-5 m, ballistic steps to decimetres."""
    system, n = model("idm"), 5
    batch = platoon_behind(lambda t: 15 * t + 8 * np.sin(0.4 * t), [26.0, 31.0, 22.0, 29.0], 30.0)
    p = parameters_of(system)
    lead, lead_speed = batch.x[:, 0, -1, 0].numpy(), batch.v[:, 0, -1, 0].numpy()
    state = torch.cat([batch.x[0, 0, :-1], batch.v[0, 0, :-1]])[:, 0].numpy()
    exact = []
    for k in range(batch.n_samples - 1):

        def rates(t: float, y: np.ndarray, k: int = k) -> np.ndarray:
            part = np.array([1 - t / DT, t / DT])
            x, v = np.append(y[: n - 1], part @ lead[k : k + 2]), y[n - 1 :]
            ahead = np.append(v[1:], part @ lead_speed[k : k + 2])
            return np.append(v, idm(np.diff(x) - 4.0, v, ahead, p))

        state = solve_ivp(rates, (0, DT), state, "DOP853", rtol=1e-9, atol=1e-9).y[:, -1]
        exact.append(state[: n - 1])
    default, ballistic = (
        np.abs(simulate(system, batch, method).x[1:, 0, :-1, 0].numpy() - exact).max()
        for method in (None, "ballistic")
    )
    assert default < 5e-5
    assert ballistic > 0.1


@pytest.mark.parametrize("law", ["krauss", "newell"])
def test_discrete_laws_have_no_stages(law: str) -> None:
    system = model(law)
    with pytest.raises(ConfigError, match=r"names dt.*rk4 has stages"):
        stepped(system.formula, "rk4")
    batch = platoon_behind(lambda t: 10 * t, [20.0], 0.5)
    for solver in (TorchdiffeqSolver("rk4", "discrete", DT), FusedSolver(DT, method="rk4")):
        with pytest.raises(ConfigError, match="names dt"):
            solver(system, batch)


def test_unknown_methods() -> None:
    with pytest.raises(ConfigError, match=r"model\.law\.step=leapfrog is unknown, expected euler"):
        model({**BRAKE, "step": "leapfrog"})
    for solver in (FusedSolver, TorchdiffeqSolver):
        with pytest.raises(ConfigError, match=r"solver\.method=leapfrog.*ballistic"):
            solver(method="leapfrog")
