"""Effects on speeds of vehicles against closed forms."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch
from torch.func import functional_call, vmap

from nnode.data.sequence import Batch, collate
from nnode.errors import ConfigError
from nnode.model import System, build_model
from nnode.model.effects import CATALOGUE
from nnode.model.extend import extended, without
from nnode.simulation import TorchdiffeqSolver
from tests.builders import lane
from tests.model.following import rates

NAMES = [effect.name for effect in CATALOGUE.of("traffic")]
V0, LENGTH = 30.0, 6.0


def batch(vehicles: int = 4, padding: int = 0) -> Batch:
    """A platoon with gaps 20, 30, 40 ... m, kinds and lengths, and a leader at 12 m/s."""
    x = np.cumsum([0.0, *(20.0 + 10 * i for i in range(vehicles - 1))])
    way = 12 * 0.2 * np.arange(11)[:, None]
    kind = tuple("truck" if i == 1 else "car" for i in range(vehicles))
    length = np.where(np.arange(vehicles) == 1, 10.0, 4.0)
    items = [lane(x + way, start=50.0, kind=kind, length=length)]
    if padding:
        items.append(lane(np.arange(vehicles + padding) * 25.0 + way, name="r/1"))
    return collate(items)


def model(*effects: dict[str, Any], leader: str = "measured") -> System:
    options = {"leader": leader, "v0": V0, "L": LENGTH, "L_min": 1.0}
    return build_model({"term": "lin", "name": "lin", **options, "effects": list(effects)})


def speeds(system: System, data: Batch) -> np.ndarray:
    """Speeds of the followers of the first sequence."""
    followers = int(data.agent[0].sum()) - 1
    return rates(system, data)[0, :followers, 0].numpy()


def law(gap: float) -> float:
    return V0 * (1 - LENGTH / gap)


W = np.array([law(20), law(30), law(40)])
LAST = W[2] + 0.1 * (12 - W[2])
SECOND = W[1] + (0.6 if W[1] < LAST else 0.1) * (LAST - W[1])
TIME_GAPS = [12.0]
for _gap in (40, 30, 20):
    TIME_GAPS.insert(0, V0 * (1 - (LENGTH + 0.2 * TIME_GAPS[0]) / _gap))
del TIME_GAPS[3]


@pytest.mark.parametrize(
    ("effect", "expected"),
    [
        ({"name": "speed_zone", "alpha": 0.5, "a": 10.0, "b": 35.0}, W * [1, 0.5, 1]),
        ({"name": "speed_period", "alpha": 0.5, "a": 0.0, "b": 60.0}, W * 0.5),
        ({"name": "speed_period", "alpha": 0.5, "a": 60.0, "b": 90.0}, W),
        ({"name": "vehicle_class", "kind": "truck", "phi": 0.8}, W * [1, 0.8, 1]),
        ({"name": "vehicle_class", "kind": "bus", "phi": 0.8}, W),
        ({"name": "free_flow_speed", "v_max": 22.0}, np.minimum(W, 22.0)),
        ({"name": "multi_anticipation", "c": 0.3}, [*(W[:2] + 0.3 * np.diff(W)), W[2]]),
        (
            {"name": "driver_heterogeneity", "people": {"r/0": [0.1, 0.0, -0.1, 0.0]}},
            W * [1.1, 1, 0.9],
        ),
        # the leader drives at 12 m/s
        (
            {"name": "relative_speed", "kappa": 0.5},
            [
                (W[0] + (W[1] + (W[2] + 12) / 2) / 2) / 2,
                (W[1] + (W[2] + 12) / 2) / 2,
                (W[2] + 12) / 2,
            ],
        ),
        (
            {"name": "leader_length", "beta": 1.0},
            [law(20 - 4.5), law(30 + 1.5), law(40 + 1.5)],
        ),
        # the third vehicle approaches the leader, the second vehicle the third
        (
            {"name": "asymmetric_response", "kappa_open": 0.6, "kappa_close": 0.1},
            [W[0] + 0.6 * (SECOND - W[0]), SECOND, LAST],
        ),
        # L + h v, with v of the vehicle ahead, replaces L
        ({"name": "time_gap", "h": 0.2}, TIME_GAPS),
    ],
)
def test_speeds_by_formula(effect: dict[str, Any], expected: Any) -> None:
    assert speeds(model(effect), batch()) == pytest.approx(np.array(expected), rel=1e-9)


def test_reaction_delay_of_a_growing_gap() -> None:
    """The state of the delayed gap, for measured paths and a leader that is 2 m/s faster."""
    time = 0.05 * np.arange(161)
    data = collate([lane(np.stack([10.0 * time, 40 + 12.0 * time], 1), 0.05)])
    system = model({"name": "reaction_delay", "T": 0.8})
    scene, z = system.scene(data), system.initial(data).detach()[..., 1:]
    h = 0.005
    for i in range(1400):
        t = torch.tensor(i * h).double()
        y = torch.cat([scene.measured_at(t), z], -1)
        z = z + h * system(t, y, scene).detach()[..., 1:]
    assert float(z[0, 0, 1]) == pytest.approx(2.0 * 0.8, abs=0.02)


def test_inertia() -> None:
    system = model({"name": "inertia", "tau_v": 0.5})
    y = system.initial(batch())
    y[..., 1] = 0.0  # at rest
    rate = rates(system, batch(), y=y)
    assert rate[0, :3, 0].tolist() == [0.0, 0.0, 0.0]
    assert rate[0, :3, 1].numpy() == pytest.approx(W / 0.5)


@pytest.mark.parametrize("name", NAMES)
def test_padding_changes_nothing(name: str) -> None:
    system, padded = model({"name": name}), batch(padding=3)
    if name != "leader_length":  # depends on the mean length in the batch
        assert speeds(system, padded) == pytest.approx(speeds(system, batch()))
    assert torch.isfinite(rates(system, padded, 0.3)).all()


@pytest.mark.parametrize("name", NAMES)
def test_vmap_and_gradients(name: str) -> None:
    system, data = model({"name": name}), batch()
    rows = {n: torch.stack([p, p * 1.01]).detach() for n, p in system.named_parameters()}
    y, scene, t = system.initial(data).detach(), system.scene(data), torch.tensor(0.1).double()

    def run(parameters: dict[str, Any]) -> torch.Tensor:
        return functional_call(system, parameters, (t, y, scene))

    for i, rate in enumerate(vmap(run)(rows)):
        assert torch.allclose(rate, run({n: p[i] for n, p in rows.items()}), rtol=1e-12)
    trained = tuple(p for p in system.parameters() if p.requires_grad)
    x = TorchdiffeqSolver(gradient="discrete", dt=0.05)(system, data).x
    gradient = torch.autograd.grad(x[-1, 0, :3].sum(), trained, allow_unused=True)
    assert all(g is None or torch.isfinite(g).all() for g in gradient)


def test_leader_speed() -> None:
    system = model({"name": "leader_speed", "weight": 0.25}, leader="constant")
    assert float(rates(system, batch())[0, 3, 0]) == pytest.approx(0.75 * V0 + 0.25 * 12)


def test_effects_are_ordered_by_rank() -> None:
    system = model({"name": "inertia"}, {"name": "speed_zone"})
    assert [t.name for t in system.terms] == ["lin", "speed_zone", "inertia"]
    larger, place = extended(system, CATALOGUE.effects["relative_speed"](kappa=0.1))
    assert place == 2
    names = ["lin", "speed_zone", "relative_speed", "inertia"]
    assert [t.name for t in larger.terms] == names
    assert [t.name for t in without(larger, "inertia").terms] == names[:3]
    assert copy.deepcopy(larger).terms[1].options() == system.terms[1].options()


@pytest.mark.parametrize(
    ("effect", "message"),
    [
        ({"name": "relativ_speed"}, "did you mean relative_speed"),
        ({"name": "drift"}, "there is no traffic effect drift"),
        ({"name": "inertia", "tau": 0.5}, "no parameter tau"),
        ({"kappa": 0.3}, "expected a name"),
    ],
)
def test_invalid_effects(effect: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        model(effect)
