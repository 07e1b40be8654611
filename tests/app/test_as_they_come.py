"""Data as they come: how a table is written down, and where its origin lies, changes no result."""

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


#: Name to what changes, and the options that go with it.
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
    # in the order of the names before, so that clusters are drawn alike
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


def fitted(given: nnode.Sequences) -> pd.DataFrame:
    result: pd.DataFrame = nnode.Calibrator("idm", epochs=6, drivers="none").fit(given).parameters_
    return result


@pytest.fixture(scope="module")
def platoons() -> pd.DataFrame:
    return table(platoons=3, seconds=6.0)


@pytest.fixture(scope="module")
def expected(platoons: pd.DataFrame) -> pd.DataFrame:
    return fitted(nnode.sequences(platoons))


@pytest.mark.thorough
@pytest.mark.parametrize("form", FORMS)
def test_a_fit_does_not_depend_on_how_the_table_is_written(
    platoons: pd.DataFrame, expected: pd.DataFrame, form: str
) -> None:
    change, options = FORMS[form]
    result = fitted(nnode.sequences(change(platoons), **options))
    # at a map's coordinates positions have lost the digits below 1e-9 m
    np.testing.assert_allclose(result.estimate, expected.estimate, rtol=1e-5)


def test_samples_that_are_missing_or_late_hardly_change_a_fit(
    platoons: pd.DataFrame, expected: pd.DataFrame
) -> None:
    """2 % of the rows are missing; times jitter by up to 0.01 s, and positions with them."""
    rng = np.random.default_rng(8)
    lacking = platoons[rng.random(len(platoons)) > 0.02]
    given = nnode.sequences(lacking)
    assert sum(s.filled for s in given) > 0
    result = fitted(given)
    parts = []
    for _, own in platoons.groupby(["sequence", "agent"]):
        late = np.where(own.time.between(0.2, 5.8), rng.uniform(-0.01, 0.01, len(own)), 0.0)
        path = CubicSpline(own.time, own.x)
        parts.append(own.assign(time=own.time + late, x=path(own.time + late)))
    jitter = pd.concat(parts)
    given = nnode.sequences(jitter)
    assert "times are uneven" in given.manifest["notes"][0]
    for one in (result, fitted(given)):
        for name in ("idm.T", "idm.s0"):
            assert one.estimate[name] == pytest.approx(expected.estimate[name], rel=0.1)


def moved_people(s: Sequence, by: Callable[[np.ndarray], np.ndarray]) -> Sequence:
    """Positions, destinations and velocities under a motion of the plane."""
    assert s.v is not None
    assert s.destination is not None
    origin = by(np.zeros(2))
    return replace(s, x=by(s.x), v=by(s.v) - origin, destination=by(s.destination))


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
    # in another order of names as well
    "under other names": lambda s: replace(
        s, agents=tuple(f"no. {9 - i}" for i in range(s.n_agents))
    ),
    "in another order": reversed_people,
}


@pytest.mark.parametrize("form", PEOPLE)
def test_the_social_force_does_not_depend_on_where_people_walk(form: str) -> None:
    start = {**model_options("sf"), "A": 0.4, "k": 35.0, "kappa": 11.0}
    people = [PEOPLE[form](crowd(seed)) for seed in range(4)]
    fitted = nnode.Calibrator(start, optimizer="gauss_newton").fit(people)
    np.testing.assert_allclose(fitted.parameters_.estimate, TRUTH, rtol=1e-3)
    assert list(fitted.parameters_.unit) == ["N", "kg/s²", "kg/(m s)"]
    assert {"x", "y", "vx", "vy"} <= set(fitted.predict(people).to_dataframe())
