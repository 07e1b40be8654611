"""Crowd effects against loops over people, written from the effects' formulas."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar
from torch.func import functional_call

from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import Crowd, Scene, State, make_law
from nnode.model.build import add_effects
from nnode.model.effects import CATALOGUE, Effect, IndividualEffect
from tests import builders

A, K, KAPPA, R, B = 3.0, 40.0, 9.0, 0.2, 0.3
WALLS = np.array([[0.0, 0.0, 4.0, 0.0], [4.0, 3.0, 0.0, 3.0], [1.0, 1.0, 2.0, 1.5]])
VALUES: dict[str, dict[str, float]] = {
    "pair_repulsion": {"A_2": 0.7, "B_2": 0.9},
    "sliding_friction": {"c": 0.4},
    "alignment": {"c": 0.6},
    "density_slowdown": {"c": 0.5},
    "field_of_view": {"lambda_": 0.2},
    "anticipation": {"T_a": 0.3},
    "evasive_rotation": {"theta": 0.5},
    "side_preference": {"c": 0.3},
    "group_cohesion": {"c": 0.4},
    "preferred_speed": {"c": 0.6, "v_pref": 1.2},
    "drift": {"a_x": 0.2, "a_y": -0.3},
    "wall_repulsion": {"A_w": 0.5, "B_w": 0.6},
    "obstacle": {"A_o": 0.8, "B_o": 0.7, "x_o": 1.1, "y_o": 0.9},
    "attraction": {"A_o": 0.8, "B_o": 0.7, "x_o": 1.1, "y_o": 0.9},
    "walker_heterogeneity": {"sigma": 0.3},
}


def people(n: int, seed: int) -> Sequence:
    draw = np.random.default_rng(seed)
    names = ("a", "b", "a", "", "b", "a", "", "c")
    return builders.people(
        draw.uniform([0.3, 0.2], [3.0, 2.7], (n, 2)) + np.zeros((4, 1, 1)),
        0.1,
        start=12.0,
        name=f"{n}-{seed}",
        v=draw.normal(0, 1.0, (4, n, 2)),
        destination=draw.uniform([4, 0], [6, 3], (n, 2)),
        group=names[:n],
        walls=WALLS,
    )


CROWDS = [people(6, 1), people(3, 2), people(1, 3)]
BATCH = collate(CROWDS)
NUMBERS = {item.name: np.linspace(-1.2, 0.9, item.n_agents).tolist() for item in CROWDS}


def system(name: str) -> Crowd:
    model = Crowd(
        [make_law("relaxation", tau=0.5), make_law("social_force", A=A, k=K, kappa=KAPPA, r=R, B=B)]
    )
    add_effects(model, [{"name": name, **VALUES[name]}])
    effect = model.terms[-1]
    if isinstance(effect, IndividualEffect):
        effect.people = NUMBERS
    return model


def state(
    model: Crowd,
    x: torch.Tensor | None = None,
    v: torch.Tensor | None = None,
    batch: Batch = BATCH,
) -> State:
    x = batch.x[0] if x is None else x
    v = batch.v[0] if v is None else v
    return State(torch.tensor(0.2), x, v, Scene.of(batch), terms=list(model.terms))


def effect_of(name: str) -> tuple[Effect, Crowd]:
    model = system(name)
    return model.terms[-1], model


# -- the formulas for each person ----------------------------------------------------------------


def unit(a: np.ndarray) -> np.ndarray:
    return a / math.hypot(*a)


def base_force(dx: np.ndarray, dv: np.ndarray, n: int) -> np.ndarray:
    d = math.hypot(*dx)
    normal = dx / d
    tangent = np.array([-normal[1], normal[0]])
    contact = max(2 * R - d, 0.0)
    push = A * math.exp((2 * R - d) / B) + K * contact
    return (push * normal + KAPPA * contact * float(dv @ tangent) * tangent) / n


def rotate(f: np.ndarray, angle: float) -> np.ndarray:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([c * f[0] - s * f[1], s * f[0] + c * f[1]])


def near_wall(x: np.ndarray, wall: np.ndarray) -> np.ndarray:
    """The nearest point of a wall, by a search along it."""

    def distance(share: float) -> float:
        return math.dist(x, wall[:2] + share * (wall[2:] - wall[:2]))

    best = minimize_scalar(distance, bounds=(0, 1), method="bounded", options={"xatol": 1e-11})
    share = min((0.0, 1.0, float(best.x)), key=distance)
    return np.asarray(wall[:2] + share * (wall[2:] - wall[:2]))


def formula(name: str, item: Sequence, i: int) -> np.ndarray:
    """The acceleration of person i by an effect."""
    p = VALUES[name]
    x, v, n = item.x[0], item.v[0], item.n_agents
    others = [j for j in range(n) if j != i]
    e = unit(v[i])
    right = np.array([e[1], -e[0]])
    total = np.zeros(2)
    if name == "pair_repulsion":
        for j in others:
            d = math.dist(x[i], x[j])
            total += p["A_2"] * math.exp((2 * R - d) / p["B_2"]) * unit(x[i] - x[j])
    elif name == "sliding_friction":
        for j in others:
            normal = unit(x[i] - x[j])
            tangent = np.array([-normal[1], normal[0]])
            size = p["c"] * math.exp((2 * R - math.dist(x[i], x[j])) / 0.5)
            total += size * float((v[j] - v[i]) @ tangent) * tangent
    elif name == "alignment":
        weight = [math.exp(-math.dist(x[i], x[j]) / 2) for j in others]
        for w, j in zip(weight, others, strict=True):
            total += p["c"] * w * (v[j] - v[i]) / sum(weight)
    elif name == "density_slowdown":
        rho = sum(math.exp(-(math.dist(x[i], x[j]) ** 2) / 2) / (2 * math.pi) for j in others)
        total = -p["c"] * rho * v[i]
    elif name == "field_of_view":
        for j in others:
            cosine = float(e @ unit(x[j] - x[i]))
            w = p["lambda_"] + (1 - p["lambda_"]) * (1 + cosine) / 2
            total += (w - 1) * base_force(x[i] - x[j], v[j] - v[i], n)
    elif name == "anticipation":
        for j in others:
            later = x[i] + p["T_a"] * v[i] - x[j] - p["T_a"] * v[j]
            total += base_force(later, v[j] - v[i], n)
            total -= base_force(x[i] - x[j], v[j] - v[i], n)
    elif name == "evasive_rotation":
        for j in others:
            angle = p["theta"] * (1 - float(e @ unit(v[j]))) / 2
            force = base_force(x[i] - x[j], v[j] - v[i], n)
            total += rotate(force, angle) - force
    elif name == "side_preference":
        met = 0.0
        for j in others:
            ahead = max(float(e @ unit(x[j] - x[i])), 0.0)
            facing = max(-float(e @ unit(v[j])), 0.0)
            met += ahead * facing / (1 + math.exp((math.dist(x[i], x[j]) - 3) / 0.3))
        total = p["c"] * (1 - math.exp(-met)) * right
    elif name == "group_cohesion":
        mates = [j for j in others if item.group[j] and item.group[j] == item.group[i]]
        if mates:
            total = p["c"] * (np.mean([x[j] for j in mates], axis=0) - x[i])
    elif name == "preferred_speed":
        total = p["c"] * (p["v_pref"] - math.hypot(*v[i])) * e
    elif name == "drift":
        total = np.array([p["a_x"], p["a_y"]])
    elif name == "wall_repulsion":
        for wall in WALLS:
            away = x[i] - near_wall(x[i], wall)
            total += p["A_w"] * math.exp((R - math.hypot(*away)) / p["B_w"]) * unit(away)
    elif name in ("obstacle", "attraction"):
        away = x[i] - np.array([p["x_o"], p["y_o"]])
        total = p["A_o"] * math.exp(-math.hypot(*away) / p["B_o"]) * unit(away)
        total *= 1 if name == "obstacle" else -1
    elif name == "walker_heterogeneity":
        way = unit(item.destination[i] - x[i])
        eta = NUMBERS[item.name][i]
        total = eta * (math.hypot(*v[i]) * way - v[i]) / 0.5
    return total


def test_all_crowd_effects_are_in_the_table() -> None:
    # other tests may register more effects
    effects = [e for e in CATALOGUE.of("crowd") if e.__module__.startswith("nnode.")]
    assert {effect.name for effect in effects} == set(VALUES)


@pytest.mark.parametrize("name", VALUES)
def test_acceleration_by_formula(name: str) -> None:
    effect, model = effect_of(name)
    computed = effect(state(model)).detach().numpy()
    expected = np.zeros_like(computed)
    for b, item in enumerate(CROWDS):
        for i in range(item.n_agents):
            expected[b, i] = formula(name, item, i)
    real = BATCH.agent.numpy()
    np.testing.assert_allclose(computed[real], expected[real], rtol=2e-5, atol=2e-6)
    assert np.abs(expected).max() > 0.05
    assert np.isfinite(computed).all()


@pytest.mark.parametrize("name", VALUES)
def test_neutral_strengths_change_nothing(name: str) -> None:
    effect, model = effect_of(name)
    for key, strength in effect.strengths.items():
        getattr(effect, key).data.fill_(strength.neutral)
    if name == "walker_heterogeneity":
        effect.people = {key: [0.0] * len(values) for key, values in NUMBERS.items()}
    torch.testing.assert_close(effect(state(model)), torch.zeros_like(BATCH.x[0]))


@pytest.mark.parametrize("name", VALUES)
def test_derivatives(name: str) -> None:
    effect, model = effect_of(name)
    names = list(dict(effect.named_parameters()))
    x, v = BATCH.x[0].clone().requires_grad_(), BATCH.v[0].clone().requires_grad_()
    values = [p.detach().clone().requires_grad_() for p in effect.parameters()]

    def run(x: torch.Tensor, v: torch.Tensor, *values: torch.Tensor) -> torch.Tensor:
        parameters = dict(zip(names, values, strict=True))
        return functional_call(effect, parameters, (state(model, x, v),))[BATCH.agent]

    assert torch.autograd.gradcheck(run, (x, v, *values), eps=1e-6, atol=1e-5)


@pytest.mark.parametrize("name", sorted(set(VALUES) - {"drift", "obstacle", "attraction"}))
def test_rotation_and_translation(name: str) -> None:
    """A rotated and shifted scene has rotated accelerations."""
    turn = np.array([[math.cos(0.7), -math.sin(0.7)], [math.sin(0.7), math.cos(0.7)]])

    def place(x: np.ndarray) -> np.ndarray:
        return x @ turn.T + [31.0, -12.0]

    walls = place(WALLS.reshape(-1, 2)).reshape(-1, 4)
    items = [
        replace(
            item,
            x=place(item.x),
            v=item.v @ turn.T,
            destination=place(item.destination),
            walls=walls,
        )
        for item in CROWDS
    ]
    effect, model = effect_of(name)
    turned, original = (
        effect(state(model, batch=batch))[BATCH.agent].detach().numpy()
        for batch in (collate(items), BATCH)
    )
    np.testing.assert_allclose(turned, original @ turn.T, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("name", sorted(set(VALUES) - {"drift"}))
def test_measured_others(name: str) -> None:
    """The others' simulated states do not matter if their states are measured."""
    effect, model = effect_of(name)
    now = state(model)
    now.measured_others = (BATCH.x[0], BATCH.v[0])
    before = effect(now)
    now.x, now.v = BATCH.x[0].clone(), BATCH.v[0].clone()
    now.x[0, 1:] += 0.3
    now.v[0, 1:] -= 0.4
    torch.testing.assert_close(effect(now)[0, 0], before[0, 0])


@pytest.mark.parametrize("name", VALUES)
def test_probes(name: str) -> None:
    effect = CATALOGUE.effects[name]
    probes = effect.probes(BATCH, system(name))
    assert probes
    for probe in probes:
        assert set(probe.steps) <= set(effect.strengths)
        built = effect(**probe.options)
        for key, step in probe.steps.items():
            strength = effect.strengths[key]
            assert strength.range.low <= strength.neutral + step <= strength.range.high
            assert getattr(built, key) == strength.neutral


def test_effects_on_missing_others_have_no_probes() -> None:
    alone = collate([people(1, 3)])
    model = Crowd([make_law("relaxation", tau=0.5)])
    empty = {name for name in VALUES if not CATALOGUE.effects[name].probes(alone, model)}
    assert empty == {
        "pair_repulsion",
        "sliding_friction",
        "alignment",
        "density_slowdown",
        "field_of_view",
        "anticipation",
        "evasive_rotation",
        "side_preference",
        "group_cohesion",
    }


def test_effect_on_a_missing_force() -> None:
    model = Crowd([make_law("relaxation", tau=0.5)])
    add_effects(model, [{"name": "field_of_view", "lambda_": 0.5}])
    with pytest.raises(ValueError, match="social_force or network_force"):
        model(torch.tensor(0.0), torch.cat([BATCH.x[0], BATCH.v[0]], -1), Scene.of(BATCH))


def test_individual_effect_without_a_sequence() -> None:
    effect, model = effect_of("walker_heterogeneity")
    before = effect(state(model))
    copy = CATALOGUE.effects[effect.name](**effect.options())
    torch.testing.assert_close(copy(state(model)), before)
    del copy.people[CROWDS[0].name]
    changed = copy(state(model))
    torch.testing.assert_close(changed[1:], before[1:])
    assert bool((changed[0] == 0).all())


@pytest.mark.parametrize(("fitted", "eta"), [(0.4, 0.4), (-0.9, -0.9), (-2.1, -1.0)])
def test_walker_heterogeneity_is_at_least_minus_one(fitted: float, eta: float) -> None:
    assert CATALOGUE.effects["walker_heterogeneity"].person(np.array([fitted]), {}) == eta
