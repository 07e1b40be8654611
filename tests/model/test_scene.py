"""Wall points, leaders and measured positions between samples."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnode.data.sequence import Sequence, collate
from nnode.errors import DataError
from nnode.model import Crowd, Scene, Traffic, make_law
from nnode.model.scene import wall_points
from tests.builders import lane

NAN = float("nan")


@pytest.mark.parametrize(
    ("wall", "spacing", "number"),
    [
        ([0.0, 0.0, 3.0, 4.0], 0.3, 18),  # 5 m long: ceil(5 / 0.3) = 17 pieces
        ([1.0, -2.0, 1.0, 2.0], 0.5, 9),  # the spacing divides the length
        ([1.0, -2.0, 1.0, 2.0], 0.25, 17),
        ([1.0, -2.0, 1.0, 2.0], 0.1, 41),
        ([1.0, 2.0, 1.1, 2.0], 0.25, 2),  # shorter than the spacing
    ],
)
def test_wall_points_are_equally_spaced(wall: list[float], spacing: float, number: int) -> None:
    points, _, real = wall_points(torch.tensor([[wall]], dtype=torch.float64), spacing)
    np.testing.assert_allclose(points[0], np.linspace(wall[:2], wall[2:], number), atol=1e-14)
    assert bool(real.all())


@pytest.mark.parametrize(
    ("wall", "normal"),
    [
        ([0, 0, 1, 0], (0, 1)),
        ([1, 0, 0, 0], (0, -1)),
        ([0, 0, 0, 1], (-1, 0)),
        ([0, 0, 3, 4], (-0.8, 0.6)),
    ],
)
def test_normals_point_to_the_left(wall: list[float], normal: tuple[float, float]) -> None:
    _, normals, _ = wall_points(torch.tensor([[wall]], dtype=torch.float64), 0.5)
    np.testing.assert_allclose(normals[0], np.tile(normal, (normals.shape[1], 1)), atol=1e-15)


def test_padding_of_walls() -> None:
    walls = torch.tensor(
        [
            [[0.0, 0, 1, 0], [1.0, 1, 0, 1]],
            [[0.0, 0, 1, 0], [NAN, NAN, NAN, NAN]],
            [[NAN, NAN, NAN, NAN], [NAN, NAN, NAN, NAN]],
        ]
    )
    points, normals, real = wall_points(walls, 0.5)
    assert real.sum(1).tolist() == [6, 3, 0]
    assert points.isfinite().all()
    assert normals.isfinite().all()
    assert points.dtype == walls.dtype
    # padding points are far from all people
    assert points[~real].abs().min() > 1e3


def test_no_walls() -> None:
    points, normals, real = wall_points(torch.empty(2, 0, 4), 0.5)
    assert points.shape == normals.shape == (2, 0, 2)
    assert real.shape == (2, 0)


def ramp(name: str, samples: int, agents: int) -> Sequence:
    return lane(10.0 * np.arange(agents) + (0.2 * np.arange(samples)[:, None]) ** 2, name=name)


def test_leaders_and_followers() -> None:
    scene = Scene.of(collate([ramp("a", 3, 4), ramp("b", 3, 2), ramp("c", 3, 1)]))
    assert scene.leader.tolist() == [
        [False, False, False, True],
        [False, True, False, False],
        [True, False, False, False],
    ]
    assert scene.follower.tolist() == [
        [True, True, True, False],
        [True, False, False, False],
        [False, False, False, False],
    ]
    assert scene.count.flatten().tolist() == [4, 2, 1]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_measured_positions_between_samples(dtype: torch.dtype) -> None:
    items = [ramp("a", 15, 2), ramp("b", 4, 1)]
    scene = Scene.of(collate(items).to(dtype=dtype))
    for t in [0.0, 0.2, 0.6, 1.4, 0.07, 0.333, 2.55, 2.8, 3.5]:
        measured = scene.measured_at(torch.tensor(t, dtype=dtype))
        for b, item in enumerate(items):
            for i in range(item.n_agents):
                # the last value is held after the end, as by np.interp
                expected = np.interp(t, item.time, item.x[:, i, 0])
                precision = 1e-5 if dtype == torch.float32 else 1e-12
                assert measured[b, i, 0].item() == pytest.approx(expected, abs=precision)


def test_data_of_the_other_domain() -> None:
    batch = collate([ramp("a", 3, 2)])
    with pytest.raises(DataError, match="2-dimensional"):
        Crowd([make_law("relaxation")]).scene(batch)
    flat = Sequence(name="p", recording="r", time=np.arange(3.0), x=np.zeros((3, 2, 2)))
    with pytest.raises(DataError, match="1-dimensional"):
        Traffic([make_law("lin")]).scene(collate([flat]))
