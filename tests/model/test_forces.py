"""Accelerations of people against loops over the paper's equations, and their derivatives."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.func import functional_call

from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import Crowd, InteractionForce, Law, Scene, State, Term, make_law
from nnode.model.effects.crowd import FieldOfView
from tests import builders
from tests.builders import straight
from tests.model.following import rates

A, K, KAPPA, R, B, MASS = 3.0, 40.0, 9.0, 0.25, 0.1, 70.0
#: The corridor lies between y = 0 and y = 2 m.
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


def state(batch: Batch, **fields: Any) -> State:
    return State(torch.zeros(()), batch.x[0], batch.v[0], Scene.of(batch, SPACING), **fields)


def social_force(**options: Any) -> Law:
    return make_law("social_force", A=A, k=K, kappa=KAPPA, r=R, B=B, mass=MASS, **options)


def network_force(**options: Any) -> Law:
    """The same weights at every call."""
    draw = torch.Generator().manual_seed(2)
    return make_law("network_force", hidden=4, mass=MASS, generator=draw, **options)


def assert_accelerations(
    term: Term, items: list[Sequence], loop: Any, rtol: float = 1e-9, atol: float = 0.0
) -> None:
    """Compare a term with ``loop(item)`` for each crowd."""
    accelerations = term(state(collate(items))).detach()
    for row, item in zip(accelerations, items, strict=True):
        np.testing.assert_allclose(row[: item.n_agents], loop(item), rtol=rtol, atol=atol)


def wall_loop() -> list[tuple[np.ndarray, np.ndarray]]:
    """Points every 0.5 m, and the normals into the corridor."""
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


def network_loop(term: InteractionForce, item: Sequence, on_self: bool) -> np.ndarray:
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
            if j != i or on_self:
                total[i] += evaluate(term.pair, [*(x[i] - x[j]), *(v[i] - v[j])]) / (n * MASS)
        for point, normal in points:
            force = evaluate(term.wall, [*(x[i] - point), *(v[i] - normal)])
            total[i] += force / (len(points) * MASS)
    return total


CROWDS = [people(5, 1), people(3, 2), people(1, 3), people(4, 4, walls=None)]


@pytest.mark.parametrize(("opposing", "sign"), [(False, 1.0), (True, -1.0)])
def test_social_force(opposing: bool, sign: float) -> None:
    term = social_force(opposing_wall_friction=opposing)
    assert_accelerations(term, CROWDS, lambda item: social_force_loop(item, sign), atol=1e-9)


def test_contacts_occur() -> None:
    x = CROWDS[0].x[0]
    apart = np.linalg.norm(x[:, None] - x[None], axis=-1) + 9 * np.eye(len(x))
    to_wall = [np.linalg.norm(x - point, axis=1).min() for point, _ in wall_loop()]
    assert apart.min() < 2 * R < apart[apart < 9].max()
    assert min(to_wall) < R


@pytest.mark.parametrize("on_self", [False, True])
def test_network_force(on_self: bool) -> None:
    term = network_force(self_interaction=on_self)
    assert_accelerations(term, CROWDS, lambda item: network_loop(term, item, on_self), 1e-8, 1e-9)


def test_force_on_oneself_with_measured_others() -> None:
    batch = collate(CROWDS)
    x, v = batch.x[0], batch.v[0]
    measured = state(batch, measured_others=(x + 0.3, v - 1))
    without, with_self = (
        network_force(self_interaction=on_self)(measured) for on_self in (False, True)
    )
    at_zero = network_force().pair(torch.zeros_like(x[0, 0].repeat(2))) / MASS
    for change, item in zip(with_self - without, CROWDS, strict=True):
        expected = (at_zero / item.n_agents).expand(item.n_agents, 2).to(change)
        torch.testing.assert_close(change[: item.n_agents], expected)


def test_effects_do_not_change_the_force_on_oneself() -> None:
    changes = []
    for on_self in (False, True):
        terms = [network_force(self_interaction=on_self), FieldOfView(lambda_=0.2)]
        changes.append(terms[1](state(collate(CROWDS), terms=terms)))
    torch.testing.assert_close(changes[0], changes[1], rtol=0, atol=0)


def relaxation_loop(item: Sequence, tau: float) -> np.ndarray:
    x, v = item.x[0], item.v[0]
    ways = item.destination - x
    desired = [math.hypot(*u) * way / math.hypot(*way) for u, way in zip(v, ways, strict=True)]
    return (desired - v) / tau


def test_relaxation() -> None:
    term = make_law("relaxation", tau=0.4)
    assert_accelerations(term, CROWDS, lambda item: relaxation_loop(item, 0.4))


def test_social_force_without_walls() -> None:
    expected = social_force_loop(people(4, 4, walls=None), 1.0)
    assert_accelerations(social_force(walls=False), [people(4, 4)], lambda _: expected)


@pytest.mark.parametrize("term", [social_force(), network_force()], ids=lambda term: term.name)
def test_components_add_up_to_the_term(term: InteractionForce) -> None:
    parts = term.components(now := state(collate(CROWDS)))
    assert set(parts) == {"pair", "wall"}
    assert all(part.abs().max() > 0 for part in parts.values())
    torch.testing.assert_close(term(now), parts["pair"] + parts["wall"])


def test_rates_of_a_crowd() -> None:
    """Velocities, and the sum of relaxation and interaction."""
    batch, terms = collate(CROWDS[:1]), [make_law("relaxation", tau=0.5), social_force()]
    rate = rates(Crowd(terms, SPACING), batch)
    torch.testing.assert_close(rate[..., :2], batch.v[0])
    expected = sum(term(state(batch)) for term in terms).detach()
    np.testing.assert_allclose(rate[..., 2:], expected, rtol=1e-12)


# The paper prints the forces of its calibrated parameters in six settings: positions and
# velocities of the blue and the red person, and the force on the blue person.
PRINTED = [
    ((0, 0.22), (0, -0.22), (0, -1), (0, 1), (0, 2.1118)),
    ((0, 0.22), (0, -0.22), (0, 1), (0, 1), (0, 2.1118)),
    ((0.01, 0.22), (-0.01, -0.22), (0, -1), (0, 1), (0.0417, 2.0961)),
    ((0.01, 0.22), (-0.01, -0.22), (0, 1), (0, 1), (0.0952, 2.0936)),
    ((0.22, 0), (-0.22, 0), (0, -1), (0, 1), (2.1118, 1.1867)),
    ((0.22, 0), (-0.22, 0), (0, 1), (0, 1), (2.1118, 0)),
]


@pytest.mark.parametrize(("blue", "red", "v_blue", "v_red", "force"), PRINTED)
def test_printed_forces(blue, red, v_blue, v_red, force) -> None:
    term = make_law("social_force", A=0.0044, k=34.9539, kappa=9.8894)
    x, y, v, w = (torch.tensor(p, dtype=torch.float64) for p in (blue, red, v_blue, v_red))
    on_blue, on_red = term.pair_force(x - y, v - w), term.pair_force(y - x, w - v)
    np.testing.assert_allclose(on_blue.detach(), force, atol=1e-4)
    np.testing.assert_allclose(on_red.detach(), -np.asarray(force), atol=1e-4)


def test_parameters_are_kept_non_negative() -> None:
    term = make_law("social_force", A=-1.0, k=2.0, kappa=-1e-9)
    term.project_()
    assert [term.A.item(), term.k.item(), term.kappa.item()] == [0.0, 2.0, 0.0]


def test_crowd_needs_velocities() -> None:
    batch = collate(CROWDS[:1])
    with pytest.raises(ValueError, match="velocities"):
        make_law("relaxation")(State(torch.zeros(()), batch.x[0], None, Scene.of(batch)))


#: Distances of two people: overlapping, barely touching, barely apart, out of reach (2 r = 0.5 m).
DISTANCES = [0.2, 0.499, 0.501, 2.0]


@pytest.mark.parametrize(
    "term",
    [
        make_law("relaxation", tau=0.5),
        make_law("social_force", A=2.0, k=30.0, kappa=9.0, B=0.1),
        make_law("social_force", A=2.0, k=30.0, kappa=9.0, B=0.1, opposing_wall_friction=True),
        make_law("network_force", hidden=4, generator=torch.Generator().manual_seed(1)),
    ],
    ids=["relaxation", "social_force", "social_force_opposing", "network_force"],
)
@pytest.mark.parametrize("distance", DISTANCES)
def test_derivatives_of_forces(term: Term, distance: float) -> None:
    # the third person's distance to the wall's nearest point is distance / 2
    x = np.array([[0.0, 1.2], [0.6 * distance, 1.2 + 0.8 * distance], [1.0, distance / 2]])
    v = np.array([[1.1, 0.2], [-0.7, 0.4], [0.9, -0.3]])
    walls = np.array([[0.0, 0.0, 2.0, 0.0]])
    batch = collate([straight(x, v, 2, 1.0, destination=x + np.array([3.0, 0.5]), walls=walls)])
    scene, parameters = Scene.of(batch, 1.0), dict(term.named_parameters())

    def force(x: Tensor, v: Tensor, *values: Tensor) -> Tensor:
        state = State(torch.zeros(()), x, v, scene)
        return functional_call(term, dict(zip(parameters, values, strict=True)), (state,))

    inputs = (batch.x[0], batch.v[0], *parameters.values())
    inputs = tuple(value.detach().clone().requires_grad_() for value in inputs)
    assert torch.autograd.gradcheck(force, inputs, eps=1e-6, atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize(
    "term",
    [make_law("social_force", A=2.0, k=30.0, kappa=9.0), make_law("relaxation")],
    ids=lambda t: t.name,
)
def test_gradient_of_people_at_rest_at_one_place_is_finite(term: Term) -> None:
    x = np.zeros((2, 2))
    batch = collate([straight(x, x, 2, 1.0, destination=x)])
    place, speed = batch.x[0].clone().requires_grad_(), batch.v[0].clone().requires_grad_()
    force = term(State(torch.zeros(()), place, speed, Scene.of(batch)))
    gradients = torch.autograd.grad(force.sum(), [place, speed, *term.parameters()])
    assert force.isfinite().all()
    assert all(g.isfinite().all() for g in gradients)
