"""What the variance of numbers belongs to, on numbers whose components are known."""

from __future__ import annotations

import numpy as np
import pytest

from nnode.diagnosis.statistics.variance_components import Curve, PeriodEstimates, shares

SEQUENCES, AGENTS, PARTS, STEP, LASTS, NOISE = 10, 6, 12, 2.0, 4.0, 0.02
#: Standard deviations of what belongs to recordings, sequences, agents, and moods of 4 s.
Components = tuple[float, float, float, float]


def seen(sd: Components, seed: int, recordings: int = 8) -> PeriodEstimates:
    """Numbers of agents in twelve parts of their time."""
    rng = np.random.default_rng(seed)
    number = recordings * SEQUENCES * AGENTS
    agent = np.repeat(np.arange(number), PARTS)
    sequence = agent // AGENTS
    recording = sequence // SEQUENCES
    keep = np.exp(-STEP / LASTS)
    mood = [rng.normal(size=number)]
    for _ in range(PARTS - 1):
        mood.append(keep * mood[-1] + np.sqrt(1 - keep**2) * rng.normal(size=number))
    value = NOISE * rng.normal(size=len(agent)) + sd[3] * np.stack(mood, 1).ravel()
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


def shared_out(one: PeriodEstimates) -> dict[str, float | None]:
    curve = Curve.of(one)
    assert curve is not None
    own, mood, _ = curve.fitted(curve.same, curve.between)
    return shares(one, curve, own, mood)


@pytest.mark.thorough
@pytest.mark.parametrize("sd", [(0.03, 0.05, 0.04, 0.03), (0.05, 0.03, 0.03, 0.04)])
def test_variance_is_told_apart_by_what_it_belongs_to(sd: Components) -> None:
    true = np.array(sd) ** 2 / np.sum(np.array(sd) ** 2)
    found = [shared_out(seen(sd, seed)) for seed in range(20)]
    assert list(found[0]) == ["recording", "sequence", "agent", "mood"]
    each = np.array([list(one.values()) for one in found], float)
    np.testing.assert_allclose(each.sum(1), 1.0)
    # what they are off by in the mean is less than what chance does to one of them
    assert (np.abs(each.mean(0) - true) < each.std(0, ddof=1)).all()
    assert each.std(0, ddof=1).max() < 0.15


@pytest.mark.parametrize("only", range(4))
def test_variance_of_one_kind_is_no_other(only: int) -> None:
    sd = [0.0, 0.0, 0.0, 0.0]
    sd[only] = 0.05
    found = [shared_out(seen((sd[0], sd[1], sd[2], sd[3]), seed)) for seed in range(5)]
    each = np.array([list(one.values()) for one in found], float).mean(0)
    assert int(each.argmax()) == only
    assert each[only] > 0.85


def test_one_recording_has_nothing_to_be_compared_with() -> None:
    found = shared_out(seen((0.0, 0.05, 0.05, 0.0), 0, recordings=1))
    assert found["recording"] is None
    assert found["sequence"] == pytest.approx(0.5, abs=0.25)


def test_an_agent_s_own_is_what_does_not_fall_with_the_lag() -> None:
    found = []
    for seed in range(10):
        curve = Curve.of(seen((0.0, 0.0, 0.04, 0.05), seed))
        assert curve is not None
        # twelve parts: lags of one step up to the sixth, and wider ones
        assert curve.lags[:6] == pytest.approx([2.0, 4.0, 6.0, 8.0, 10.0, 12.0])
        assert curve.lags[-1] <= 22.0 + 1e-6
        found.append(curve.fitted(curve.same, curve.between))
    error = np.std(found, 0, ddof=1) / np.sqrt(len(found))
    own, mood, tau = (np.mean(found, 0) - (0.04**2, 0.05**2, LASTS)) / error
    assert max(abs(own), abs(mood), abs(tau)) < 3


def test_two_lags_tell_no_fall_from_a_constant() -> None:
    one = seen((0.0, 0.0, 0.05, 0.0), 0)
    early = one.time % 1000 <= 2 * STEP
    parts = {name: value[early] for name, value in vars(one).items()}
    assert Curve.of(PeriodEstimates(**parts)) is None
