"""Parameters of SUMO and JuPedSim are recovered from their simulations without noise.

SUMO writes nine decimals: the rounding error of positions, initial states and leaders is at most
5e-10 m, and 2.9e-10 m in the root mean square. JuPedSim writes 64-bit numbers.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

from benchmarks.discovery import recovery
from benchmarks.discovery.recovery import NORMAL, Recovered

pytestmark = pytest.mark.slow

#: Rounding errors of compared positions and of initial states (m).
ROUNDED = 1e-9
#: Relative error of parameters if the laws are identical. Independent errors of 0.1 m change
#: identified parameters by at most 0.3 %, and rounding errors are 3e-9 of that. The search stops
#: slightly earlier.
SAME = 1e-9
#: Bound of standardised errors, which one of 1000 normal numbers exceeds.
MAX_Z = 3.3


@cache
def recovered(name: str) -> Recovered:
    return recovery.recovered(name)


def check(result: Recovered, unknown: set[str], same: float = SAME) -> None:
    """All parameters but the unknown ones are identified, exact, and within their intervals."""
    parameters = result.parameters
    assert set(parameters.index[~parameters["identified"]]) == unknown
    identified = parameters[parameters["identified"]]
    assert (identified["off"] < same).all()
    z = (identified["measured"] - identified["typed"]) / (identified["half"] / NORMAL)
    assert (z.abs() < MAX_Z).all()


@pytest.mark.parametrize("name", ["idm_euler", "idm_ballistic_rest", "krauss_crawl"])
def test_sumo_laws_are_identical(sumo: Path, name: str) -> None:
    result = recovered(name)
    assert result.forward < ROUNDED
    assert result.worst < 3 * ROUNDED
    check(result, set())


def test_speed_that_is_not_reached_is_not_identified(sumo: Path) -> None:
    result = recovered("krauss_moving")
    assert result.forward < ROUNDED
    check(result, {"v0"})
    assert np.isinf(result.parameters.loc["v0", "half"])


def test_idm_differs_from_sumo_where_a_ballistic_step_ends_at_rest(sumo: Path) -> None:
    # Such a step has the length v dt/2 in SUMO and v²/(2 b) here. The difference is at most b dt²/8
    # for each of seven vehicles.
    result = recovered("idm_ballistic")
    difference = result.parameters.loc["b", "typed"] * 0.1**2 / 8
    assert ROUNDED < result.worst < 7 * difference
    # 0.1 m causes 0.3 %, and the difference is about 1 mm
    check(result, set(), same=3e-5)


def test_krauss_law_differs_from_sumo_behind_a_standing_vehicle(sumo: Path) -> None:
    # In the last metre SUMO drives at b dt. Here the gap decays at the rate 1/T. The difference is
    # at most b dt (1 s).
    result = recovered("krauss_stopping")
    assert 1e-3 < result.worst < result.parameters.loc["b", "typed"] * 0.1
    assert (result.parameters["off"] < 0.01).all()


def test_sumo_krauss_law_with_ballistic_steps(sumo: Path) -> None:
    result = recovered("krauss_ballistic")
    assert result.worst < 1e-4  # at the start
    check(result, set(), same=1e-6)


def test_jupedsim_social_force_is_identical(jupedsim: ModuleType) -> None:
    result = recovered("force_contact")
    assert result.worst < 1e-12
    check(result, set())


def test_contact_forces_are_not_identified_without_contact(jupedsim: ModuleType) -> None:
    result = recovered("force_default")
    assert result.worst < 1e-12
    check(result, {"k", "kappa"})


def test_jupedsim_collision_free_speed_is_identical(jupedsim: ModuleType) -> None:
    result = recovered("collision_free")
    # lengths of directions are regularised by 1e-6 m and 1e-12 here
    assert result.worst < 1e-9
    # with measurement errors the cost has many minima; the intervals belong to one of them
    assert result.parameters["identified"].all()
    assert (result.parameters["off"] < SAME).all()


def test_jupedsim_centrifugal_force_agrees_except_at_rest(jupedsim: ModuleType) -> None:
    # rounding turns the ellipse of a person at 3 mm/s, so that 1e-7 m grow to millimetres
    result = recovered("centrifugal")
    assert result.forward < 0.01
    assert result.parameters["identified"].all()
    assert (result.parameters["off"] < 0.01).all()
