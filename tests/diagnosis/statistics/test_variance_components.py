"""Components of the variance of estimates, on made data."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.diagnosis.statistics.variance_components import Curve, PeriodEstimates, shares

SEQUENCES, AGENTS, PARTS, STEP, LASTS, NOISE = 10, 6, 12, 2.0, 4.0, 0.02
#: Standard deviations of recordings, sequences, agents and transient deviations of 4 s.
Components = tuple[float, float, float, float]


def estimates(sd: Components, seed: int, recordings: int = 8) -> PeriodEstimates:
    """Estimates of agents in twelve parts of their time."""
    rng = np.random.default_rng(seed)
    number = recordings * SEQUENCES * AGENTS
    agent = np.repeat(np.arange(number), PARTS)
    sequence = agent // AGENTS
    recording = sequence // SEQUENCES
    keep = np.exp(-STEP / LASTS)
    transient = [rng.normal(size=number)]
    for _ in range(PARTS - 1):
        transient.append(keep * transient[-1] + np.sqrt(1 - keep**2) * rng.normal(size=number))
    value = NOISE * rng.normal(size=len(agent)) + sd[3] * np.stack(transient, 1).ravel()
    for size, label in zip(sd, (recording, sequence, agent), strict=False):
        value += size * rng.normal(size=int(label.max()) + 1)[label]
    return PeriodEstimates(
        agent=agent,
        sequence=sequence,
        cluster=sequence,
        recording=recording,
        time=1000.0 * sequence + STEP * np.tile(np.arange(PARTS), number),
        value=value[:, None],
        info=np.full(len(agent), NOISE**-2),
    )


def shares_of(sd: Components, seed: int, recordings: int = 8) -> dict[str, float | None]:
    periods = estimates(sd, seed, recordings)
    curve = Curve.of(periods)
    assert curve is not None
    persistent, transient, _ = curve.fitted(curve.same, curve.between)
    return shares(periods, curve, persistent, transient)


@pytest.mark.thorough
@pytest.mark.parametrize("sd", [(0.03, 0.05, 0.04, 0.03), (0.05, 0.03, 0.03, 0.04)])
def test_shares_of_all_components(sd: Components) -> None:
    true = np.array(sd) ** 2 / np.sum(np.array(sd) ** 2)
    by_seed = [shares_of(sd, seed) for seed in range(20)]
    assert list(by_seed[0]) == ["recording", "sequence", "agent", "transient"]
    values = np.array([list(share.values()) for share in by_seed], float)
    np.testing.assert_allclose(values.sum(1), 1.0)
    # the bias is smaller than the standard error
    assert (np.abs(values.mean(0) - true) < values.std(0, ddof=1)).all()
    assert values.std(0, ddof=1).max() < 0.15


@pytest.mark.parametrize("only", range(4))
def test_shares_of_one_component(only: int) -> None:
    sd = [0.0, 0.0, 0.0, 0.0]
    sd[only] = 0.05
    by_seed = [shares_of((sd[0], sd[1], sd[2], sd[3]), seed) for seed in range(5)]
    mean = np.array([list(share.values()) for share in by_seed], float).mean(0)
    assert int(mean.argmax()) == only
    assert mean[only] > 0.85


def test_one_recording_has_no_share() -> None:
    share = shares_of((0.0, 0.05, 0.05, 0.0), 0, recordings=1)
    assert share["recording"] is None
    assert share["sequence"] == pytest.approx(0.5, abs=0.25)


def test_covariance_by_lag() -> None:
    """The agents' own variance is the part of the covariance that does not fall with the lag."""
    fits = []
    for seed in range(10):
        curve = Curve.of(estimates((0.0, 0.0, 0.04, 0.05), seed))
        assert curve is not None
        # twelve parts: lags of one step up to the sixth, and wider ones
        assert curve.lags[:6] == pytest.approx([2.0, 4.0, 6.0, 8.0, 10.0, 12.0])
        assert curve.lags[-1] <= 22.0 + 1e-6
        fits.append(curve.fitted(curve.same, curve.between))
    error = np.std(fits, 0, ddof=1) / np.sqrt(len(fits))
    z = (np.mean(fits, 0) - (0.04**2, 0.05**2, LASTS)) / error
    assert np.abs(z).max() < 3


def test_two_lags_are_too_few() -> None:
    periods = estimates((0.0, 0.0, 0.05, 0.0), 0)
    early = periods.time % 1000 <= 2 * STEP
    parts = {name: value[early] for name, value in vars(periods).items()}
    assert Curve.of(PeriodEstimates(**parts)) is None
