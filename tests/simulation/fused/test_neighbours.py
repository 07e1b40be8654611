"""Cell lists against all pairs, and errors of a cutoff against their bound."""

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

from nnode.data.sequence import Batch, collate
from nnode.errors import ConfigError
from nnode.model import Crowd, InteractionForce, Traffic, make_law
from nnode.model.formula import crowd_of
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from nnode.simulation.kernels import crowds
from tests.builders import lane, social_forces, straight
from tests.simulation.fused.compare import compare, difference, gradient
from tests.simulation.scenes import network_force

DT = 0.02


@cache
def neighbours() -> Any:
    """A compiled module with the functions of cell lists."""
    return crowds.compiled(crowds.CrowdSource(crowd_of([make_law("social_force")]), near=True))


def with_outliers(draw: np.random.Generator, n: int, outliers: Any) -> np.ndarray:
    return np.concatenate([draw.uniform(0, 10, (n - 2, 2)), outliers])


def lattice(n: int) -> np.ndarray:
    """Positions on the edges of the cells."""
    side = np.arange(math.ceil(n**0.5), dtype=float)
    return np.stack(np.meshgrid(side, side), -1).reshape(-1, 2)[:n]


PLACES = {
    "square": lambda draw, n: draw.uniform(0, n**0.5, (n, 2)),
    "line": lambda draw, n: draw.uniform(0, n, (n, 1)) * [1.0, 0.0],
    "point": lambda draw, n: np.zeros((n, 2)),
    "lattice": lambda draw, n: lattice(n),
    "runaway": lambda draw, n: with_outliers(draw, n, [[1e12, 0], [3, -1e300]]),
    "nan": lambda draw, n: with_outliers(draw, n, [[np.nan, 0], [3, np.inf]]),
    "alone": lambda draw, n: np.array([[3.0, 4.0]]),
}


def arrangement(name: str, n: int = 300) -> np.ndarray:
    return PLACES[name](np.random.default_rng(7), n)


def all_pairs(a: np.ndarray, b: np.ndarray, cutoff: float) -> set[tuple[int, int]]:
    with np.errstate(all="ignore"):
        squares = ((a[:, None] - b[None]) ** 2).sum(-1)
    return {(int(i), int(j)) for i, j in np.argwhere(squares < cutoff**2)}


def pairs_of(x: np.ndarray, cutoff: float) -> tuple[np.ndarray, np.ndarray, int]:
    """The order of people in the cells, a buffer of pairs in this order, and their number."""
    cells = neighbours().grid(x[:, 0], x[:, 1], cutoff)
    assert cells[4] * cells[5] <= 4 * len(x) + 16
    order, cell, start = neighbours().sort(x[:, 0], x[:, 1], cells)
    y, small = x[order].T, np.empty((2, 1), np.int32)
    return order, *neighbours().people_near(y[0], y[1], cells, cell, start, cutoff, small)


@pytest.mark.thorough
@pytest.mark.parametrize("cutoff", [0.7, 1.0, 1.65, 100.0])
@pytest.mark.parametrize("name", PLACES)
def test_pairs_of_people(name: str, cutoff: float) -> None:
    x = arrangement(name)
    order, pairs, number = pairs_of(x, cutoff)
    assert sorted(order) == list(range(len(x)))
    indices = [tuple(sorted((order[i], order[j]))) for i, j in pairs[:, :number].T]
    assert len(set(indices)) == len(indices)
    assert set(indices) == {(i, j) for i, j in all_pairs(x, x, cutoff) if i < j}
    directed, twice = neighbours().both_ways(pairs, number)
    assert twice == 2 * number
    directed = {(int(i), int(j)) for i, j in directed[:, :twice].T}
    assert {(j, i) for i, j in directed} == directed


@pytest.mark.thorough
@pytest.mark.parametrize("points", ["line", "square", "point", "alone"])
@pytest.mark.parametrize("name", PLACES)
def test_pairs_of_people_and_wall_points(name: str, points: str) -> None:
    x, wall, cutoff = arrangement(name), arrangement(points, 80) + np.array([1.0, 0.5]), 1.4
    cells = neighbours().grid(wall[:, 0], wall[:, 1], cutoff)
    order, _, start = neighbours().sort(wall[:, 0], wall[:, 1], cells)
    placed, pairs_buffer = wall[order], np.empty((2, 1), np.int32)
    pairs, number = neighbours().points_near(
        x[:, 0], x[:, 1], placed[:, 0], placed[:, 1], cells, start, cutoff, pairs_buffer
    )
    indices = [(i, int(order[p])) for i, p in pairs[:, :number].T]
    assert len(set(indices)) == len(indices)
    assert set(indices) == all_pairs(x, wall, cutoff)


def test_number_of_pairs_is_linear_in_people() -> None:
    # at one person per square metre, half of pi cutoff^2 pairs per person
    few, many = (pairs_of(arrangement("square", n), 1.65)[2] / n for n in (500, 10_000))
    assert many == pytest.approx(math.pi * 1.65**2 / 2, rel=0.05)
    assert many / few < 1.3


def hall(n: int, samples: int = 3, dt: float = 0.04, walls: int = 2) -> Batch:
    """Two crowds at one person per square metre, many in contact, with up to two walls."""
    draw = np.random.default_rng(3)
    side = n**0.5
    items = []
    for name, count, number in (("a", n, walls), ("b", n - 9, walls // 2)):
        x = draw.uniform(0, side, (count, 2))
        v = np.array([1.3, 0.0]) + 0.2 * draw.standard_normal((count, 2))
        goal = x + np.array([20.0, 0.0])
        lines = np.array([[0, 0, side, 0], [side, side, 0, side]])[:number]
        items.append(straight(x, v, samples, dt, name=name, destination=goal, walls=lines))
    return collate(items)


A, MASS = 3.0, 2.0


def omitted(batch: Batch, decay: float = 0.05, **options: float) -> float:
    """The largest error of an acceleration, m/s², without partners beyond a cutoff."""
    model = Crowd(social_forces(A=A, k=40.0, kappa=5.0, B=decay, mass=MASS))
    with torch.no_grad():
        v = FusedSolver(batch.dt, **options)(model, batch).v
        exact = TorchdiffeqSolver("euler", "discrete")(model, batch).v
    return float((v[1] - exact[1])[batch.valid[1]].norm(dim=-1).max() / batch.dt)


@pytest.mark.parametrize("walls", [False, True])
@pytest.mark.parametrize("cutoff_error", [1e-3, 1e-6, 1e-10])
def test_bound_of_the_error(cutoff_error: float, walls: bool) -> None:
    error = omitted(hall(300, walls=2 * walls), cutoff_error=cutoff_error)
    # forces of people and forces of walls are two means, each within the bound
    assert error <= (1 + walls) * cutoff_error * A / MASS + 1e-12
    if cutoff_error == 1e-3:
        assert error > 0  # the cutoff was used


@pytest.mark.parametrize("cutoff", [0.8, 1.5])
def test_bound_of_the_error_of_a_given_cutoff(cutoff: float) -> None:
    # a given cutoff is used in small crowds too
    error = omitted(hall(40, walls=0), decay=0.1, cutoff=cutoff, cutoff_error=0)
    assert 0 < error < math.exp((0.5 - cutoff) / 0.1) * A / MASS


def test_default_error_is_below_a_millionth_of_a_contact_force() -> None:
    # the force is not divided by the number of people
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
def test_invalid_cutoffs(options: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        FusedSolver(**options)


class Weaker(InteractionForce):
    """A force in Python code, which is not compiled."""

    def pair_force(self, dx: Tensor, dv: Tensor) -> Tensor:
        return 0.5 * super().pair_force(dx, dv)


def test_models_without_a_cutoff() -> None:
    batch, solver = hall(12), FusedSolver(cutoff=1.0)
    cars = collate([lane(np.array([0.0, 12.0]) + np.arange(3.0)[:, None])])
    weaker = Crowd([make_law("relaxation"), Weaker(entry="social_force")])
    for model, data in ((weaker, batch), (Traffic([make_law("lin")]), cars)):
        with pytest.raises(ConfigError, match=r"solver\.cutoff=1 m works for crowds.*it to null"):
            solver(model, data)
    alone = Crowd([make_law("relaxation")])  # has no forces, so that the cutoff does not matter
    with torch.no_grad():
        assert torch.equal(solver(alone, batch).x, FusedSolver()(alone, batch).x)


@pytest.mark.parametrize(("reach", "decay", "error"), [(0.5, 0.05, 1e-10), (0.25, 0.1, 1e-3)])
def test_cutoff_distance(reach: float, decay: float, error: float) -> None:
    c = crowds.cutoff_distance(reach, decay, error)
    assert math.exp((reach - c) / decay) == pytest.approx(error, rel=1e-9)
    assert c > reach  # contacts are within the cutoff


@pytest.mark.parametrize("walls", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_gradient_with_lists(walls: bool) -> None:
    batch = hall(crowds.LISTS_FROM + 20)
    model = Crowd(social_forces(A=3.0, k=40.0, kappa=5.0, walls=walls))
    compare(model, batch, DT, FusedSolver(DT), FusedSolver(DT, 2), limit=1e-8, rtol=0, atol=1e-9)
    # this cutoff includes everybody
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


@pytest.mark.thorough
@pytest.mark.parametrize("grad", [False, True])
@pytest.mark.parametrize("on_self", [False, True])
def test_networks_with_a_cutoff(on_self: bool, grad: bool) -> None:
    batch = hall(40)
    model = Crowd([make_law("relaxation"), network_force(self_interaction=on_self)])
    solvers = [TorchdiffeqSolver("euler", "discrete", DT)]
    solvers += [FusedSolver(DT, cutoff=cutoff) for cutoff in (100.0, 2.0)]
    if grad:
        exact, large, small = (gradient(model, solver, batch)[1] for solver in solvers)
    else:
        with torch.no_grad():
            exact, large, small = (solver(model, batch).x[batch.valid] for solver in solvers)
    assert difference(large, exact) < (1e-10 if grad else 1e-13)
    assert difference(small, exact) > 1e-10


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
