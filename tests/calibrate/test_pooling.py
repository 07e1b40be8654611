"""Parameters of each sequence's own: found where drivers differ, refused where out of place."""

from __future__ import annotations

from functools import partial

import numpy as np
import pandas as pd
import pytest

import nnode
from nnode.calibrate.cost import Convention
from nnode.calibrate.options import Pooling
from nnode.calibrate.pooling import SequenceParameters, sequence_parameters
from nnode.calibrate.problem import ResidualProblem
from nnode.data.sequence import Sequence
from nnode.errors import ConfigError
from nnode.simulation import FusedSolver
from tests.app.following import pairs
from tests.calibrate.test_start_speeds import known
from tests.studies.following.test_fit import driven

TIME_GAPS = np.array([1.0, 1.2, 1.4, 1.6, 1.8, 2.0])


def own(kind: Pooling, sequences: list[Sequence]) -> SequenceParameters:
    cost = partial(ResidualProblem, solver=FusedSolver(), convention=Convention.spacing)
    return sequence_parameters(kind, known(), sequences, cost, seed=0)


@pytest.mark.thorough
def test_drivers_who_differ_are_told_apart() -> None:
    found = own(Pooling.alone, driven(time_gaps=TIME_GAPS))
    assert found.table["T"].to_numpy() == pytest.approx(TIME_GAPS, rel=1e-3)
    assert found.table["cluster"].tolist() == [0, 0, 1, 1, 2, 2]
    assert found.facts["cost"] < 1e-3 < 0.1 < found.facts["cost_pool"]
    # without noise a half tells as much as a whole
    assert found.facts["second_half"]["alone"] < 0.01 < found.facts["second_half"]["pooled"]
    assert "shrunk" not in found.facts["second_half"]


@pytest.mark.thorough  # calibrations of every pair, some thirty times
def test_noise_is_shrunk_away() -> None:
    """Drivers who do not differ, measured with errors: their own numbers are errors."""
    rng = np.random.default_rng(1)
    sequences = driven()
    for s in sequences:
        s.x[1:, 0] += 0.5 * rng.standard_normal((300, 1))
    found = own(Pooling.shrunk, sequences).facts
    half = found["second_half"]
    assert half["shrunk"] < half["alone"]
    assert half["pooled"] < half["alone"]
    assert found["strength"] > 0
    assert found["cost"] <= found["cost_pool"]


def test_what_cannot_be_judged_is_refused() -> None:
    with pytest.raises(ConfigError, match="halves"):
        own(Pooling.shrunk, [s.part(0, 0.03) for s in driven()])
    with pytest.raises(ConfigError, match="two clusters"):
        own(Pooling.alone, driven(2))


@pytest.mark.parametrize(
    ("options", "why"),
    [
        ({"model": "a2"}, "no place in a network"),
        ({"model": "idm", "optimizer": "lbfgs"}, "needs optimizer=gauss_newton"),
    ],
)
def test_it_is_refused_where_it_has_no_place(options: dict[str, str], why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        nnode.Calibrator(**options, pooling="alone").fit(pairs(number=2, seconds=3.0))  # type: ignore[arg-type]


def test_people_share_their_parameters() -> None:
    rows = [(0, 0.1 * k, a, 0.1 * k + a, 1.0 * a) for k in range(4) for a in range(2)]
    table = pd.DataFrame(rows, columns=["sequence", "time", "agent", "x", "y"])
    with pytest.raises(ConfigError, match="laws of lanes"):
        nnode.Calibrator("sf", pooling="shrunk", epochs=1).fit(table)
