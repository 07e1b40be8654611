"""Number and size of steps, and invalid options of solvers."""

from __future__ import annotations

import pytest
import torch

from nnode.calibrate.cost import sequence_costs
from nnode.data.sequence import collate
from nnode.errors import ConfigError, DataError
from nnode.model import System, Traffic, make_law
from nnode.model.laws import CAR_FOLLOWING_LAWS, law_from
from nnode.model.system import Crowd
from nnode.simulation import TorchdiffeqSolver, substeps
from tests.simulation.scenes import platoon

#: Speeds in a lane, accelerations in a lane, accelerations of people.
LANE, PEOPLE = Traffic([make_law("lin")]), Crowd([make_law("relaxation")])
FOLLOWING = Traffic([law_from("idm", CAR_FOLLOWING_LAWS["idm"])])


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("method", "samples", "sampling", "dt", "evaluations"),
    [
        ("euler", 13, 0.2, 0.01, 240),  # T = 2.4 s
        ("euler", 13, 0.2, 0.002, 1200),
        ("euler", 14, 0.2, 0.2, 13),
        ("euler", 4, 0.2, 0.2 / 3, 9),
        ("euler", 11, 0.1, 0.02, 50),
        ("euler", 8, 0.3, 0.1, 21),
        ("euler", 3, 0.2, None, 200),
        ("midpoint", 13, 0.2, 0.02, 2 * 120),
        ("rk4", 13, 0.2, 0.02, 4 * 120),
    ],
)
def test_number_of_steps(dtype, method, samples, sampling, dt, evaluations) -> None:
    model = Traffic([make_law("lin", v0=15.0)]).to(dtype)
    calls: list[int] = []
    model.register_forward_hook(lambda *_: calls.append(1))
    batch = collate([platoon([20.0], samples=samples, dt=sampling)]).to(dtype=dtype)
    trajectory = TorchdiffeqSolver(method, "adjoint", dt=dt)(model, batch)
    assert len(calls) == evaluations
    sequence_costs(trajectory, batch).sum().backward()
    assert len(calls) == 2 * evaluations  # the adjoint takes as many steps back


@pytest.mark.parametrize(
    ("system", "sampling", "dt", "number"),
    [
        (LANE, 0.2, 0.002, 100),
        (LANE, 0.2, 0.2, 1),
        (LANE, 0.2 + 3e-9, 0.02, 10),  # recorded times carry rounding errors
        (LANE, 0.30000000000000004, 0.1, 3),
        (LANE, 1 / 25, 0.01, 4),
        # without dt, the smallest number of steps that are not above the default
        (LANE, 0.2, None, 100),
        (LANE, 0.1, None, 50),
        (LANE, 0.001, None, 1),
        (LANE, 0.0033, None, 2),
        (FOLLOWING, 0.1, None, 1),
        (FOLLOWING, 0.2, None, 2),
        (PEOPLE, 0.04, None, 1),
        (PEOPLE, 0.0625, None, 1),
        (PEOPLE, 0.1, None, 2),
        (PEOPLE, 0.2, None, 4),
    ],
)
def test_substeps(system: System, sampling: float, dt: float | None, number: int) -> None:
    assert substeps(sampling, dt, system) == number


@pytest.mark.parametrize("dt", [0.0, -0.01, float("nan"), float("inf")])
def test_step_must_be_positive(dt: float) -> None:
    with pytest.raises(ConfigError, match=r"solver\.dt=.*positive"):
        substeps(0.2, dt, LANE)


@pytest.mark.parametrize(("sampling", "dt"), [(0.2, 1e-7), (2e8, 0.1), (2e8, None)])
def test_more_than_a_million_steps(sampling: float, dt: float | None) -> None:
    with pytest.raises(ConfigError, match=r"expected at most 1e\+06; take a larger solver\.dt"):
        substeps(sampling, dt, LANE)
    assert substeps(0.1, 1e-7, LANE) == 10**6


@pytest.mark.parametrize("dt", [0.03, 0.3, 0.19, 0.2001, 1e3])
def test_step_that_does_not_divide_the_sampling_interval(dt: float) -> None:
    with pytest.raises(ConfigError, match="does not divide") as error:
        substeps(0.2, dt, LANE)
    offered = str(error.value).split("use solver.dt=")[1].split(",")[0].split(" or ")
    for value in offered:
        assert substeps(0.2, float(value), LANE) >= 1


def test_single_sample() -> None:
    batch = collate([platoon([20.0], samples=1)])
    with pytest.raises(DataError, match="at least two samples"):
        TorchdiffeqSolver()(Traffic([make_law("lin")]), batch)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"method": "eular"}, r"solver\.method=eular.*euler"),
        ({"gradient": "exact"}, r"solver\.gradient=exact.*adjoint, discrete"),
        ({"method": "scipy_solver", "gradient": "discrete"}, "leaves no graph"),
    ],
)
def test_invalid_options(options: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        TorchdiffeqSolver(**options)
