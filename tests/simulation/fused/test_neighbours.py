"""Cell lists against all pairs, and what a cutoff leaves out against its bound."""

from __future__ import annotations

import math
import subprocess
import sys
from functools import cache
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from nnode.data.sequence import Batch, Sequence, collate
from nnode.errors import ConfigError
from nnode.model import Crowd, InteractionForce, Traffic, make_law
from nnode.model.formula import crowd_of
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from nnode.simulation.kernels import crowds
from tests.builders import social_forces, straight
from tests.simulation.fused.compare import compare, difference, gradient

DT = 0.02


@cache
def neighbours() -> Any:
    """The functions of cell lists, of a module that holds them."""
    law = crowd_of([make_law("social_force")])
    assert law is not None
    return crowds.compiled(crowds.CrowdSource(law, near=True))


def arrangement(name: str, n: int = 300) -> np.ndarray:
    draw = np.random.default_rng(7)
    if name == "square":
        return draw.uniform(0, n**0.5, (n, 2))
    if name == "line":
        return np.stack([draw.uniform(0, n, n), np.zeros(n)], 1)
    if name == "point":
        return np.zeros((n, 2))
    if name == "lattice":  # on the edges of the cells
        side = math.ceil(n**0.5)
        return np.stack(np.meshgrid(*2 * [np.arange(side)]), -1).reshape(-1, 2)[:n] * 1.0
    if name == "runaway":
        return np.concatenate([draw.uniform(0, 10, (n - 2, 2)), [[1e12, 0], [3, -1e300]]])
    if name == "nan":
        return np.concatenate([draw.uniform(0, 10, (n - 2, 2)), [[np.nan, 0], [3, np.inf]]])
    assert name == "alone"
    return np.array([[3.0, 4.0]])


PLACES = ["square", "line", "point", "lattice", "runaway", "nan", "alone"]


def near(a: np.ndarray, b: np.ndarray, cutoff: float) -> set[tuple[int, int]]:
    with np.errstate(all="ignore"):
        away = ((a[:, None] - b[None]) ** 2).sum(-1)
    return {(int(i), int(j)) for i, j in np.argwhere(away < cutoff**2)}


def pairs_of(x: np.ndarray, cutoff: float) -> tuple[np.ndarray, np.ndarray, int]:
    """The order of people in the cells, pairs of places in it, and the number of those that
    count."""
    cells = neighbours().grid(x[:, 0], x[:, 1], cutoff)
    assert cells[4] * cells[5] <= 4 * len(x) + 16
    order, cell, start = neighbours().sort(x[:, 0], x[:, 1], cells)
    y, small = x[order].T, np.empty((2, 1), np.int32)
    return order, *neighbours().people_near(y[0], y[1], cells, cell, start, cutoff, small)


@pytest.mark.thorough
@pytest.mark.parametrize("cutoff", [0.7, 1.0, 1.65, 100.0])
@pytest.mark.parametrize("name", PLACES)
def test_all_pairs_once(name: str, cutoff: float) -> None:
    x = arrangement(name)
    order, pairs, number = pairs_of(x, cutoff)
    assert sorted(order) == list(range(len(x)))
    indices = [tuple(sorted((order[i], order[j]))) for i, j in pairs[:, :number].T]
    assert len(set(indices)) == len(indices)
    assert set(indices) == {pair for pair in near(x, x, cutoff) if pair[0] < pair[1]}
    directed, twice = neighbours().both_ways(pairs, number)
    assert twice == 2 * number
    directed = {(int(i), int(j)) for i, j in directed[:, :twice].T}
    assert {(j, i) for i, j in directed} == directed


@pytest.mark.thorough
@pytest.mark.parametrize("points", ["line", "square", "point", "alone"])
@pytest.mark.parametrize("name", PLACES)
def test_people_and_wall_points(name: str, points: str) -> None:
    x, wall, cutoff = arrangement(name), arrangement(points, 80) + np.array([1.0, 0.5]), 1.4
    cells = neighbours().grid(wall[:, 0], wall[:, 1], cutoff)
    order, _, start = neighbours().sort(wall[:, 0], wall[:, 1], cells)
    placed, pairs_buffer = wall[order], np.empty((2, 1), np.int32)
    pairs, number = neighbours().points_near(
        x[:, 0], x[:, 1], placed[:, 0], placed[:, 1], cells, start, cutoff, pairs_buffer
    )
    indices = [(i, int(order[p])) for i, p in pairs[:, :number].T]
    assert len(set(indices)) == len(indices)
    assert set(indices) == near(x, wall, cutoff)


def test_pairs_grow_with_people() -> None:
    # at one person per square metre, half of pi cutoff^2 partners each
    few, many = (pairs_of(arrangement("square", n), 1.65)[2] / n for n in (500, 10_000))
    assert many == pytest.approx(math.pi * 1.65**2 / 2, rel=0.05)
    assert many / few < 1.3


def hall(n: int, samples: int = 3, dt: float = 0.04, walls: int = 2) -> Batch:
    """People at one per square metre, of whom many touch, between (two) walls; padding."""
    draw = np.random.default_rng(3)
    side = n**0.5
    items = []
    for name, count, most in (("a", n, walls), ("b", n - 9, walls // 2)):
        x = draw.uniform(0, side, (count, 2))
        v = np.array([1.3, 0.0]) + 0.2 * draw.standard_normal((count, 2))
        goal = x + np.array([20.0, 0.0])
        lines = np.array([[0, 0, side, 0], [side, side, 0, side]])[:most]
        items.append(straight(x, v, samples, dt, name=name, destination=goal, walls=lines))
    return collate(items)


A, MASS = 3.0, 2.0


def omitted(batch: Batch, decay: float = 0.05, **options: float) -> float:
    """The largest error of a person's acceleration, m/s², by partners beyond a cutoff."""
    model = Crowd(social_forces(A=A, k=40.0, kappa=5.0, B=decay, mass=MASS))
    with torch.no_grad():
        v = FusedSolver(batch.dt, **options)(model, batch).v
        exact = TorchdiffeqSolver("euler", "discrete")(model, batch).v
    assert v is not None
    assert exact is not None
    return float((v[1] - exact[1])[batch.valid[1]].norm(dim=-1).max() / batch.dt)


@pytest.mark.parametrize("cutoff_error", [1e-3, 1e-6, 1e-10])
def test_the_bound_holds(cutoff_error: float) -> None:
    # wall points would be averaged over their own number: one bound at a time
    for walls in (False, True):
        error = omitted(hall(300, walls=2 * walls), cutoff_error=cutoff_error)
        # pairs and walls are two means, each within the bound
        assert error <= (1 + walls) * cutoff_error * A / MASS + 1e-12
        if cutoff_error == 1e-3:
            assert error > 0  # something was left out


@pytest.mark.parametrize("cutoff", [0.8, 1.5])
def test_the_bound_of_a_given_distance(cutoff: float) -> None:
    # small crowds have a cutoff where one is given
    error = omitted(hall(40, walls=0), decay=0.1, cutoff=cutoff, cutoff_error=0)
    assert 0 < error < math.exp((0.5 - cutoff) / 0.1) * A / MASS


def test_default_error_is_below_a_millionth_of_a_touching_partner() -> None:
    # the force on one person, not divided by the number of people
    assert omitted(hall(2000, walls=0)) * MASS * 2000 < 1e-6 * A


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"cutoff": 0.0}, r"solver\.cutoff=0\.0 m must be larger than 0 m; null derives it"),
        ({"cutoff": -1.0}, r"solver\.cutoff=-1\.0 m"),
        ({"cutoff": math.nan}, r"solver\.cutoff=nan m"),
        ({"cutoff": math.inf}, r"solver\.cutoff=inf m"),
        ({"cutoff_error": 1.0}, r"solver\.cutoff_error=1\.0 must be at least 0 and below 1"),
        ({"cutoff_error": -1e-9}, r"solver\.cutoff_error=-1e-09"),
        ({"cutoff_error": math.nan}, r"solver\.cutoff_error=nan"),
    ],
)
def test_bad_cutoffs_are_refused_before_any_work(options: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        FusedSolver(**options)  # type: ignore[arg-type]


def test_models_that_cannot_have_a_cutoff() -> None:
    batch, solver = hall(12), FusedSolver(cutoff=1.0)

    class Weaker(InteractionForce):
        """Not compiled."""

        def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
            return 0.5 * super().pair_force(dx, dv)

    with pytest.raises(ConfigError, match=r"solver\.cutoff=1 m works for crowds.*set it to null"):
        solver(Crowd([make_law("relaxation"), Weaker(entry="social_force")]), batch)
    x = np.array([0.0, 12.0]) + np.arange(3.0)[:, None]
    cars = collate([Sequence(name="c", recording="r", time=0.2 * np.arange(3), x=x[..., None])])
    with pytest.raises(ConfigError, match=r"solver\.cutoff=1 m works for crowds"):
        solver(Traffic([make_law("lin")]), cars)
    # the baseline without forces needs none
    alone = Crowd([make_law("relaxation")])
    with torch.no_grad():
        assert torch.equal(solver(alone, batch).x, FusedSolver()(alone, batch).x)


def test_the_formula_of_the_bound() -> None:
    for reach, decay, error in ((0.5, 0.05, 1e-10), (0.25, 0.1, 1e-3)):
        c = crowds.cutoff_distance(reach, decay, error)
        assert math.exp((reach - c) / decay) == pytest.approx(error, rel=1e-9)
        assert c > reach  # contacts are never left out


@pytest.mark.parametrize("walls", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_lists_give_the_gradient(walls: bool) -> None:
    batch = hall(crowds.LISTS_FROM + 20)
    model = Crowd(social_forces(A=3.0, k=40.0, kappa=5.0, walls=walls))
    compare(model, batch, DT, FusedSolver(DT), FusedSolver(DT, 2), limit=1e-8, rtol=0, atol=1e-9)
    # a cutoff that reaches everybody leaves nothing out
    compare(model, batch, DT, FusedSolver(DT, cutoff=100.0))
    with torch.no_grad():  # the lists were used
        assert not torch.equal(
            FusedSolver(DT)(model, batch).x, FusedSolver(DT, cutoff=100.0)(model, batch).x
        )


@pytest.mark.thorough
@pytest.mark.parametrize("walls", [False, True])
def test_lists_in_single_precision(walls: bool) -> None:
    model = Crowd(social_forces(A=3.0, k=40.0, kappa=5.0, walls=walls))
    batch, close = hall(crowds.LISTS_FROM + 20), {"limit": 1e-4, "rtol": 1e-4, "atol": 1e-4}
    compare(model, batch, DT, FusedSolver(DT), single_precision=True, **close)


def networks(oneself: bool) -> Crowd:
    draw = torch.Generator().manual_seed(2)
    return Crowd(
        [
            make_law("relaxation"),
            make_law("network_force", self_interaction=oneself, generator=draw),
        ]
    )


# they are compiled for as long as everything above
@pytest.mark.thorough
@pytest.mark.parametrize("grad", [False, True])
@pytest.mark.parametrize("oneself", [False, True])
def test_networks_with_a_cutoff(oneself: bool, grad: bool) -> None:
    batch, model = hall(40), networks(oneself)
    solvers = [TorchdiffeqSolver("euler", "discrete", DT)]
    solvers += [FusedSolver(DT, cutoff=cutoff) for cutoff in (100.0, 2.0)]
    if grad:
        exact, same, near = (gradient(model, solver, batch)[1] for solver in solvers)
    else:
        with torch.no_grad():
            exact, same, near = (solver(model, batch).x[batch.valid] for solver in solvers)
    assert difference(same, exact) < 1e-10 if grad else 1e-13
    assert difference(near, exact) > 1e-10


SCALE = """
import resource
import torch
from tests.simulation.fused.test_neighbours import hall
from tests.builders import social_forces
from nnode.model import Crowd
from nnode.simulation.kernels import crowds
torch.set_num_threads(1)
model = Crowd(social_forces())
law = crowds.supports(model)
crowds.simulate(model, law, hall(10_000, samples=26), 1)[..., :2].square().sum().backward()
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


@pytest.mark.slow
def test_memory_of_ten_thousand_people() -> None:
    done = subprocess.run([sys.executable, "-c", SCALE], capture_output=True, text=True, check=True)
    assert float(done.stdout) < 4e9
