"""The filter of residuals: it takes out the memory that was put in, and nothing else."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from nnode.diagnosis.lanes.whitening import PlatoonFilter

OWN, AHEAD, SCALE = 0.7, 0.25, 0.1


def remembering(samples: int, platoons: int, vehicles: int) -> torch.Tensor:
    """``(K, B, N)``: e_i(t) = OWN e_i(t-1) + AHEAD e_{i+1}(t-1) + noise; leaders have none."""
    rng = np.random.default_rng(4)
    e = np.zeros((samples, platoons, vehicles))
    for t in range(1, samples):
        noise = SCALE * rng.normal(size=(platoons, vehicles - 1))
        e[t, :, :-1] = OWN * e[t - 1, :, :-1] + AHEAD * e[t - 1, :, 1:] + noise
    return torch.from_numpy(e)


def followers(residual: torch.Tensor) -> torch.Tensor:
    valid = torch.ones(residual.shape, dtype=torch.bool)
    valid[..., -1] = False
    return valid


def test_memory_along_time_and_along_the_platoon_is_found_and_taken_out() -> None:
    e = remembering(400, 30, 4)
    seen = followers(e)
    found = PlatoonFilter.fitted(e, seen, 1)
    assert found.past == pytest.approx([OWN], abs=0.03)
    assert found.ahead == pytest.approx([0.0, AHEAD], abs=0.03)
    assert found.scale == pytest.approx(SCALE, rel=0.03)
    white = found(e)
    assert float(white[seen].square().mean()) == pytest.approx(1.0)
    again = float((white[1:][seen[1:]] * white[:-1][seen[1:]]).mean())
    assert abs(again) < 0.03


def test_a_filter_by_hand() -> None:
    e = torch.tensor([[[1.0, 4.0]], [[2.0, 8.0]]], dtype=torch.float64)
    found = PlatoonFilter(np.array([0.5]), np.array([0.25, 0.125]), 2.0)(e)
    # nothing before the first sample, nobody ahead of the second vehicle
    assert found[0, 0].tolist() == [(1 - 0.25 * 4) / 2, 4 / 2]
    assert found[1, 0].tolist() == [(2 - 0.5 * 1 - 0.25 * 8 - 0.125 * 4) / 2, (8 - 0.5 * 4) / 2]


def test_no_filter_only_scales() -> None:
    e = remembering(5, 2, 3)
    assert torch.equal(PlatoonFilter.none(4.0)(e), e / 4)
