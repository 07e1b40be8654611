"""The error of smoothed leader speeds."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.data.paths import smooth
from nnode.data.sequence import Sequence
from nnode.population.followers import LEADER_ERROR, drivers_differ, leader_error
from tests.diagnosis.platoons import lin, platoons

SEED = 4
#: Samples to leave out at both ends, where errors are larger.
ENDS = 10


def measured(noise: float, samples: int | None = None) -> list[Sequence]:
    sequences = platoons(number=6, seconds=30.0, noise=noise, seed=SEED)
    return [s if samples is None else s.part(0.0, samples / s.n_samples) for s in sequences]


@pytest.mark.parametrize("noise", [0.1, 0.5])
def test_leader_error_is_the_relative_error_of_smoothed_speeds(noise: float) -> None:
    errors, variations = [], []
    for s, true in zip(measured(noise), measured(0.0), strict=True):
        speed = np.gradient(smooth(s.x[..., 0]), s.dt, axis=0)
        error = speed - np.gradient(true.x[..., 0], s.dt, axis=0)
        errors.append(error[ENDS:-ENDS].std())
        variations.append(speed.std(0).mean())
    expected = np.median(errors) / np.median(variations)
    assert leader_error(measured(noise)) == pytest.approx(expected, rel=0.2)


def test_random_effects_need_a_small_and_known_leader_error() -> None:
    assert leader_error(measured(0.0)) == 0.0
    assert drivers_differ(lin(), measured(0.0))
    assert drivers_differ(lin(), measured(0.5))
    assert leader_error(measured(5.0)) > LEADER_ERROR
    assert not drivers_differ(lin(), measured(5.0))
    assert np.isnan(leader_error(measured(0.5, samples=4)))
    assert not drivers_differ(lin(), measured(0.5, samples=4))
