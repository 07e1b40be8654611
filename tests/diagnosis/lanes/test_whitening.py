"""The filter of residuals."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnode.diagnosis.lanes.whitening import PlatoonFilter

PAST, AHEAD, SCALE = 0.7, 0.25, 0.1


def autoregression(samples: int, platoons: int, vehicles: int) -> torch.Tensor:
    """``(K, B, N)``: e_i(t) = PAST e_i(t-1) + AHEAD e_{i+1}(t-1) + noise; leaders have none."""
    rng = np.random.default_rng(4)
    e = np.zeros((samples, platoons, vehicles))
    for t in range(1, samples):
        noise = SCALE * rng.normal(size=(platoons, vehicles - 1))
        e[t, :, :-1] = PAST * e[t - 1, :, :-1] + AHEAD * e[t - 1, :, 1:] + noise
    return torch.from_numpy(e)


def test_fitted_filter_removes_autocorrelation() -> None:
    e = autoregression(400, 30, 4)
    follower = torch.ones(e.shape, dtype=torch.bool)
    follower[..., -1] = False
    fitted = PlatoonFilter.fitted(e, follower, 1)
    assert fitted.past == pytest.approx([PAST], abs=0.03)
    assert fitted.ahead == pytest.approx([0.0, AHEAD], abs=0.03)
    assert fitted.scale == pytest.approx(SCALE, rel=0.03)
    white = fitted(e)
    assert float(white[follower].square().mean()) == pytest.approx(1.0)
    later = follower[1:]
    assert abs(float((white[1:][later] * white[:-1][later]).mean())) < 0.03


def test_filter_with_given_coefficients() -> None:
    e = torch.tensor([[[1.0, 4.0]], [[2.0, 8.0]]], dtype=torch.float64)
    white = PlatoonFilter(np.array([0.5]), np.array([0.25, 0.125]), 2.0)(e)
    # the first sample has no past, the second vehicle no leader
    assert white[0, 0].tolist() == [(1 - 0.25 * 4) / 2, 4 / 2]
    assert white[1, 0].tolist() == [(2 - 0.5 * 1 - 0.25 * 8 - 0.125 * 4) / 2, (8 - 0.5 * 4) / 2]


def test_empty_filter_only_scales() -> None:
    e = autoregression(5, 2, 3)
    assert torch.equal(PlatoonFilter.none(4.0)(e), e / 4)
