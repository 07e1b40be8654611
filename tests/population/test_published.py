"""Mixed-model estimates against R's nlme 3.1, which uses the same method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from nnode.population.estimate import Estimate, Variances, estimate
from nnode.population.likelihood import Linearised, WhiteNoise

FOLDER = Path(__file__).with_name("data")
#: Relative step of finite differences.
DIFFERENCE = 1e-5

#: Values ``(D, K)`` of a function with parameters ``(P, D, 1)``.
Function = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Curves:
    """The response of curves whose parameters differ between subjects.

    Attributes:
        function: the curves of all subjects.
        y: ``(D, K)`` measurements.
        random: indices of the parameters that differ.
    """

    function: Function
    y: np.ndarray
    random: list[int]

    def __call__(self, theta: np.ndarray, agents: np.ndarray, start: np.ndarray) -> Linearised:
        parameters = np.tile(theta[:, None, None], (1, len(self.y), 1))
        if agents.size:
            parameters[self.random] += agents.T[..., None]
        columns = []
        for p, value in enumerate(theta):
            step = np.zeros((len(theta), 1, 1))
            step[p] = DIFFERENCE * abs(value)
            slope = self.function(parameters + step) - self.function(parameters - step)
            columns.append(slope / (2 * step[p]))
        fixed = np.stack(columns, -1)
        residual = self.y - self.function(parameters)
        if agents.size:
            residual = residual + np.einsum("dkq,dq->dk", fixed[..., self.random], agents)
        return Linearised(
            residual=residual,
            fixed=fixed,
            random=np.array(self.random),
            start=np.zeros((*self.y.shape, 0)),
            observed=np.ones(self.y.shape, dtype=bool),
            agent=np.arange(len(self.y)),
        )


def table(name: str, subject: str) -> tuple[list[str], dict[str, np.ndarray]]:
    """Names of subjects, and the ``(D, K)`` values of each column."""
    data = pd.read_csv(FOLDER / f"{name}.csv", comment="#", dtype={subject: str})
    names = list(dict.fromkeys(data[subject]))
    parts = [data[data[subject] == name] for name in names]
    return names, {
        column: np.stack([part[column].to_numpy(dtype=float) for part in parts])
        for column in data.columns.drop(subject)
    }


def spreads(residual: float, *random: float) -> Variances:
    """Initial standard deviations, with bounds that are a factor of 30 away."""
    start = np.array([residual, *random])
    return Variances(
        noise=np.array([residual]),
        spread=np.array(random),
        start=np.zeros(0),
        low=start / 30,
        high=start * 30,
    )


def errors(result: Estimate) -> np.ndarray:
    """``(P,)`` standard errors of the parameters."""
    return np.sqrt(np.diag(np.linalg.inv(result.marginal.information)))


def test_orange_tree_growth_as_nlme() -> None:
    names, data = table("orange", "Tree")

    def size(parameters: np.ndarray) -> np.ndarray:
        asymptote, middle, scale = parameters
        return np.asarray(asymptote / (1 + np.exp(-(data["age"] - middle) / scale)))

    result = estimate(
        Curves(size, data["circumference"], [0]),
        WhiteNoise(),
        np.array([192.0, 728.0, 350.0]),
        spreads(10.0, 20.0),
        tolerance=1e-7,
    )
    assert result.converged
    # nlme stops when its next step is small relative to the parameters; further steps would
    # change the fifth digit of xmid and scal, and all values that depend on them
    np.testing.assert_allclose(result.theta, [191.0500, 722.5593, 344.1684], rtol=2e-5)
    np.testing.assert_allclose(result.variances.row, [7.846254, 31.48255], rtol=1e-6)
    np.testing.assert_allclose(result.marginal.loglik, -131.584554, atol=3e-5)
    np.testing.assert_allclose(errors(result), [15.4463, 33.6118, 25.9585], rtol=4e-5)
    ranef = {"3": -37.0002, "1": -29.4036, "5": -5.1795, "2": 31.5650, "4": 40.0183}
    expected = [ranef[name] for name in names]
    np.testing.assert_allclose(result.agents[:, 0], expected, atol=4e-4)
    np.testing.assert_allclose(result.marginal.deviations[:, 0], expected, atol=4e-4)


@pytest.mark.parametrize(
    ("restricted", "variances", "loglik"),
    [
        # the constant of the restriction is that of nlme: no term log|X'X|
        (True, [1.3706404, 1.3860379, 0.1492532], -221.6572901),
        (False, [1.3636123, 1.3511790, 0.1463190], -219.8691349),
    ],
)
def test_linear_mixed_model_of_children_as_nlme(
    restricted: bool, variances: list[float], loglik: float
) -> None:
    names, data = table("orthodont", "Subject")

    def line(parameters: np.ndarray) -> np.ndarray:
        return np.asarray(parameters[0] + parameters[1] * data["age"])

    result = estimate(
        Curves(line, data["distance"], [0, 1]),
        WhiteNoise(),
        np.array([10.0, 1.0]),
        spreads(1.0, 1.0, 1.0),
        restricted=restricted,
        tolerance=1e-6,
    )
    assert result.converged
    np.testing.assert_allclose(result.theta, [16.7611111, 0.6601852], rtol=1e-7)
    np.testing.assert_allclose(result.variances.row, variances, rtol=1e-5)
    np.testing.assert_allclose(result.marginal.loglik, loglik, atol=1e-7)
    if restricted:
        np.testing.assert_allclose(errors(result), [0.7137960, 0.0656052], rtol=1e-5)
        np.testing.assert_allclose(
            result.agents[names.index("M16")], [-0.3324690, -0.0553999], rtol=3e-5
        )
