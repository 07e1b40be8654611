"""Effects on accelerations against written-out formulas, and errors of laws and effects."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from nnode.data.sequence import Batch, collate
from nnode.errors import ConfigError
from nnode.model import build_model
from nnode.model.effects import CATALOGUE
from tests.builders import lane
from tests.model import following
from tests.model.following import (
    DT,
    accelerations,
    model,
    parameters_of,
    platoon_behind,
    simulate,
)

CAR, TRUCK = 4.0, 10.0  # lengths, m
GAPS, SPEEDS = [20.0, 31.0, 27.0], [14.0, 11.0, 13.0, 12.0]
SECOND = [e.name for e in CATALOGUE.of("traffic", every=True) if 2 in e.rules]
LIN = {"term": "lin", "name": "lin", "leader": "measured", "v0": 30.0, "L": 6.0, "L_min": 1.0}


def platoon() -> Batch:
    """Four vehicles, of which the second from behind is a truck; time starts at 50 s."""
    x = np.cumsum([0.0, *GAPS]) + np.array(SPEEDS) * DT * np.arange(3)[:, None]
    length = np.where(np.arange(4) == 1, TRUCK, CAR)
    kind = tuple("truck" if i == 1 else "car" for i in range(4))
    return collate([lane(x, DT, v=SPEEDS, start=50.0, length=length, kind=kind)])


def idm(i: int, *, gap: float | None = None, dv: float | None = None, **changed: float) -> float:
    """Acceleration of vehicle i with another gap, speed difference or parameter."""
    net = (GAPS[i] if gap is None else gap) - (TRUCK if i == 0 else CAR)
    ahead = SPEEDS[i + 1] if dv is None else SPEEDS[i] - dv
    return float(following.idm(net, SPEEDS[i], ahead, SimpleNamespace(**{**vars(P), **changed})))


P = parameters_of(model("idm"))
BARE = [idm(i) for i in range(3)]
DV = -np.diff(SPEEDS)


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        # positions are 0, 20 and 51 m; the edges of a zone are 2 m wide
        (
            {"name": "speed_zone", "alpha": 0.6, "a": 10.0, "b": 35.0},
            [BARE[0], idm(1, v0=0.6 * P.v0), BARE[2]],
        ),
        (
            {"name": "speed_zone", "alpha": 0.6, "a": 20.0, "b": 90.0},  # begins at the vehicle
            [BARE[0], idm(1, v0=P.v0 / ((1 + 1 / 0.6) / 2)), idm(2, v0=0.6 * P.v0)],
        ),
        (
            {"name": "slope", "grade": 0.04, "a": 10.0, "b": 35.0},
            [BARE[0], BARE[1] - 9.81 * 0.04, BARE[2]],
        ),
        (
            {"name": "speed_period", "alpha": 0.7, "a": 40.0, "b": 60.0},
            [idm(i, v0=0.7 * P.v0) for i in range(3)],
        ),
        ({"name": "speed_period", "alpha": 0.7, "a": 60.0, "b": 90.0}, BARE),
        (
            {"name": "vehicle_class", "kind": "truck", "phi": 1.4},
            [BARE[0], idm(1, T=1.4 * P.T), BARE[2]],
        ),
        (
            {"name": "driver_heterogeneity", "people": {"r/0": [0.1, 0.0, -0.2, 0.0]}},
            [idm(0, T=1.1 * P.T), BARE[1], idm(2, T=0.8 * P.T)],
        ),
        # the truck is 4.5 m longer than the mean of all vehicles, the cars are 1.5 m shorter
        (
            {"name": "leader_length", "beta": 0.5},
            [idm(0, gap=20 - 2.25), idm(1, gap=31 + 0.75), idm(2, gap=27 + 0.75)],
        ),
        (
            {"name": "multi_anticipation", "c": 0.3},
            [
                BARE[0] + 0.3 * (idm(0, gap=51 / 2, dv=14 - 13.0) - BARE[0]),
                BARE[1] + 0.3 * (idm(1, gap=58 / 2, dv=11 - 12.0) - BARE[1]),
                BARE[2],
            ],
        ),
        ({"name": "relative_speed", "kappa": 0.4}, np.array(BARE) - 0.4 * DV),
        (
            {"name": "asymmetric_response", "kappa_open": 0.3, "kappa_close": 0.8},
            np.array(BARE) - np.where(DV < 0, 0.3, 0.8) * DV,
        ),
    ],
    ids=lambda value: value["name"] if isinstance(value, dict) else "",
)
def test_accelerations_by_formula(effect: dict[str, Any], expected: Any) -> None:
    system = model("idm", effect)
    assert system.formula is not None
    np.testing.assert_allclose(accelerations(system, platoon())[0, :3], expected, rtol=1e-12)


@pytest.mark.parametrize("name", SECOND)
def test_neutral_strengths_change_nothing(name: str) -> None:
    effect = CATALOGUE.effects[name]
    neutral = {k: s.at(0) for k, s in effect.strengths.items() if s.at(0) == s.neutral}
    system = model("idm", {"name": name, **neutral})
    # memory starts with the driver's measured time gap
    expected = [idm(i, T=time_gap(i)) for i in range(3)] if name == "memory" else BARE
    np.testing.assert_allclose(accelerations(system, platoon())[0, :3], expected, rtol=1e-12)


def time_gap(i: int) -> float:
    """The measured time gap of a driver in the first state."""
    net = GAPS[i] - (TRUCK if i == 0 else CAR)
    return float(np.clip((net - P.s0) / max(SPEEDS[i], 2.0), 0.1, 5.0))


def wave() -> tuple[Batch, np.ndarray]:
    """Two vehicles behind an oscillating leader over 6 s, and their time gaps at the start."""
    batch = platoon_behind(
        lambda t: 14 * t + 5 * (1 - np.cos(0.8 * t)) * (t > 0), [30.0, 26.0], 6.0
    )
    return batch, (np.array([26.0, 30.0]) - CAR - P.s0) / float(batch.v[0, 0, 0, 0])


@pytest.mark.parametrize("share", [0.4, 1.0, -0.2])
def test_lasting_time_gap_is_constant(share: float) -> None:
    system = model("idm", {"name": "lasting_time_gap", "share": share})
    expected = [idm(i, T=P.T + share * (time_gap(i) - P.T)) for i in range(3)]
    np.testing.assert_allclose(accelerations(system, platoon())[0, :3], expected, rtol=1e-12)
    batch, start = wave()
    x = simulate(system, batch, "ballistic").x[-1, 0, :2, 0]
    without_relaxation = memory_loop(batch, P.T + share * (start - P.T), np.inf, DT)
    np.testing.assert_allclose(x, without_relaxation, rtol=1e-12)


@pytest.mark.parametrize("T", [0.0, 0.04, 0.3, 0.37, 1.5])
def test_pure_delay_by_loop(T: float) -> None:
    """The acceleration of whole steps ago, with linear interpolation between two steps."""
    (batch, _), steps = wave(), 15
    path = simulate(model("idm", {"name": "pure_delay", "T": T}), batch, "ballistic")
    x, v = batch.x[:, 0, :, 0].numpy().copy(), batch.v[:, 0, :, 0].numpy().copy()
    past: list[np.ndarray] = []
    for k in range(len(x) - 1):
        now = following.idm(np.diff(x[k]) - CAR, v[k, :2], v[k, 1:], P)
        past = [now] * (steps + 1) if k == 0 else [now, *past[:steps]]
        whole = min(int(T / DT + 1e-9), steps - 1)
        part = T / DT - whole
        a = (1 - part) * past[whole] + part * past[whole + 1]
        x[k + 1, :2] = x[k, :2] + DT * v[k, :2] + DT**2 / 2 * a
        v[k + 1, :2] = v[k, :2] + DT * a
    np.testing.assert_allclose(path.x[:, 0, :, 0], x, rtol=1e-12)
    np.testing.assert_allclose(path.v[:, 0, :, 0], v, rtol=1e-12)


@pytest.mark.parametrize("step", [DT, DT / 2])
def test_memory_by_loop(step: float) -> None:
    system, (batch, start) = model("idm", {"name": "memory", "tau_m": 2.5}), wave()
    y = system.initial(batch)
    np.testing.assert_allclose(y[0, :2, 2].detach(), start, rtol=1e-9)
    x = simulate(system, batch, "ballistic", step).x[-1, 0, :2, 0]
    np.testing.assert_allclose(x, memory_loop(batch, start, 2.5, step), rtol=1e-12)


def memory_loop(batch: Batch, start: np.ndarray, tau: float, step: float) -> np.ndarray:
    """Final positions; time gaps q solve dq/dt = (T - q)/tau by Euler's method."""
    substeps = round(batch.dt / step)
    place, speed = batch.x[:, 0, 2, 0].numpy(), batch.v[:, 0, 2, 0].numpy()
    x, v, q = batch.x[0, 0, :2, 0].numpy(), batch.v[0, 0, :2, 0].numpy(), start
    for k in range(substeps * (len(place) - 1)):
        ahead, u = (np.interp(k / substeps, np.arange(len(place)), z) for z in (place, speed))
        now = SimpleNamespace(**{**vars(P), "T": q})
        a = following.idm(np.diff([*x, ahead]) - CAR, v, np.array([*v[1:], u]), now)
        x, v, q = x + step * v + step**2 / 2 * a, v + step * a, q + step * (P.T - q) / tau
    return x


def test_inertia_relaxes_to_the_acceleration() -> None:
    """tau du/dt = a - u for an acceleration that jumps."""
    push = {
        "parameters": {"c": "1.5 m/s²"},
        "rate": {"v": "c*choose(clip(t/dt - 10.5, 0, 1), 1, 0)"},
    }
    system = model(push, {"name": "inertia", "tau_v": 0.5})
    v = simulate(system, platoon_behind(lambda t: 10 * t, [60.0], 3.0), "ballistic").v
    a = np.diff(v[:, 0, 0, 0]) / DT
    k = np.maximum(np.arange(30) - 11, 0)
    np.testing.assert_allclose(a, 1.5 * (1 - (1 - DT / 0.5) ** k), atol=1e-12)


def test_effects_with_memory_on_discrete_laws() -> None:
    """The first step is that of the law alone, at the solver's step."""
    half = DT / 2
    batch = platoon_behind(lambda t: 14 * t, [14.0, 13.0], 0.5, CAR, half)
    bare, undelayed, *delayed = (
        simulate(model("krauss", *effects), batch, "ballistic", half)
        for effects in (
            [],
            [{"name": "pure_delay", "T": 0.0}],
            [{"name": "pure_delay", "T": 0.2}],
            [{"name": "inertia", "tau_v": 0.4}],
        )
    )
    assert (bare.v[1, 0, :2] - 14).max() < -1
    torch.testing.assert_close(undelayed.x, bare.x, rtol=1e-13, atol=1e-12)
    for late in delayed:
        torch.testing.assert_close(late.v[1], bare.v[1], rtol=1e-13, atol=0)
        assert (late.v[2] - bare.v[2]).abs().max() > 0.01


def test_free_speed_in_a_zone() -> None:
    """A free car drives at alpha v0 in the zone and accelerates again behind it."""
    zone = {"name": "speed_zone", "alpha": 0.5, "a": 100.0, "b": 700.0}
    batch = platoon_behind(lambda t: 3000 + 33 * t, [3000.0], 80.0)
    path = simulate(model("idm", zone), batch, "ballistic")
    x, v = path.x[:, 0, 0, 0], path.v[:, 0, 0, 0]
    inside = (x > 500) & (x < 690)
    assert inside.sum() > 50
    np.testing.assert_allclose(v[inside], 15.0, rtol=0.02)
    assert v[-1] > 20


@pytest.mark.parametrize(
    "name", sorted({e.name for e in CATALOGUE.of("traffic", every=True)} - set(SECOND))
)
def test_effects_on_speeds_do_not_apply_to_accelerations(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"{name} changes a speed.*for those there are .*memory"):
        model("idm", {"name": name})


@pytest.mark.parametrize("name", ["memory", "pure_delay"])
def test_effects_on_accelerations_do_not_apply_to_speeds(name: str) -> None:
    with pytest.raises(ConfigError, match=rf"{name} changes an acceleration.*model=idm"):
        build_model({**LIN, "effects": [{"name": name}]})


@pytest.mark.parametrize(
    ("law", "effect", "lacks"),
    [
        ("helly", {"name": "speed_zone", "alpha": 0.5}, "v0"),
        ("ovm", {"name": "vehicle_class", "phi": 0.8}, "T"),
        ("ovm", {"name": "driver_heterogeneity"}, "T"),
        ("fvdm", {"name": "memory"}, "T"),
        ("a4", {"name": "speed_period", "alpha": 0.5}, "v0"),
        ("newell", {"name": "memory"}, "s0"),
    ],
)
def test_effect_on_a_missing_parameter(law: str, effect: dict[str, Any], lacks: str) -> None:
    with pytest.raises(ConfigError, match=rf"{effect['name']} cannot act: .*{lacks}\b"):
        model(law, effect)


PUSH = {"parameters": {"c": "1 m/s²", "T": "1 s"}, "rate": {"v": "c*late/v"}}


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        ({"delayed": {"late": ["v_1", "m", "T"]}}, "late = v_1 has the unit m/s, expected m"),
        ({"delayed": {"late": ["v_1", "m/s", "c"]}}, r"the delay of late .*m/s².*expected s"),
        ({"delayed": {"late": ["v_1", "m/s"]}}, r"must be \[formula, unit, delay\]"),
        ({"delayed": {"late": "v_1"}}, r"model\.law\.delayed\.late=v_1 must be"),
        ({"delayed": {"late": ["v_1", "m/s", "__import__('os')"]}}, "no function __import__"),
        ({"delayed": {"late": ["v_1", "os.system('x')", "T"]}}, "no unit"),
        ({"states": {"late": ["m/s", "v_1/T", "gap"]}}, "late of mine at the start"),
        ({"states": {"late": ["m/s", "v_1", "v"]}}, "dlate/dt of mine .*expected m/s/s"),
        ({"states": {"late": ["m/s", "v_1/T"]}}, r"must be \[unit, rate, start\]"),
        ({"states": {"late": ["m/s", "(lambda: v)()", "v"]}}, "not allowed"),
        ({"constants": {"late": "fast"}}, "no quantity"),
        ({"constants": {"late": "3 m"}}, r"expected m/s\^2"),
        ({"parameters": {"late": "3 m/s"}}, "c is unknown"),
    ],
)
def test_invalid_delays_states_and_constants(change: dict[str, Any], problem: str) -> None:
    law = {**PUSH, "remembered": 3 if "delayed" in change else 0, **change}
    with pytest.raises(ConfigError, match=problem):
        model(law)


def test_network_size() -> None:
    law = {"parameters": {"c": "1 m/s²"}, "rate": {"v": "c*NN(gap/20)"}}
    with pytest.raises(ConfigError, match=r"calls NN, a network: .*model\.network=4"):
        model(law)
    assert model(law, network=3).terms[0].network.sizes == (1, 3, 1)
    twice = {**law, "rate": {"v": "c*NN(gap/20) - c*NN(v/10, dv/2)"}}
    with pytest.raises(ConfigError, match=r"NN is called with \[1, 2\] inputs"):
        model(twice, network=3)
