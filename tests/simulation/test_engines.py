"""Laws, effects, methods and engines: states and gradients against float64 autograd.

Most cases of lanes interpret the generated source, which takes less time than its compilation.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.app.python.inputs import model_options
from nnode.data.sequence import Batch, collate
from nnode.model import System, Traffic, build_model
from nnode.model.effects import CATALOGUE
from nnode.model.laws import CAR_FOLLOWING_LAWS, PEDESTRIAN_LAWS
from nnode.model.steps import METHODS
from nnode.simulation import FusedSolver, TorchdiffeqSolver, Trajectory
from nnode.simulation.kernels import lanes
from tests.builders import lane, straight
from tests.model.effects.test_crowd_effects import VALUES
from tests.model.following import model, set_
from tests.model.test_own_force import LAW
from tests.simulation.fused.compare import RungeKutta

LEADERS = ("constant", "measured")
SUBSTEPS = 2
#: Laws of the paper; networks have random weights.
PAPER: dict[str, dict[str, Any]] = {
    "lin": {"term": "lin", "v0": 21.0, "L": 4.0, "L_min": 2.0},
    "log": {"term": "log", "v0": 21.0, "L": 4.0, "L_min": 2.0},
    **{
        f"n{n}": {"term": "network_speed", "v0": 21.0, "hidden": n, "box": None} for n in (2, 4, 10)
    },
}
#: Users' laws with a state, a delay, a network, or the second vehicle ahead.
OWN: dict[str, dict[str, Any]] = {
    "speed_ahead": {
        "parameters": {"v0": "21 m/s", "L": "4 m", "c": "0.3"},
        "rate": {"x": "(1 - c)*v0*(1 - L/gap) + c*dx_1"},
    },
    "speed_network": {
        "parameters": {"v0": "21 m/s"},
        "rate": {"x": "v0*NN(gap/20)"},
        "network": 3,
    },
    "state": {
        "parameters": {"c": "0.8 1/s", "T": "1.1 s", "tau": "0.7 s"},
        "states": {"late": ["m/s", "(gap/T - late)/tau", "v*T/T"]},
        "rate": {"v": "c*(late - v)"},
    },
    "delay": {
        "parameters": {"c": "0.8 1/s", "T": "1.1 s", "wait": "0.13 s"},
        "delayed": {"late": ["gap", "m", "wait"]},
        "remembered": 4,
        "rate": {"v": "c*(late/T - v)"},
    },
    "network": {
        "parameters": {"unit": "1 m/s²"},
        "network": 3,
        "rate": {"v": "unit*NN(gap/20, v/10, dv/2)"},
    },
    "second": {
        "parameters": {"c": "0.1 1/s²", "k": "0.4 1/s"},
        "rate": {"v": "c*(gap_1 - gap) + k*(v_2 - v)"},
    },
    "hybrid": {**CAR_FOLLOWING_LAWS["idm"], "network": 2},
}
#: Values of effects that are not neutral; the others' defaults are not neutral.
EFFECTS: dict[str, dict[str, Any]] = {
    "speed_zone": {"alpha": 0.7, "a": 10.0, "b": 40.0},
    "speed_period": {"alpha": 0.7, "a": 0.1, "b": 2.0},
    "vehicle_class": {"kind": "truck", "phi": 1.3},
    "driver_heterogeneity": {"people": {"p0": [0.1, 0.0, -0.2, 0.0], "p1": [0.1, 0.1]}},
    "slope": {"grade": 0.04, "a": 10.0, "b": 45.0},
    "pure_delay": {"T": 0.13},
}
#: Laws that the thorough tests compile.
COMPILED = ("lin", "speed_ahead", "state", "hybrid", "ovm", "fvdm", "helly", "gipps", "a2")

SOCIAL = {"term": "social_force", "A": 2.0, "k": 30.0, "kappa": 9.0, "B": 0.1}
#: Options of the paper's forces.
FORCES: dict[str, dict[str, Any]] = {
    "sf": SOCIAL,
    "sf_opposing": {**SOCIAL, "r": 0.3, "mass": 2.0, "tau": 0.7, "opposing_wall_friction": True},
    "sf_open": {**SOCIAL, "walls": False},
    "nn": {"term": "network_force"},
    "nn_open": {"term": "network_force", "hidden": 3, "mass": 2.0, "walls": False},
    "nn_self": {"term": "network_force", "self_interaction": True},
}
#: Users' laws of people with sums, and with smallest and largest values that name each other.
OWN_FORCES: dict[str, dict[str, Any]] = {
    "sums": LAW,
    "smallest": {
        "parameters": {"A": "0.6 1/s", "B": "0.5 m", "C": "0.3 1/s²", "tau": "0.7 s"},
        "where": {
            "crowded": "1 + number",
            "near": "d*crowded",
            "push": "A*max(2*B - closest, 0)/tau",
        },
        "others": {"number": "exp(-d/B)"},
        "smallest": {"closest": "near", "slow": "sqrt(dvx**2 + dvy**2 + small_v**2)"},
        "largest": {"right": "choose(2.5*B - d, dx, -nobody)"},
        "rate": {
            "vx": "(speed*way_x - vx)/tau + push + C*max(right, -B)",
            "vy": "(speed*way_y - vy)/tau + 0.1*A*min(slow, speed)",
        },
    },
}
#: Values of effects on people that are not neutral.
CROWD_EFFECTS: dict[str, dict[str, Any]] = {
    **VALUES,
    "walker_heterogeneity": {"people": {"6": [0.1, -0.2, 0.0, 0.3, 0.1, -0.1], "2": [0.2, 0.1]}},
}
#: Laws of people in the fast tests.
OFTEN = ("sf", "nn", "nn_self", "sums")
#: Two sides of a room, and a wall in it; x1, y1, x2, y2 in m.
WALLS = np.array([[0.0, 0.0, 4.0, 0.0], [4.0, 2.5, 0.0, 2.5], [1.0, 0.5, 2.5, 2.0]])


def platoons(numbers: tuple[int, ...] = (4, 2, 3)) -> Batch:
    """Oscillating platoons of cars and trucks, with different numbers of vehicles and samples."""
    items = []
    for i, n in enumerate(numbers):
        late = 0.1 * np.arange(6 - i)[:, None] - 0.3 * np.arange(n)[::-1]
        x = 12 * late + 2 * np.sin(late + i) + (22.3 + i) * np.arange(n)
        truck = np.arange(n) == 1
        kind = tuple(np.where(truck, "truck", "car").tolist())
        length = np.where(truck, 9.0, 4.0)
        items.append(
            lane(x, 0.1, v=12 + 2 * np.cos(late + i), name=f"p{i}", length=length, kind=kind)
        )
    return collate(items)


def lane_of(law: str, leader: str, *effects: str) -> Traffic:
    chosen = [{"name": e, **EFFECTS.get(e, {})} for e in effects]
    if law in PAPER:
        system = build_model({"name": law, "leader": leader, "effects": chosen, **PAPER[law]})
    elif law == "newell":
        short = {**CAR_FOLLOWING_LAWS[law], "remembered": 4}
        system = model(short, *chosen, leader=leader)
    else:
        entry = dict(OWN.get(law, {}))
        network = {"network": entry.pop("network")} if "network" in entry else {}
        system = model(entry or law, *chosen, leader=leader, **network)
    with torch.no_grad():  # away from kinks and from neutral networks
        for i, p in enumerate(system.parameters()):
            if p.ndim:
                p.add_(0.05 * torch.cos(torch.arange(p.numel()) + i).reshape(p.shape))
    return system


def weights(batch: Batch, states: int) -> Tensor:
    """``(K, B, N, M)`` different weights of all valid states."""
    shape = (*batch.x.shape[:3], states)
    values = torch.cos(torch.arange(batch.x[..., 0].numel() * states).double()).reshape(shape)
    return torch.where(batch.valid[..., None], values, 0.0)


def states_of(path: Trajectory) -> Tensor:
    """``(K, B, N, M)`` positions, and for laws of second order speeds."""
    return path.x if path.v is None else torch.cat([path.x, path.v], -1)


def exact(system: System, batch: Batch, method: str) -> Tensor:
    """States at the samples by PyTorch."""
    dt = batch.dt / SUBSTEPS
    solver = RungeKutta(SUBSTEPS) if method == "rk4" else TorchdiffeqSolver(method, "discrete", dt)
    return states_of(solver(system, batch))


def compiled(system: System, batch: Batch, method: str, threads: int = 1) -> Tensor:
    """States by generated code."""
    if isinstance(system, Traffic):
        return by_lanes(system, batch, method)
    solver = FusedSolver(batch.dt / SUBSTEPS, threads, method=method)
    path = solver(system, batch)
    assert not solver.uncompiled
    return states_of(path)


def threaded(system: System, batch: Batch, method: str) -> Tensor:
    """States by generated code in two threads."""
    return compiled(system, batch, method, 2)


def by_lanes(system: Traffic, batch: Batch, method: str, **options: Any) -> Tensor:
    """States of the first run. The solver refuses gradients by a leader's measured path."""
    y = lanes.simulate(system, system.formula, batch, SUBSTEPS, method=method, **options)[:, 0]
    return states_of(Trajectory(*system.observe(y, batch)))


def ensemble(system: Traffic, batch: Batch, method: str) -> Tensor:
    """States of the first of two simultaneous runs with different parameters."""
    pairs = {name: torch.stack([p, 1.01 * p]) for name, p in system.named_parameters()}
    return by_lanes(system, batch, method, parameters=pairs)


def with_slopes(
    engine: Callable[..., Tensor], system: System, batch: Batch, *args: Any
) -> tuple[Tensor, dict[str, Tensor]]:
    """States, and the gradient of their weighted sum by parameters and by the start."""
    start = {name: getattr(batch, name)[0].clone().requires_grad_() for name in "xv"}
    moving = {name: torch.cat([t[None], getattr(batch, name)[1:]]) for name, t in start.items()}
    states = engine(system, replace(batch, **moving), *args)
    inputs = {name: p for name, p in system.named_parameters() if p.requires_grad} | start
    total = (weights(batch, states.shape[-1]) * states).sum()
    slopes = torch.autograd.grad(total, [*inputs.values()], allow_unused=True)
    named = {
        name: torch.zeros_like(p) if slope is None else slope
        for (name, p), slope in zip(inputs.items(), slopes, strict=True)
    }
    if getattr(system, "leader", "") == "measured":  # the leader's places and speeds are data
        follower = system.scene(batch).follower[..., None]
        named |= {name: torch.where(follower, named[name], 0.0) for name in start}
    return states, named


def by_tangents(system: Traffic, batch: Batch, method: str) -> tuple[Tensor, dict[str, Tensor]]:
    """The same by derivatives of all states by parameters."""
    lane = system.formula
    total = {name: torch.zeros_like(p) for name, p in system.named_parameters() if p.requires_grad}
    owned = {symbol: at for symbol, at in lane.owned.items() if at[0] in total}
    y, slopes = lanes.tangents(system, lane, batch, SUBSTEPS, list(owned), method=method)
    weight = weights(batch, system.order)
    if system.leader == "measured":
        weight = torch.where(system.scene(batch).follower[..., None], weight, 0.0)
    for slope, (name, place, _) in zip(slopes, owned.values(), strict=True):
        total[name].view(-1)[place] = (weight * slope[..., : system.order]).sum()
    return states_of(Trajectory(*system.observe(y, batch))), total


def check(system: System, batch: Batch, method: str, *engines: Any) -> None:
    """Compare states, and each part of the gradient."""
    states, expected = with_slopes(exact, system, batch, method)
    assert expected["x"].abs().max() > 0
    for engine in engines:
        simulated, slopes = (
            engine(system, batch, method)
            if engine is by_tangents
            else with_slopes(engine, system, batch, method)
        )
        torch.testing.assert_close(
            simulated[batch.valid], states[batch.valid], rtol=1e-12, atol=1e-11
        )
        for name, slope in slopes.items():
            # sums cancel: the rounding error scales with the largest part of the gradient
            limit = 1e-9 * float(expected[name].abs().max()) + 1e-12
            error = float((slope - expected[name]).abs().max())
            assert error <= limit, (engine.__name__, name, slope, expected[name])


def methods(law: str, *effects: str) -> list[str]:
    """All methods, except that discrete laws have no stages."""
    discrete = "dt" in lane_of(law, "measured", *effects).formula.symbols
    return [method for method in METHODS if not (method == "rk4" and discrete)]


def cases(laws: Iterable[str]) -> list[Any]:
    """Laws with methods; large networks are slow, and have formulas like small networks."""
    rows = []
    for law in laws:
        for method in methods(law):
            large = law in ("n4", "n10", "a4", "a10") and method != "rk4"
            marks = [pytest.mark.thorough] if large else []
            rows.append(pytest.param(law, method, marks=marks))
    return rows


def with_effects() -> list[Any]:
    """Each effect on a law of each order, and effects that depend on each other."""
    rows = [
        ("lin", "reaction_delay+relative_speed+speed_zone", "euler"),
        ("lin", "reaction_delay+inertia", "euler"),
        ("idm", "memory+relative_speed", "euler"),
    ]
    for law, order in (("lin", 1), ("idm", 2)):
        for effect in CATALOGUE.of("traffic", every=True):
            for method in methods(law, effect.name) if order in effect.rules else ():
                often = method in ("rk4", "ballistic" if effect.name == "pure_delay" else "")
                marks = [] if often else [pytest.mark.thorough]
                rows.append(pytest.param(law, effect.name, method, marks=marks))
    return rows


@pytest.mark.usefixtures("without_compiler")
@pytest.mark.parametrize("leader", LEADERS)
@pytest.mark.parametrize(("law", "method"), cases([*PAPER, *OWN, *CAR_FOLLOWING_LAWS]))
def test_laws_and_methods(law: str, method: str, leader: str) -> None:
    check(lane_of(law, leader), platoons(), method, compiled, ensemble, by_tangents)


@pytest.mark.usefixtures("without_compiler")
@pytest.mark.parametrize("leader", LEADERS)
@pytest.mark.parametrize(("law", "effect", "method"), with_effects())
def test_effects(law: str, effect: str, method: str, leader: str) -> None:
    system = lane_of(law, leader, *effect.split("+"))
    check(system, platoons(), method, compiled, by_tangents)


@pytest.mark.parametrize(
    "law", ["n4", "idm", *(pytest.param(n, marks=pytest.mark.thorough) for n in COMPILED)]
)
def test_compiled_stages(law: str) -> None:
    check(lane_of(law, "constant"), platoons(), "rk4", compiled)


@pytest.mark.thorough
@pytest.mark.parametrize("law", ["lin", "idm", "speed_ahead"])
@pytest.mark.parametrize("method", METHODS)
def test_compiled_runs_and_tangents(law: str, method: str) -> None:
    check(lane_of(law, "constant"), platoons(), method, ensemble, by_tangents)


def room() -> Batch:
    """Crowds of one to nine people with different durations, and zero to three walls."""
    crowds = []
    for n, walls, samples in ((6, 1, 6), (9, 2, 4), (1, 3, 6), (2, 0, 6)):
        draw = np.random.default_rng(n)
        x, v = draw.uniform(0, [4.0, 2.5], (n, 2)), draw.normal(0, 0.8, (n, 2))
        preferred = draw.choice([-1.3, 1.3], (n, 1)) * [1.0, 0.1]
        group = tuple("ab"[i % 2] for i in range(n))
        fields = {"walls": WALLS[:walls], "preferred": preferred, "group": group}
        crowds.append(straight(x, v, samples, 0.04, name=f"{n}", **fields))
    return collate(crowds)


def crowd_of(law: str, *effects: str) -> System:
    chosen = [{"name": e, **CROWD_EFFECTS[e]} for e in effects]
    if law in FORCES:
        return build_model({**model_options({"name": law, **FORCES[law]}), "effects": chosen}, 3)
    entry = OWN_FORCES.get(law) or PEDESTRIAN_LAWS[law]
    options = model_options({"term": "formula", "name": law, "law": entry})
    system = build_model({**options, "desired": "direction", "effects": chosen})
    return set_(system, k=0.2) if law == "ttc" else system  # so that people stay in the room


@pytest.mark.parametrize(
    "law",
    [
        pytest.param(law, marks=() if law in OFTEN else pytest.mark.thorough)
        for law in (*FORCES, *OWN_FORCES, *PEDESTRIAN_LAWS)
    ],
)
def test_laws_of_people(law: str) -> None:
    check(crowd_of(law).double(), room(), "euler", compiled, threaded)


@pytest.mark.thorough
@pytest.mark.parametrize("effect", CROWD_EFFECTS)
def test_effects_on_people(effect: str) -> None:
    check(crowd_of("sf", effect).double(), room(), "euler", compiled)


@pytest.mark.parametrize("leader", LEADERS)
@pytest.mark.parametrize("law", ["lin", "idm"])
@pytest.mark.parametrize(("method", "order"), [("euler", 1), ("ballistic", 1), ("rk4", 4)])
def test_adjoint_gradient_converges(law: str, method: str, order: int, leader: str) -> None:
    """A step that is four times smaller divides the error of the gradient by 4**order."""
    system, batch = lane_of(law, leader), platoons()

    def adjoint(system: System, batch: Batch, substeps: int) -> Tensor:
        return states_of(TorchdiffeqSolver(method, "adjoint", batch.dt / substeps)(system, batch))

    def gradient(*args: Any) -> Tensor:
        slopes = with_slopes(args[0], system, batch, *args[1:])[1]
        return torch.cat([slope.flatten() for slope in slopes.values()])

    *gradients, finest = (gradient(adjoint, substeps) for substeps in (1, 4, 16))
    coarse, fine = (float((each - finest).norm()) for each in gradients)
    assert fine > 0
    # errors c, c/r and c/r² with r = 4**order: the distances to the last have the ratio r + 1
    assert coarse / fine > 0.7 * (4**order + 1), (coarse, fine)
    away = gradient(exact, "rk4") - finest
    assert away.norm() < 2 * coarse / 4**order + 1e-7 * finest.norm()
