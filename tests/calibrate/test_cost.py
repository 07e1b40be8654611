"""The trajectory cost by hand and, on real recordings, against a plain loop."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.io import loadmat

from nnode.calibrate.cost import Convention, sequence_costs, squared_error
from nnode.calibrate.evaluate import evaluate
from nnode.data.sequence import Batch, collate
from nnode.model import Traffic, make_law
from nnode.simulation import TorchdiffeqSolver, Trajectory
from tests.builders import lane


def two_sequences() -> Batch:
    """Three samples of two vehicles, and two samples of one vehicle."""
    long = lane([[0.0, 10.0], [5.0, 16.0], [9.0, 21.0]], 0.5, name="long")
    return collate([long, lane([[1.0], [4.0]], 0.5, start=7.0, name="short")])


def shifted(batch: Batch) -> Trajectory:
    """A simulation with errors 0, (1, -2), (3, 4) in the first sequence and 0, 5 in the second."""
    x = batch.x.clone()
    x[1, 0, :, 0] += torch.tensor([1.0, -2.0])
    x[2, 0, :, 0] += torch.tensor([3.0, 4.0])
    x[1, 1, 0, 0] += 5.0
    # values of the padding must not matter
    x[2, 1, 0, 0] = float("nan")
    x[:, 1, 1, 0] = float("inf")
    return Trajectory(x, None)


@pytest.mark.parametrize(
    ("convention", "scale"), [(Convention.integral, 0.5), (Convention.sum, 1.0)]
)
def test_costs_and_gradients_by_hand(convention: Convention, scale: float) -> None:
    batch = two_sequences()
    x = shifted(batch).x.requires_grad_()
    squares = [[[0, 0], [0, 0]], [[1, 4], [25, 0]], [[9, 16], [0, 0]]]
    assert squared_error(Trajectory(x, None), batch).tolist() == squares
    costs = sequence_costs(Trajectory(x, None), batch, convention)
    np.testing.assert_allclose(costs.detach(), [15 * scale, 12.5 * scale], rtol=1e-14)
    costs.sum().backward()
    assert x.grad is not None
    # the derivative of 1/2 dt e² is dt e; the padding has no gradient
    errors = [[[0, 0], [0, 0]], [[1, -2], [5, 0]], [[3, 4], [0, 0]]]
    np.testing.assert_array_equal(x.grad[..., 0], scale * np.array(errors))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("convention", list(Convention))
def test_diverged_simulation_has_no_finite_cost(convention: Convention, value: float) -> None:
    batch = two_sequences()
    x, v = batch.x.clone(), batch.v.clone()
    x[2, 0, 0, 0] = v[2, 0, 0, 0] = value
    costs = sequence_costs(Trajectory(x, v), batch, convention)
    assert not costs[0].isfinite()
    assert costs[1] == 0.0


@pytest.mark.real
@pytest.mark.parametrize("recording", ["1-1_1", "2-1_1"])
def test_cost_of_a_recording(real_data: Path, recording: str) -> None:
    """All sequences, including faulty ones, behind a leader at v0."""
    v0, length, dt = 22.0, 4.0, 0.02
    cells = loadmat(real_data / "esimas" / f"sequence_data{recording}.mat")["sequences"].ravel()
    items, costs = [], []
    for number, cell in enumerate(cells):
        z = np.asarray(cell["Xarr"][0, 0], dtype=float)
        time = np.asarray(cell["Tarr"][0, 0], dtype=float).ravel()
        items.append(replace(lane(z.T, name=f"{recording}/{number}"), time=time))
        x, cost = z[:, 0].copy(), 0.0
        for k in range(1, z.shape[1]):
            for _ in range(10):
                speed = [v0 * (1 - length / (x[i + 1] - x[i])) for i in range(len(x) - 1)]
                x = x + dt * np.array([*speed, v0])
            cost += 0.5 * 0.2 * ((x - z[:, k]) ** 2).sum()
        costs.append(cost)
    batches = [collate(items[i : i + 8]) for i in range(0, len(items), 8)]
    model, solver = Traffic([make_law("lin", v0=v0, L=length)]), TorchdiffeqSolver("euler", dt=dt)
    metrics = evaluate(lambda batch: solver(model, batch), batches)
    assert metrics.sequences == len(items) > 20
    np.testing.assert_allclose(list(metrics.costs.values()), costs, rtol=1e-6)
    assert pytest.approx(np.mean(costs), rel=1e-6) == metrics.J
