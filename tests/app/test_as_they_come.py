"""Results do not depend on a table's units, order, names, or origin."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from scipy.interpolate import CubicSpline

import nnode
from nnode.app.python.inputs import model_options
from nnode.data.sequence import Sequence
from tests.app.following import table
from tests.calibrate.test_gauss_newton_people import TRUTH, crowd

Form = Callable[[pd.DataFrame], pd.DataFrame]
STAMP = pd.Timestamp("2024-05-06 07:08:09")


#: Changes of the table, and the options that they need.
FORMS: dict[str, tuple[Form, dict[str, Any]]] = {
    "at map coordinates": (lambda t: t.assign(x=t.x + 5_340_000.0), {}),
    "later": (lambda t: t.assign(time=t.time + 1e6), {}),
    "with dates": (lambda t: t.assign(time=STAMP + pd.to_timedelta(t.time, unit="s")), {}),
    "with clock times": (
        lambda t: t.assign(
            time=[(STAMP + pd.Timedelta(s, "s")).strftime("%H:%M:%S.%f") for s in t.time]
        ),
        {},
    ),
    "in nanoseconds": (
        lambda t: t.assign(time=STAMP.value + (t.time * 1e9).round().astype("int64")),
        {"time_unit": "ns"},
    ),
    # the order of the names is kept, so that the random split is the same
    "renamed": (
        lambda t: t.assign(
            agent="car no. " + t.agent.astype(str), sequence="run " + t.sequence.astype(str)
        ),
        {},
    ),
    "shuffled": (lambda t: t.sample(frac=1.0, random_state=5), {}),
    "in feet": (
        lambda t: t.assign(x=t.x / 0.3048, length=t.length / 0.3048),
        {"position_unit": "ft"},
    ),
    "in frames": (
        lambda t: t.assign(time=(t.time / 0.1).round().astype(int)),
        {"time_unit": "frame", "frame_rate": 10.0},
    ),
}


def fitted(sequences: nnode.Sequences) -> pd.DataFrame:
    result: pd.DataFrame = (
        nnode.Calibrator("idm", epochs=6, drivers="none").fit(sequences).parameters_
    )
    return result


@pytest.fixture(scope="module")
def platoons() -> pd.DataFrame:
    return table(platoons=3, seconds=6.0)


@pytest.fixture(scope="module")
def expected(platoons: pd.DataFrame) -> pd.DataFrame:
    return fitted(nnode.sequences(platoons))


@pytest.mark.thorough
@pytest.mark.parametrize("form", FORMS)
def test_fit_is_independent_of_the_table_s_form(
    platoons: pd.DataFrame, expected: pd.DataFrame, form: str
) -> None:
    change, options = FORMS[form]
    result = fitted(nnode.sequences(change(platoons), **options))
    # map coordinates have a resolution of 1e-9 m
    np.testing.assert_allclose(result.estimate, expected.estimate, rtol=1e-5)


def test_missing_samples_and_jitter_hardly_change_a_fit(
    platoons: pd.DataFrame, expected: pd.DataFrame
) -> None:
    """2 % of the rows are missing, or times jitter by up to 0.01 s."""
    rng = np.random.default_rng(8)
    incomplete = nnode.sequences(platoons[rng.random(len(platoons)) > 0.02])
    assert sum(s.filled for s in incomplete) > 0
    tracks = []
    for _, track in platoons.groupby(["sequence", "agent"]):
        inner = track.time.between(0.2, 5.8)
        time = track.time + np.where(inner, rng.uniform(-0.01, 0.01, len(track)), 0.0)
        tracks.append(track.assign(time=time, x=CubicSpline(track.time, track.x)(time)))
    uneven = nnode.sequences(pd.concat(tracks))
    assert "times are uneven" in uneven.manifest["notes"][0]
    for result in (fitted(incomplete), fitted(uneven)):
        for name in ("idm.T", "idm.s0"):
            assert result.estimate[name] == pytest.approx(expected.estimate[name], rel=0.1)


def moved_people(s: Sequence, motion: Callable[[np.ndarray], np.ndarray]) -> Sequence:
    """Apply a motion of the plane to positions, destinations and velocities."""
    assert s.v is not None
    assert s.destination is not None
    velocity = motion(s.v) - motion(np.zeros(2))
    return replace(s, x=motion(s.x), v=velocity, destination=motion(s.destination))


def reversed_people(s: Sequence) -> Sequence:
    assert s.v is not None
    assert s.destination is not None
    return replace(
        s,
        x=s.x[:, ::-1],
        v=s.v[:, ::-1],
        destination=s.destination[::-1],
        agents=s.agents[::-1],
    )


PEOPLE: dict[str, Callable[[Sequence], Sequence]] = {
    "at map coordinates": lambda s: moved_people(s, lambda x: np.add(x, [7e6, -3e6])),
    "in a mirrored corridor": lambda s: moved_people(s, lambda x: x * [1.0, -1.0]),
    "in a corridor along y": lambda s: moved_people(s, lambda x: x[..., ::-1]),
    "later": lambda s: replace(s, time=s.time + 1e6),
    # the names also have another order
    "under other names": lambda s: replace(
        s, agents=tuple(f"no. {9 - i}" for i in range(s.n_agents))
    ),
    "in another order": reversed_people,
}


@pytest.mark.parametrize("form", PEOPLE)
def test_social_force_is_independent_of_coordinates(form: str) -> None:
    start = {**model_options("sf"), "A": 0.4, "k": 35.0, "kappa": 11.0}
    people = [PEOPLE[form](crowd(seed)) for seed in range(4)]
    fitted = nnode.Calibrator(start, optimizer="gauss_newton").fit(people)
    np.testing.assert_allclose(fitted.parameters_.estimate, TRUTH, rtol=1e-3)
    assert list(fitted.parameters_.unit) == ["N", "kg/s²", "kg/(m s)"]
    assert {"x", "y", "vx", "vy"} <= set(fitted.predict(people).to_dataframe())
