"""Accelerations of people against double loops written from the paper's equations."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch

from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import Crowd, InteractionForce, Law, Scene, State, Term, make_law
from nnode.model.effects.crowd import FieldOfView
from tests import builders
from tests.model.following import rates

A, K, KAPPA, R, B, MASS = 3.0, 40.0, 9.0, 0.25, 0.1, 70.0
#: the walkable corridor lies between y = 0 and y = 2
WALLS = np.array([[0.0, 0.0, 3.0, 0.0], [3.0, 2.0, 0.0, 2.0]])
SPACING = 0.5


def people(n: int, seed: int, walls: np.ndarray | None = WALLS) -> Sequence:
    """People close enough to touch each other and the walls."""
    draw = np.random.default_rng(seed)
    x = draw.uniform([0.2, 0.05], [1.0, 1.2], (3, n, 2))
    return builders.people(
        x,
        0.04,
        name=f"{n}-{seed}",
        v=draw.normal(0, 1.2, (3, n, 2)),
        destination=draw.uniform([2, 0], [3, 2], (n, 2)),
        walls=walls,
    )


def state(batch: Batch, **more: Any) -> State:
    return State(torch.zeros(()), batch.x[0], batch.v[0], Scene.of(batch, SPACING), **more)


def network_force(**options: Any) -> Law:
    """The same weights at every call."""
    draw = torch.Generator().manual_seed(2)
    return make_law("network_force", hidden=4, mass=MASS, generator=draw, **options)


def accelerations(term: Term, batch: Batch) -> np.ndarray:
    return term(state(batch)).detach().numpy()


def wall_loop() -> list[tuple[np.ndarray, np.ndarray]]:
    """Points every 0.5 m with the normals into the corridor, by hand."""
    low = [(np.array([0.5 * i, 0.0]), np.array([0.0, 1.0])) for i in range(7)]
    high = [(np.array([3 - 0.5 * i, 2.0]), np.array([0.0, -1.0])) for i in range(7)]
    return low + high


def helbing(dx: np.ndarray, reach: float, slip: np.ndarray) -> np.ndarray:
    """Equation (InteractionForceHelbing), componentwise."""
    d = math.hypot(*dx)
    n = dx / d
    t = np.array([-n[1], n[0]])
    h = reach - d if reach > d else 0.0
    return (A * math.exp((reach - d) / B) + K * h) * n + KAPPA * h * float(slip @ t) * t


def social_force_loop(item: Sequence, wall_sign: float) -> np.ndarray:
    x, v, n = item.x[0], item.v[0], item.n_agents
    points = [] if item.walls is None else wall_loop()
    total = np.zeros((n, 2))
    for i in range(n):
        for j in range(n):
            if j != i:
                total[i] += helbing(x[i] - x[j], 2 * R, v[j] - v[i]) / (n * MASS)
        for point, _ in points:
            total[i] += helbing(x[i] - point, R, wall_sign * v[i]) / (len(points) * MASS)
    return total


def network_loop(term: InteractionForce, item: Sequence, oneself: bool = False) -> np.ndarray:
    def evaluate(network: torch.nn.Module, inputs: list[float]) -> np.ndarray:
        (w1, w2), (b1, b2) = (
            [getattr(layer, name).detach().numpy() for layer in network.layers]
            for name in ("weight", "bias")
        )
        return w2 @ np.log(1 + np.exp(w1 @ np.asarray(inputs) + b1)) + b2

    x, v, n = item.x[0], item.v[0], item.n_agents
    points = [] if item.walls is None else wall_loop()
    total = np.zeros((n, 2))
    for i in range(n):
        for j in range(n):
            if j != i or oneself:
                total[i] += evaluate(term.pair, [*(x[i] - x[j]), *(v[i] - v[j])]) / (n * MASS)
        for point, normal in points:
            force = evaluate(term.wall, [*(x[i] - point), *(v[i] - normal)])
            total[i] += force / (len(points) * MASS)
    return total


CROWDS = [people(5, 1), people(3, 2), people(1, 3), people(4, 4, walls=None)]


@pytest.mark.parametrize(("opposing", "sign"), [(False, 1.0), (True, -1.0)])
def test_social_force(opposing: bool, sign: float) -> None:
    term = make_law(
        "social_force", A=A, k=K, kappa=KAPPA, r=R, B=B, mass=MASS, opposing_wall_friction=opposing
    )
    found = accelerations(term, collate(CROWDS))
    for b, item in enumerate(CROWDS):
        expected = social_force_loop(item, sign)
        np.testing.assert_allclose(found[b, : item.n_agents], expected, rtol=1e-9, atol=1e-9)


def test_the_samples_contain_contacts_with_people_and_walls() -> None:
    x = CROWDS[0].x[0]
    apart = np.linalg.norm(x[:, None] - x[None], axis=-1) + 9 * np.eye(len(x))
    to_wall = [np.linalg.norm(x - point, axis=1).min() for point, _ in wall_loop()]
    assert apart.min() < 2 * R < apart[apart < 9].max()
    assert min(to_wall) < R


@pytest.mark.parametrize("oneself", [False, True])
def test_network_force(oneself: bool) -> None:
    term = network_force(self_interaction=oneself)
    found = accelerations(term, collate(CROWDS))
    for b, item in enumerate(CROWDS):
        expected = network_loop(term, item, oneself)
        np.testing.assert_allclose(found[b, : item.n_agents], expected, rtol=1e-8, atol=1e-9)


def test_the_push_of_oneself_does_not_depend_on_where_others_are_seen() -> None:
    batch = collate(CROWDS)
    x, v = batch.x[0], batch.v[0]
    seen = state(batch, measured_others=(x + 0.3, v - 1))
    found = [network_force(self_interaction=oneself)(seen) for oneself in (False, True)]
    at_nought = network_force().pair(torch.zeros_like(x[0, 0].repeat(2))) / MASS
    for b, item in enumerate(CROWDS):
        more = (found[1] - found[0])[b, : item.n_agents]
        torch.testing.assert_close(more, (at_nought / item.n_agents).expand_as(more).to(more))


def test_effects_change_no_force_of_a_person_on_himself() -> None:
    # who does not see those behind him still feels the push that the printed sum gives everyone
    changes = []
    for oneself in (False, True):
        terms = [network_force(self_interaction=oneself), FieldOfView(lambda_=0.2)]
        changes.append(terms[1](state(collate(CROWDS), terms=terms)))
    torch.testing.assert_close(changes[0], changes[1], rtol=0, atol=0)


def test_relaxation() -> None:
    tau = 0.4
    found = accelerations(make_law("relaxation", tau=tau), collate(CROWDS))
    for b, item in enumerate(CROWDS):
        for i in range(item.n_agents):
            way = item.destination[i] - item.x[0, i]
            desired = way / math.hypot(*way) * math.hypot(*item.v[0, i])
            expected = (desired - item.v[0, i]) / tau
            np.testing.assert_allclose(found[b, i], expected, rtol=1e-9)


def test_walls_can_be_left_out() -> None:
    term = make_law("social_force", A=A, k=K, kappa=KAPPA, r=R, B=B, mass=MASS, walls=False)
    item = people(4, 4)
    bare = people(4, 4, walls=None)
    np.testing.assert_allclose(
        accelerations(term, collate([item]))[0], social_force_loop(bare, 1.0), rtol=1e-9
    )


@pytest.mark.parametrize(
    "make",
    [
        lambda: make_law("social_force", A=A, k=K, kappa=KAPPA),
        lambda: make_law("network_force", hidden=4),
    ],
)
def test_components_add_up_to_the_term(make) -> None:  # type: ignore[no-untyped-def]
    term: InteractionForce = make()
    parts = term.components(now := state(collate(CROWDS)))
    assert set(parts) == {"pair", "wall"}
    assert all(part.abs().max() > 0 for part in parts.values())
    torch.testing.assert_close(term(now), parts["pair"] + parts["wall"])


def test_a_crowd_is_relaxation_plus_interaction_of_second_order() -> None:
    batch = collate(CROWDS[:1])
    terms = [make_law("relaxation", tau=0.5), make_law("social_force", A=A, k=K, kappa=KAPPA)]
    model = Crowd(terms, SPACING)
    rate = rates(model, batch)
    torch.testing.assert_close(rate[..., :2], batch.v[0])
    expected = accelerations(terms[0], batch) + accelerations(terms[1], batch)
    np.testing.assert_allclose(rate[..., 2:], expected, rtol=1e-12)


# The paper prints the forces of its calibrated parameters in six settings: positions and
# velocities of the blue and the red person, force on the blue one. Red is pushed the other way.
PRINTED = [
    ((0, 0.22), (0, -0.22), (0, -1), (0, 1), (0, 2.1118)),
    ((0, 0.22), (0, -0.22), (0, 1), (0, 1), (0, 2.1118)),
    ((0.01, 0.22), (-0.01, -0.22), (0, -1), (0, 1), (0.0417, 2.0961)),
    ((0.01, 0.22), (-0.01, -0.22), (0, 1), (0, 1), (0.0952, 2.0936)),
    ((0.22, 0), (-0.22, 0), (0, -1), (0, 1), (2.1118, 1.1867)),
    ((0.22, 0), (-0.22, 0), (0, 1), (0, 1), (2.1118, 0)),
]


@pytest.mark.parametrize(("blue", "red", "v_blue", "v_red", "force"), PRINTED)
def test_the_six_printed_settings(blue, red, v_blue, v_red, force) -> None:  # type: ignore[no-untyped-def]
    term = make_law("social_force", A=0.0044, k=34.9539, kappa=9.8894)
    x, y, v, w = (torch.tensor(p, dtype=torch.float64) for p in (blue, red, v_blue, v_red))
    on_blue, on_red = term.pair_force(x - y, v - w), term.pair_force(y - x, w - v)
    np.testing.assert_allclose(on_blue.detach(), force, atol=1e-4)
    np.testing.assert_allclose(on_red.detach(), -np.asarray(force), atol=1e-4)


def test_parameters_are_kept_non_negative() -> None:
    term = make_law("social_force", A=-1.0, k=2.0, kappa=-1e-9)
    term.project_()
    assert [term.A.item(), term.k.item(), term.kappa.item()] == [0.0, 2.0, 0.0]


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: make_law("relaxation", tau=0.0), "tau"),
        (lambda: make_law("social_force", A=1, k=1, kappa=1, r=-0.1), "r"),
        (lambda: make_law("social_force", A=1, k=1, kappa=1, B=0.0), "B"),
        (lambda: make_law("network_force", mass=0.0), "mass"),
        (lambda: Crowd([make_law("relaxation")], wall_spacing=0.0), "wall_spacing"),
    ],
)
def test_impossible_values_are_refused(make, name: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=name):
        make()


def test_a_crowd_needs_velocities() -> None:
    batch = collate(CROWDS[:1])
    with pytest.raises(ValueError, match="velocities"):
        make_law("relaxation")(State(torch.zeros(()), batch.x[0], None, Scene.of(batch)))
