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
from tests.simulation.fused.compare import difference
from tests.simulation.fused.test_crowd import gradient


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


@pytest.mark.thorough
@pytest.mark.parametrize("cutoff", [0.7, 1.0, 1.65, 100.0])
@pytest.mark.parametrize("name", PLACES)
def test_all_pairs_once(name: str, cutoff: float) -> None:
    x = arrangement(name)
    cells = neighbours().grid(x[:, 0], x[:, 1], cutoff)
    assert cells[4] * cells[5] <= 4 * len(x) + 16
    order, cell, start = neighbours().sort(x[:, 0], x[:, 1], cells)
    assert sorted(order) == list(range(len(x)))
    y, room = x[order], np.empty((2, 1), np.int32)
    pairs, number = neighbours().people_near(y[:, 0], y[:, 1], cells, cell, start, cutoff, room)
    found = [tuple(sorted((order[i], order[j]))) for i, j in pairs[:, :number].T]
    assert len(set(found)) == len(found)
    assert set(found) == {pair for pair in near(x, x, cutoff) if pair[0] < pair[1]}
    both, twice = neighbours().both_ways(pairs, number)
    assert twice == 2 * number
    assert {(j, i) for i, j in both[:, :twice].T} == {(i, j) for i, j in both[:, :twice].T}


@pytest.mark.thorough
@pytest.mark.parametrize("points", ["line", "square", "point", "alone"])
@pytest.mark.parametrize("name", PLACES)
def test_people_and_wall_points(name: str, points: str) -> None:
    x, wall, cutoff = arrangement(name), arrangement(points, 80) + np.array([1.0, 0.5]), 1.4
    cells = neighbours().grid(wall[:, 0], wall[:, 1], cutoff)
    order, _, start = neighbours().sort(wall[:, 0], wall[:, 1], cells)
    there, room = wall[order], np.empty((2, 1), np.int32)
    pairs, number = neighbours().points_near(
        x[:, 0], x[:, 1], there[:, 0], there[:, 1], cells, start, cutoff, room
    )
    found = [(i, int(order[p])) for i, p in pairs[:, :number].T]
    assert len(set(found)) == len(found)
    assert set(found) == near(x, wall, cutoff)


def test_pairs_grow_with_people() -> None:
    # at one person per square metre, half of pi cutoff^2 partners each
    shares = []
    for n in (500, 10_000):
        x = arrangement("square", n)
        cells = neighbours().grid(x[:, 0], x[:, 1], 1.65)
        order, cell, start = neighbours().sort(x[:, 0], x[:, 1], cells)
        y, room = x[order], np.empty((2, 1), np.int32)
        _, number = neighbours().people_near(y[:, 0], y[:, 1], cells, cell, start, 1.65, room)
        shares.append(number / n)
    assert shares[1] == pytest.approx(math.pi * 1.65**2 / 2, rel=0.05)
    assert shares[1] / shares[0] < 1.3


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


@pytest.mark.parametrize("cutoff_error", [1e-3, 1e-6, 1e-10])
def test_the_bound_holds(cutoff_error: float) -> None:
    A, mass, n = 3.0, 2.0, 300
    model = Crowd(social_forces(A=A, k=40.0, kappa=5.0, mass=mass))
    # wall points would be averaged over their own number: one bound at a time
    for walls in (False, True):
        batch = hall(n, walls=2 * walls)
        with torch.no_grad():
            v = FusedSolver(batch.dt, cutoff_error=cutoff_error)(model, batch).v
            exact = TorchdiffeqSolver("euler", "discrete")(model, batch).v
        assert v is not None
        assert exact is not None
        away = (v[1] - exact[1])[batch.valid[1]].norm(dim=-1).max() / batch.dt
        # pairs and walls are two means, each within the bound
        assert away <= (1 + walls) * cutoff_error * A / mass + 1e-12
        if cutoff_error == 1e-3:
            assert away > 0  # something was left out


@pytest.mark.parametrize("cutoff", [0.8, 1.5])
def test_the_bound_of_a_given_distance(cutoff: float) -> None:
    A, decay, mass = 3.0, 0.1, 2.0
    batch = hall(40, walls=0)  # small crowds have a cutoff where one is given
    model = Crowd(social_forces(A=A, k=40.0, kappa=5.0, B=decay, mass=mass))
    with torch.no_grad():
        v = FusedSolver(batch.dt, cutoff=cutoff, cutoff_error=0)(model, batch).v
        exact = TorchdiffeqSolver("euler", "discrete")(model, batch).v
    assert v is not None
    assert exact is not None
    away = (v[1] - exact[1])[batch.valid[1]].norm(dim=-1).max() / batch.dt
    assert 0 < away < math.exp((0.5 - cutoff) / decay) * A / mass


@pytest.mark.thorough  # compiled for
def test_no_error_is_everybody() -> None:
    batch = hall(crowds.LISTS_FROM + 20)
    model = Crowd(social_forces(A=3.0, k=40.0, kappa=5.0))
    with torch.no_grad():
        exact = TorchdiffeqSolver("euler", "discrete")(model, batch).x
        for error, same in ((0.0, True), (1e-3, False)):
            found = FusedSolver(batch.dt, cutoff_error=error)(model, batch).x
            away = float((found - exact)[batch.valid].abs().max())
            assert (away < 1e-13) is same


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


def test_default_error_is_below_a_millionth_of_a_touching_partner() -> None:
    # the force on one person, not divided by the number of people
    A, n = 3.0, 2000
    batch = hall(n, walls=0)
    model = Crowd(social_forces(A=A, k=40.0, kappa=5.0))
    with torch.no_grad():
        law = crowds.supports(model, batch)
        assert law is not None
        v = crowds.simulate(model, law, batch, 1)[..., 2:]
        exact = crowds.simulate(model, law, batch, 1, cutoff_error=0)[..., 2:]
    away = (v[1] - exact[1])[batch.valid[1]].norm(dim=-1).max() / batch.dt
    assert away * n < 1e-6 * A


def test_the_formula_of_the_bound() -> None:
    for reach, decay, error in ((0.5, 0.05, 1e-10), (0.25, 0.1, 1e-3)):
        c = crowds.cutoff_distance(reach, decay, error)
        assert math.exp((reach - c) / decay) == pytest.approx(error, rel=1e-9)
        assert c > reach  # contacts are never left out


@pytest.mark.parametrize("walls", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_lists_give_the_gradient(walls: bool) -> None:
    batch = hall(crowds.LISTS_FROM + 20)
    model = Crowd(social_forces(A=3.0, k=40.0, kappa=5.0, walls=walls))
    exact, wanted = gradient(model, TorchdiffeqSolver("euler", "discrete", 0.02), batch)
    for threads in (1, 2):
        found, own = gradient(model, FusedSolver(0.02, threads), batch)
        mask = batch.valid[..., None].expand_as(exact.x)
        torch.testing.assert_close(found.x[mask], exact.x[mask], rtol=0, atol=1e-9)
        assert difference(own, wanted) < 1e-8
        # the lists were used, and a cutoff that reaches everybody leaves nothing out
        assert (found.x[mask] != exact.x[mask]).any()
    _, own = gradient(model, FusedSolver(0.02, cutoff=100.0), batch)
    assert difference(own, wanted) < 1e-10


@pytest.mark.thorough
@pytest.mark.parametrize("walls", [False, True])
def test_lists_in_single_precision(walls: bool) -> None:
    batch = hall(crowds.LISTS_FROM + 20)
    model = Crowd(social_forces(A=3.0, k=40.0, kappa=5.0, walls=walls))
    _, wanted = gradient(model, TorchdiffeqSolver("euler", "discrete", 0.02), batch)
    single = gradient(model.to(torch.float32), FusedSolver(0.02), batch.to(dtype=torch.float32))
    assert difference(single[1], wanted) < 1e-4


def networks(oneself: bool) -> Crowd:
    draw = torch.Generator().manual_seed(2)
    return Crowd(
        [
            make_law("relaxation"),
            make_law("network_force", self_interaction=oneself, generator=draw),
        ]
    )


@pytest.mark.parametrize("oneself", [False, True])
def test_networks_with_a_cutoff(oneself: bool) -> None:
    batch, model = hall(40), networks(oneself)
    with torch.no_grad():
        exact = TorchdiffeqSolver("euler", "discrete", 0.02)(model, batch).x[batch.valid]
        for cutoff, same in ((100.0, True), (2.0, False)):
            found = FusedSolver(0.02, cutoff=cutoff)(model, batch).x[batch.valid]
            assert (float((found - exact).abs().max()) < 1e-12) is same


@pytest.mark.thorough  # compiled for as long as everything above
@pytest.mark.parametrize("oneself", [False, True])
def test_the_gradient_of_networks_with_a_cutoff(oneself: bool) -> None:
    batch, model = hall(40), networks(oneself)
    _, wanted = gradient(model, TorchdiffeqSolver("euler", "discrete", 0.02), batch)
    for cutoff, same in ((100.0, True), (2.0, False)):
        _, own = gradient(model, FusedSolver(0.02, cutoff=cutoff), batch)
        assert (difference(own, wanted) < 1e-10) is same


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
