"""What methods of stepping make of an acceleration: closed forms, and orders of accuracy."""

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
from tests.model.following import DT, behind, idm, model, numbers

#: A car that brakes with b m/s², whatever is ahead, and one that accelerates.
BRAKE = {"parameters": {"b": "3 m/s²"}, "rate": {"v": "0*dv*b/gap - b"}}
SPEEDS = np.array([7.03, 0.2, 0.3, 0.0, 12.0, 1e-9])


def alone(system: Traffic, speeds: Any, seconds: float, method: str | None) -> tuple[Any, Any]:
    """Places and speeds ``(K, B)`` of one car a platoon, each far behind its leader."""
    time = DT * np.arange(round(seconds / DT) + 1)[:, None]
    places = [np.array([0.0, 500.0]) + time * [v, 0.0] for v in speeds]
    batch = collate(
        [
            lane(x, DT, v=[v, 0.0], name=f"p{i}")
            for i, (x, v) in enumerate(zip(places, speeds, strict=True))
        ]
    )
    with torch.no_grad():
        found = TorchdiffeqSolver(method, "discrete", DT)(system, batch)
    assert found.v is not None
    return found.x[:, :, 0, 0].numpy(), found.v[:, :, 0, 0].numpy()


def test_steps_of_even_motion_are_those_of_the_textbook() -> None:
    """x_k after k steps of h with acceleration c: v k h + c h² (k² - k)/2, (k² + k)/2 or k²/2."""
    push, v0 = model({"parameters": {"c": "0.7 m/s²"}, "rate": {"v": "c"}}), 5.0
    k, c = np.arange(31), 0.7
    sums = {"euler": k * k - k, "semi_implicit": k * k + k, "ballistic": k * k, "rk4": k * k}
    for method in METHODS:
        x, v = alone(push, [v0], 3.0, method)
        wanted = v0 * k * DT + c * DT**2 * sums[method] / 2
        np.testing.assert_allclose(x[:, 0], wanted, rtol=1e-13, atol=1e-13)
        np.testing.assert_allclose(v[:, 0], v0 + c * k * DT, rtol=1e-13)


@pytest.mark.parametrize("method", METHODS)
def test_a_car_that_brakes_stops_and_stays(method: str) -> None:
    x, v = alone(model(BRAKE), SPEEDS, 5.0, method)
    assert v.min() > -1e-15  # v - h (v/h) is 0 up to rounding
    assert np.diff(x, axis=0).min() > -1e-15
    if method == "rk4":
        # stages see rates of at least -v/h: what is left of a speed is 1 - 1 + 1/2 - 1/6 + 1/24
        fast = SPEEDS > 1
        np.testing.assert_allclose(v[-9:, fast] / v[-10:-1, fast], 0.375, rtol=1e-6)
    else:
        assert v[-1].max() < 1e-15


def test_the_ballistic_way_to_a_stop_is_exact() -> None:
    """v²/(2 b), whatever part of the last step it takes (Treiber & Kanagaraj 2015, section 3)."""
    x, _ = alone(model(BRAKE), SPEEDS, 5.0, None)
    np.testing.assert_allclose(x[-1] - x[0], SPEEDS**2 / 6, rtol=1e-12, atol=1e-14)
    for method, sign in (("euler", 1), ("semi_implicit", -1)):
        off = sign * (alone(model(BRAKE), SPEEDS, 5.0, method)[0][-1] - SPEEDS**2 / 6)
        assert off.min() > -1e-12
        assert (off <= SPEEDS * DT + 1e-12).all()


@pytest.mark.parametrize("method", METHODS)
def test_an_acceleration_that_is_no_number_shows(method: str) -> None:
    """The larger of it and of what would stop the car is no number either."""
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
def test_no_speed_is_ever_negative() -> None:
    """Cars that stand, touch, and drive into each other, and a leader who stops."""
    draw = np.random.default_rng(4)
    for law, method in itertools.product(("idm", "fvdm", "krauss", "helly"), METHODS):
        if (law, method) == ("krauss", "rk4"):
            continue
        place = behind(lambda t: 6 * np.minimum(t, 3), draw.uniform(3.0, 12.0, 4), 8.0)
        place.v[0, :, :-1] = torch.from_numpy(draw.uniform(0, 15, (1, 4, 1)))
        with torch.no_grad():
            found = TorchdiffeqSolver(method, "discrete", DT)(model(law), place)
        assert found.v is not None
        assert found.v.min() > -1e-13, (law, method)
        assert torch.diff(found.x[:, 0, :-1, 0], dim=0).min() > -1e-13, (law, method)


@pytest.mark.thorough
def test_orders_of_accuracy_against_dop853() -> None:
    """Errors of places fall with the step h: Runge and Kutta's as h⁴, the others' as h."""
    system, seconds = model("idm", leader="constant"), 4.0
    p, start, speed = numbers(system), np.array([0.0, 27.0, 55.0]), np.array([15.0, 13.0, 14.0])

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
        with torch.no_grad():
            found = TorchdiffeqSolver(method, "discrete", step)(system, batch).x[-1, 0, :2, 0]
        errors[method].append(float(np.abs(found.numpy() - exact.y[:2, -1]).max()))
    slopes = {m: np.polyfit(np.log(steps), np.log(e), 1)[0] for m, e in errors.items()}
    for method, order in {"euler": 1, "semi_implicit": 1, "ballistic": 1, "rk4": 4}.items():
        assert slopes[method] == pytest.approx(order, abs=0.3), (slopes, errors)


def test_speeds_are_stepped_as_they_are() -> None:
    formula = Traffic([make_law("lin")]).formula
    assert formula is not None
    assert all(stepped(formula, method) is formula for method in METHODS)
    assert set(STAGES) == set(METHODS)


def test_a_method_is_the_law_s_own_the_field_s_or_the_one_that_is_asked_for() -> None:
    assert Traffic([make_law("lin")]).step == "euler"
    assert {law: model(law).step for law in CAR_FOLLOWING_LAWS} == {
        **dict.fromkeys(CAR_FOLLOWING_LAWS, "rk4"),
        "gipps": "ballistic",
        "krauss": "semi_implicit",
        "newell": "semi_implicit",
    }
    # what remembers step by step has no stages in between
    assert model("idm", {"name": "pure_delay", "T": 0.3}).step == "ballistic"
    assert model("idm", {"name": "reaction_delay", "T": 0.3}).step == "rk4"
    assert model(BRAKE).step == "ballistic"
    own = alone(model({**BRAKE, "step": "euler"}), [5.0], 1.0, None)
    np.testing.assert_array_equal(own[0], alone(model(BRAKE), [5.0], 1.0, "euler")[0])
    assert np.abs(own[0] - alone(model(BRAKE), [5.0], 1.0, None)[0]).max() > 0.1


def test_a_description_without_a_step_keeps_ballistic_steps() -> None:
    """Those of checkpoints from before smooth laws had Runge and Kutta's."""
    before = {key: entry for key, entry in CAR_FOLLOWING_LAWS["idm"].items() if key != "step"}
    batch = behind(lambda t: 12 * t + np.sin(t), [25.0, 28.0], 3.0)
    assert model(before).step == "ballistic"
    with torch.no_grad():
        found = TorchdiffeqSolver(dt=DT)(model(before), batch).x
        exact = TorchdiffeqSolver("ballistic", dt=DT)(model("idm"), batch).x
        now = TorchdiffeqSolver(dt=DT)(model("idm"), batch).x
    assert torch.equal(found, exact)
    assert (found - now).abs().max() > 1e-3


@pytest.mark.thorough
def test_the_default_follows_the_solution_for_half_a_minute() -> None:
    """Places of IDM behind a leader who swings, against DOP853 from sample to sample: the default
    to 5e-5 m in steps of 0.1 s, where ballistic ones are off by decimetres."""
    system, n = model("idm"), 5
    batch = behind(lambda t: 15 * t + 8 * np.sin(0.4 * t), [26.0, 31.0, 22.0, 29.0], 30.0)
    p, lead = numbers(system), batch.x[:, 0, -1, 0].numpy()
    fast, y = batch.v[:, 0, -1, 0].numpy(), torch.cat([batch.x[0, 0, :-1], batch.v[0, 0, :-1]])
    known, found = y[:, 0].numpy(), []
    for k in range(batch.n_samples - 1):

        def rates(t: float, y: np.ndarray, k: int = k) -> np.ndarray:
            part = np.array([1 - t / DT, t / DT])
            x, v = np.append(y[: n - 1], part @ lead[k : k + 2]), y[n - 1 :]
            ahead = np.append(v[1:], part @ fast[k : k + 2])
            return np.append(v, idm(np.diff(x) - 4.0, v, ahead, p))

        known = solve_ivp(rates, (0, DT), known, "DOP853", rtol=1e-9, atol=1e-9).y[:, -1]
        found.append(known[: n - 1])
    away = {}
    for method in (None, "ballistic"):
        with torch.no_grad():
            x = TorchdiffeqSolver(method, dt=DT)(system, batch).x[1:, 0, :-1, 0].numpy()
        away[method] = float(np.abs(x - np.array(found)).max())
    assert away[None] < 5e-5
    assert away["ballistic"] > 0.1


@pytest.mark.parametrize("law", ["krauss", "newell"])
def test_maps_from_step_to_step_have_no_stages(law: str) -> None:
    system = model(law)
    assert system.formula is not None
    with pytest.raises(ConfigError, match=r"names dt.*rk4 has stages"):
        stepped(system.formula, "rk4")
    batch = behind(lambda t: 10 * t, [20.0], 0.5)
    for solver in (TorchdiffeqSolver("rk4", "discrete", DT), FusedSolver(DT, method="rk4")):
        with pytest.raises(ConfigError, match="names dt"):
            solver(system, batch)


def test_unknown_methods_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"model\.law\.step=leapfrog is unknown, expected euler"):
        model({**BRAKE, "step": "leapfrog"})
    with pytest.raises(ConfigError, match=r"solver\.method=leapfrog.*ballistic"):
        FusedSolver(method="leapfrog")
    with pytest.raises(ConfigError, match=r"solver\.method=leapfrog.*ballistic"):
        TorchdiffeqSolver("leapfrog")
