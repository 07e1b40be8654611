"""Smooth paths of people, and the windows that they are cut into."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from nnode.data.sequence import Sequence
from nnode.diagnosis.crowds.paths import Smoother
from nnode.diagnosis.crowds.windows import Windows
from nnode.errors import DataError
from tests.builders import people


def track(x: np.ndarray, name: str = "r/0", dt: float = 0.1) -> Sequence:
    return people(x, dt, name=name)


def test_the_noise_is_recognised_and_smoothed_away() -> None:
    t = 0.1 * np.arange(60)[:, None]
    phase = np.arange(12)
    true = np.stack([1.3 * t + 0.3 * np.sin(t + phase), 0.2 * np.cos(1.5 * t + phase)], -1)
    draw = np.random.default_rng(1)
    items = [track(true + 0.02 * draw.normal(size=true.shape), f"r/{i}") for i in range(4)]
    smoother = Smoother(items)
    assert np.sqrt(smoother.variance) == pytest.approx(0.02, rel=0.05)
    path = smoother.path(items[0], t[:, 0])
    assert np.sqrt(((path.x - true) ** 2).mean()) < 0.01
    speed = np.gradient(true, 0.1, axis=0, edge_order=2)
    assert np.sqrt(((path.v - speed)[5:-5] ** 2).mean()) < 0.05


def test_a_parabola_is_kept_as_it_is() -> None:
    t = 0.2 * np.arange(500)
    x = np.stack([1.0 + t - 0.01 * t**2, 0.3 * t], -1)[:, None]
    # so long that it is smoothed in pieces
    path = Smoother([track(x, dt=0.2)]).path(track(x, dt=0.2), t + 0.05)
    late = t + 0.05
    np.testing.assert_allclose(path.x[:-1, 0, 0], (1 + late - 0.01 * late**2)[:-1], atol=1e-8)
    np.testing.assert_allclose(path.v[:-1, 0, 0], (1 - 0.02 * late)[:-1], atol=1e-6)


HOLE = np.zeros((9, 1, 2))
HOLE[4] = np.nan


@pytest.mark.parametrize(
    ("prepare", "x", "message"),
    [
        (Smoother, np.zeros((3, 1, 2)), "at least 4"),
        (Smoother, HOLE, "no numbers"),
        (Windows, np.zeros((4, 2, 2)), "longer sequences"),
    ],
)
def test_unusable_sequences_are_refused(
    prepare: Callable[[list[Sequence]], object], x: np.ndarray, message: str
) -> None:
    with pytest.raises(DataError, match=message):
        prepare([track(x)])


def test_windows_share_the_sequence_and_leave_no_two_samples_in_common() -> None:
    x = np.zeros((100, 3, 2)) + np.arange(100)[:, None, None]
    short = track(x[:4], "r/short")
    windows = Windows([track(x), short], window=1.5)
    assert windows.length == 15
    assert windows.used == [0]
    assert windows.measured.shape == (15, 6, 3, 2)
    # ten samples are too many for six windows: five are left out at each end
    np.testing.assert_array_equal(windows.measured[:, :, 0, 0].T.ravel(), np.arange(5, 95))
    assert windows.batch.start.tolist() == pytest.approx([0.5 + 1.5 * w for w in range(6)])


def test_fast_cameras_are_thinned_out_and_slow_ones_simulated_in_steps() -> None:
    fast = Windows([track(np.zeros((100, 2, 2)), dt=0.04)])
    assert (fast.length, fast.sub, fast.step) == (19, 1, 0.08)
    slow = Windows([track(np.zeros((30, 2, 2)), dt=0.25)])
    assert (slow.length, slow.sub, slow.step) == (6, 2, 0.125)


def test_one_long_sequence_leaves_no_short_ones_out() -> None:
    short = [track(np.zeros((8, 2, 2)), f"r/{i}") for i in range(10)]
    windows = Windows([*short, track(np.zeros((40, 2, 2)), "r/long")])
    assert windows.length == 8
    assert windows.used == list(range(11))
