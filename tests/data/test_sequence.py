"""Sequences, and their padding to batches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from nnode.data.sequence import PADDING_GAP, Sequence, collate
from nnode.errors import DataError
from tests.builders import lane, people


def platoon(name: str, k: int, n: int, dt: float = 0.2, **fields: object) -> Sequence:
    """Vehicles 10 m apart at 20 m/s from 3 s on."""
    x = 10.0 * np.arange(n) + 20.0 * dt * np.arange(k)[:, None]
    return lane(x, dt, start=3.0, name=name, **fields)


def test_sizes_and_interval() -> None:
    item = platoon("a", 6, 3)
    assert (item.n_samples, item.n_agents) == (6, 3)
    assert item.dt == pytest.approx(0.2)
    assert np.isnan(platoon("one", 1, 2).dt)


def test_velocity_is_stored_or_a_forward_difference() -> None:
    item = platoon("a", 6, 3)
    np.testing.assert_allclose(item.velocity(), np.full_like(item.x, 20.0))
    stored = platoon("b", 6, 3, v=7.0)
    np.testing.assert_array_equal(stored.velocity(), 7.0)
    np.testing.assert_array_equal(platoon("c", 1, 2).velocity(), 0.0)


def test_select_keeps_all_fields() -> None:
    item = platoon(
        "a",
        4,
        3,
        agents=("p", "q", "r"),
        kind=("car", "truck", "car"),
        length=np.array([4.0, 12.0, 5.0]),
        destination=np.array([[1.0], [2.0], [3.0]]),
    )
    kept = item.select(np.array([True, False, True]))
    assert kept.agents == ("p", "r")
    assert kept.kind == ("car", "car")
    assert kept.group is None
    np.testing.assert_array_equal(kept.length, [4.0, 5.0])
    np.testing.assert_array_equal(kept.destination, [[1.0], [3.0]])
    np.testing.assert_array_equal(kept.x, item.x[:, [0, 2]])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": np.zeros((4, 3))}, r"x must be \(K, N, D\)"),
        ({"time": np.zeros(5)}, r"time must be \(4,\)"),
        ({"v": np.zeros((4, 2, 1))}, r"v must be \(4, 3, 1\)"),
        ({"length": np.zeros(2)}, r"length must be \(3,\)"),
        ({"length": np.array([4.0, np.nan, -4.0])}, r"a length is -4 m, expected a positive"),
        ({"destination": np.zeros((3, 2))}, r"destination must be \(3, 1\)"),
        ({"agents": ("a", "b")}, "agents must name 3 agents, got 2"),
        ({"kind": ("car",)}, "kind must name 3 agents, got 1"),
    ],
)
def test_invalid_shapes_and_lengths(change: dict[str, object], message: str) -> None:
    fields = {"time": np.arange(4.0), "x": np.zeros((4, 3, 1)), **change}
    with pytest.raises(DataError, match=f"rec/7: {message}"):
        Sequence(name="rec/7", recording="rec", **fields)


def test_collate_pads_platoons_in_front_of_their_leader() -> None:
    batch = collate([platoon("long", 5, 2), platoon("wide", 3, 4)])
    assert batch.x.shape == (5, 2, 4, 1)
    assert len(batch) == 2
    assert batch.n_samples == 5
    assert batch.names == ("long", "wide")
    assert batch.dt == pytest.approx(0.2)
    assert batch.agent.tolist() == [[True, True, False, False], [True] * 4]
    assert batch.valid.sum((0, 2)).tolist() == [5 * 2, 3 * 4]
    assert batch.valid[3:, 1].sum() == 0
    # every vehicle, padding included, has a finite and positive gap at every time
    gaps = batch.x[:, :, 1:, 0] - batch.x[:, :, :-1, 0]
    assert torch.isfinite(batch.x).all()
    assert (gaps > 0).all()
    padding = gaps[:, 0, 1:]
    assert (padding >= PADDING_GAP - 1e-9).all()
    assert (batch.v[~batch.valid] == 0).all()
    # after its end a sequence stays at its last position, which is its destination
    assert torch.equal(batch.x[3, 1], batch.x[2, 1])
    assert torch.equal(batch.destination, batch.x[-1])
    assert batch.start.tolist() == [3.0, 3.0]


def test_collate_pads_people_at_a_distance() -> None:
    rng = np.random.default_rng(0)
    walls = np.array([[5.0, 4.0, -5.0, 4.0]])
    batch = collate(
        people(
            rng.uniform(-5, 5, (4, n, 2)),
            0.04,
            destination=np.full((n, 2), 9.0),
            walls=walls if n == 3 else None,
        )
        for n in (1, 3)
    )
    distance = torch.cdist(batch.x[:, 0], batch.x[:, 0])[:, 0, 1:]
    assert (distance >= PADDING_GAP).all()
    assert batch.walls.shape == (2, 1, 4)
    assert batch.walls[0].isnan().all()
    np.testing.assert_array_equal(batch.walls[1], walls)
    assert (batch.destination[0, 0] == 9.0).all()
    assert torch.isfinite(batch.destination).all()


def test_collate_keeps_unknown_lengths_unknown() -> None:
    batch = collate([platoon("a", 3, 2, length=np.array([4.0, 5.0])), platoon("b", 3, 3)])
    assert batch.length[0, :2].tolist() == [4.0, 5.0]
    assert batch.length[0, 2:].isnan().all()
    assert batch.length[1].isnan().all()


def test_batch_in_another_precision() -> None:
    batch = collate([platoon("a", 3, 2)]).to(dtype=torch.float32)
    assert batch.dtype == batch.v.dtype == batch.start.dtype == torch.float32
    assert batch.x.dtype == batch.destination.dtype == batch.walls.dtype == torch.float64
    assert batch.valid.dtype == torch.bool
    assert batch.names == ("a",)


@pytest.mark.parametrize(
    ("items", "message"),
    [
        ([], "at least one sequence"),
        ([platoon("a", 3, 2), platoon("b", 3, 2, dt=0.1)], r"a has 0\.2 s, b 0\.1 s"),
        (
            [platoon("a", 3, 2), people(np.zeros((3, 2, 2)), 0.2, name="c")],
            "a and c differ in their number of dimensions",
        ),
    ],
)
def test_collate_refuses_incompatible_sequences(items: list[Sequence], message: str) -> None:
    with pytest.raises(DataError, match=message):
        collate(items)


@pytest.mark.parametrize("dims", [1, 2])
def test_single_precision_at_map_coordinates(dims: int) -> None:
    """Numbers of float32 are 0.5 m apart at 7,000 km; the positions of a batch have an origin."""
    x = 3.0 * np.random.default_rng(1).random((5, 3, dims)).cumsum(axis=0)
    walls = None if dims == 1 else np.array([[0.0, 0.0, 9.0, 0.0]])
    item = people(x, 0.1, walls=walls)
    shift = np.array([7e6, -3e6])[:dims]
    moved = replace(item, x=x + shift, walls=None if walls is None else walls + np.tile(shift, 2))
    local, mapped = (
        batch.relative_to(batch.origins())
        for batch in (collate([s]).to(dtype=torch.float32) for s in (item, moved))
    )
    assert mapped.x.dtype == torch.float32
    for name in ("x", "destination", "walls"):
        torch.testing.assert_close(getattr(mapped, name), getattr(local, name), rtol=0, atol=1e-6)
