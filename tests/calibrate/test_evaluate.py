"""Error measures against manual calculations, and baselines on data where they are exact."""

from __future__ import annotations

import json

import numpy as np
import pytest
import torch
from scipy.optimize import minimize_scalar

from nnode.calibrate.cost import Convention
from nnode.calibrate.evaluate import (
    baselines,
    best_common_speed,
    constant_velocity,
    evaluate,
    no_interaction,
)
from nnode.data.sequence import Batch, Sequence, collate
from nnode.model import Crowd, Traffic, make_law
from nnode.simulation import TorchdiffeqSolver, Trajectory
from tests.builders import lane, social_forces, straight

A = lane([[0, 10], [5, 16], [9, 21]], 0.5, name="a")
B = lane([[1], [4]], 0.5, name="b")
C = lane([[0, 8, 30], [4, 12, 33]], 0.5, name="c")
BATCHES = [collate([A, B]), collate([C])]
EULER = TorchdiffeqSolver("euler", dt=0.02)
ERRORS = {"a": [[0, 0], [1, -2], [3, 4]], "b": [[0], [5]], "c": [[0, 0, 0], [0, 0, -2]]}


def lin(leader: str = "constant", **values: float) -> Traffic:
    return Traffic([make_law("lin", **values)], leader)


def with_errors(batch: Batch) -> Trajectory:
    x = batch.x.clone()
    for b, name in enumerate(batch.names):
        error = torch.tensor(ERRORS[name], dtype=x.dtype)
        x[: len(error), b, : error.shape[1], 0] += error
    return Trajectory(x, None)


@pytest.mark.parametrize(
    ("convention", "scale"), [(Convention.integral, 0.5), (Convention.sum, 1.0)]
)
def test_metrics_by_hand(convention: Convention, scale: float) -> None:
    metrics = evaluate(with_errors, BATCHES, convention)
    # squared errors: a 1, 4 then 9, 16; b 25; c 0, 0, 4
    costs = {"a": 15 * scale, "b": 12.5 * scale, "c": 2 * scale}
    assert metrics.costs == pytest.approx(costs)
    assert pytest.approx(sum(costs.values()) / 3) == metrics.J
    assert metrics.sequences == 3
    assert metrics.rmse == pytest.approx((59 / 8) ** 0.5)
    # distances at the last samples: a 3, 4; b 5; c 0, 0, 2
    assert metrics.final_displacement == pytest.approx(14 / 6)
    assert metrics.collisions == 0.0
    assert metrics.horizons == [
        {"t": 0.5, "rmse": pytest.approx((34 / 6) ** 0.5), "n": 6},
        {"t": 1.0, "rmse": pytest.approx((25 / 2) ** 0.5), "n": 2},
    ]
    assert json.loads(json.dumps(metrics.plain())) == metrics.plain()


def test_collisions_by_hand() -> None:
    def colliding(batch: Batch) -> Trajectory:
        x = batch.x.clone()
        if "c" in batch.names:
            x[1, 0, 0, 0] = 12.0  # two vehicles of c are in the same place
        else:
            x[2, 0, 0, 0] = 22.0  # the follower in a is ahead of its leader
            x[0, 0, 0, 0] = 99.0  # the start does not count: it is measured
        return Trajectory(x, None)

    # simulated samples behind a leader: a 2, b none, c 2 followers at 1 sample
    assert evaluate(colliding, BATCHES).collisions == pytest.approx(2 / 4)


def test_metrics_of_crowds_by_hand() -> None:
    batch = collate([straight(np.zeros((2, 2)), np.zeros((2, 2)), 2, 0.04)])

    x = batch.x.clone()
    x[1, 0, 0] += torch.tensor([3.0, 4.0])
    metrics = evaluate(lambda _: Trajectory(x, x), [batch])
    assert metrics.final_displacement == pytest.approx(2.5)
    assert metrics.rmse == pytest.approx((25 / 2) ** 0.5)
    assert pytest.approx(0.5 * 0.04 * 25) == metrics.J
    assert metrics.collisions == 0.0


def test_metrics_do_not_depend_on_batches() -> None:
    single, several = (evaluate(with_errors, b).plain() for b in ([collate([A, B, C])], BATCHES))
    for name in ("costs", "horizons"):
        assert json.dumps(single.pop(name)) == json.dumps(several.pop(name))
    assert single.pop("objectives") == pytest.approx(several.pop("objectives"))
    assert single == pytest.approx(several)


def test_best_common_speed_minimises_the_cost() -> None:
    draw = np.random.default_rng(0)
    items = [
        lane(np.cumsum(draw.uniform(1, 9, (k, n)), 0) + 20.0 * np.arange(n), 0.5, name=str(n))
        for n, k in ((3, 6), (1, 4), (2, 9))
    ]

    def cost(speed: float) -> float:
        return sum(
            ((item.x[0, i, 0] + speed * item.time[k] - item.x[k, i, 0]) ** 2)
            for item in items
            for i in range(item.n_agents)
            for k in range(item.n_samples)
        )

    expected = minimize_scalar(cost, bracket=(0.0, 40.0), tol=1e-12).x
    for batches in ([collate(items)], [collate(items[:1]), collate(items[1:])]):
        assert best_common_speed(batches) == pytest.approx(expected, rel=1e-6)


def steady(n: int, speeds: list[float], samples: int) -> Sequence:
    t = 0.2 * np.arange(samples)[:, None]
    return lane(7.0 + 15.0 * np.arange(n) + t * np.asarray(speeds), name=f"{n}")


@pytest.mark.parametrize("leader", ["constant", "measured"])
def test_constant_velocity_is_exact_on_steady_traffic(leader: str) -> None:
    batch = collate([steady(3, [11.0, 14.0, 12.5], 5), steady(1, [9.0], 3)])
    metrics = evaluate(constant_velocity(lin(leader)), [batch])
    assert metrics.rmse < 1e-12


@pytest.mark.parametrize("leader", ["constant", "measured"])
def test_no_interaction_in_traffic_is_free_speed(leader: str) -> None:
    item = steady(2, [9.0, 14.0], 4)
    simulate = no_interaction(lin(leader), EULER, 12.0)
    x = simulate(collate([item])).x[:, 0, :, 0].detach()
    np.testing.assert_allclose(x[:, 0], 7.0 + 12.0 * item.time, rtol=1e-12)
    first = item.x[:, 1, 0] if leader == "measured" else 22.0 + 12.0 * item.time
    np.testing.assert_allclose(x[:, 1], first, rtol=1e-12)


def walkers() -> Sequence:
    """Three people on straight lines to their destinations."""
    start, v = [[0.0, 0.0], [0.3, 0.2], [2.0, 1.0]], [[1.2, 0.1], [-0.8, 0.5], [0.0, 1.4]]
    return straight(start, v, 6, 0.1, name="w", walls=np.array([[-2.0, -1.0, 4.0, -1.0]]))


CROWD = Crowd(social_forces(A=1.0, k=40.0))


def test_baselines_are_exact_for_people_on_straight_paths() -> None:
    batch = collate([walkers()])
    solver = TorchdiffeqSolver("euler", dt=0.05)
    for simulate in baselines(CROWD, solver, None).values():
        assert evaluate(simulate, [batch]).rmse < 1e-9
    # the people are close enough for the interaction to matter
    assert evaluate(lambda b: solver(CROWD, b), [batch]).rmse > 0.01


def test_no_interaction_in_crowds_is_relaxation() -> None:
    item = walkers()
    batch = collate([item])
    batch.destination = batch.destination + torch.tensor([0.5, -2.0])
    simulated = no_interaction(CROWD, TorchdiffeqSolver("euler", dt=0.05), None)(batch)
    destination = batch.destination[0].numpy()
    x, v = item.x[0].copy(), item.velocity()[0].copy()
    for k in range(6):
        np.testing.assert_allclose(simulated.x[k, 0], x, rtol=1e-9, atol=1e-9)
        for _ in range(2):
            direction = destination - x
            direction /= np.linalg.norm(direction, axis=1, keepdims=True)
            desired = np.linalg.norm(v, axis=1, keepdims=True) * direction
            x, v = x + 0.05 * v, v + 0.05 * (desired - v) / 0.5


def test_baselines_of_a_single_precision_model_have_double_positions() -> None:
    model = lin().to(torch.float32)
    batch = collate([steady(2, [12.5] * 2, 4)]).to(dtype=torch.float32)
    for simulate in baselines(model, EULER, 12.5).values():
        assert simulate(batch).x.dtype == torch.float64


def test_given_leaders_do_not_count_in_metrics() -> None:
    batch = collate([A, lane([[0, 8], [4, 12]], 0.5, name="c")])
    model = lin("measured", v0=20.0, L=5.0)

    x = batch.x.clone()
    x[1:, :, 0] -= 3.0
    given = evaluate(lambda _: Trajectory(x, None, model.given(batch)), [batch])
    free = evaluate(lambda _: Trajectory(x, None, None), [batch])
    assert given.rmse == pytest.approx(3.0)
    assert free.rmse == pytest.approx(3.0 / 2**0.5)
    assert given.final_displacement == pytest.approx(3.0)
    assert [row["rmse"] for row in given.horizons] == pytest.approx([3.0, 3.0])
    assert [row["n"] for row in given.horizons] == [2, 1]
    # the minimised cost and the objectives of followers are the same
    assert given.J == free.J
    assert given.objectives == free.objectives


@pytest.mark.parametrize("leader", ["constant", "measured"])
def test_rmse_of_followers_by_hand(leader: str) -> None:
    batch = collate([steady(3, [12.0, 15.0, 9.0], 8)])
    model = lin(leader, v0=14.0, L=5.0)
    for simulate in (lambda b: EULER(model, b), *baselines(model, EULER, 12.0).values()):
        errors = (simulate(batch).x - batch.x)[1:, 0, :, 0].detach()
        if leader == "measured":
            errors = errors[:, :-1]
        metrics = evaluate(simulate, [batch])
        assert metrics.rmse == pytest.approx(float(errors.square().mean().sqrt()), rel=1e-12)
        assert metrics.horizons[-1]["n"] == errors.shape[1]


def test_common_speed_excludes_measured_leaders() -> None:
    time = 0.5 * np.arange(5)[:, None]
    batch = collate([lane(time * [8.0, 12.0, 30.0] + [0.0, 50.0, 100.0], 0.5)])
    assert best_common_speed([batch]) == pytest.approx(50 / 3)
    assert best_common_speed([batch], lin()) == pytest.approx(50 / 3)
    measured = lin("measured")
    assert best_common_speed([batch], measured) == pytest.approx(10.0)
