"""What was typed into SUMO and JuPedSim is found again in what they simulate.

The scenes have no noise. SUMO writes nine decimals: places are rounded by 5e-10 m at most, by
2.9e-10 m in the mean square, and so is what a first state or a leader is off. JuPedSim writes
whole numbers of 64 bits.
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

#: m: rounding of what is compared, and of where both began.
ROUNDED = 1e-9
#: A law that is the program's own follows from such paths to this relative error: 0.1 m of
#: independent errors leave 0.3 % at most of any parameter that is identified, rounding a share of
#: 3e-9 of that. The search ends a little before.
SAME = 1e-9
#: Standard errors. Of 1000 normal numbers one is farther away than 3.3.
FAR = 3.3


@cache
def recovered(name: str) -> Recovered:
    return recovery.recovered(name)


def check(result: Recovered, unknown: set[str], same: float = SAME) -> None:
    """All but the unknown are found, and said to be; intervals hold what was typed in."""
    parameters = result.parameters
    assert set(parameters.index[~parameters["identified"]]) == unknown
    identified = parameters[parameters["identified"]]
    assert (identified["off"] < same).all()
    score = (identified["measured"] - identified["typed"]) / (identified["half"] / NORMAL)
    assert (score.abs() < FAR).all()


@pytest.mark.parametrize("name", ["idm_euler", "idm_ballistic_rest", "krauss_crawl"])
def test_sumo_s_laws_are_the_same_to_the_last_decimal(sumo: Path, name: str) -> None:
    result = recovered(name)
    assert result.forward < ROUNDED
    assert result.worst < 3 * ROUNDED
    check(result, set())


def test_a_speed_that_nobody_reaches_is_not_identified(sumo: Path) -> None:
    result = recovered("krauss_moving")
    assert result.forward < ROUNDED
    check(result, {"v0"})
    assert np.isinf(result.parameters.loc["v0", "half"])


def test_the_field_s_idm_differs_from_sumo_s_where_a_ballistic_step_ends_at_rest(
    sumo: Path,
) -> None:
    # SUMO drives v dt/2 in it, here it is v²/(2 A): at most A dt²/8 less, A being what they brake
    # with, b at most as they come to rest; and each of seven stops behind the one ahead
    result = recovered("idm_ballistic")
    once = result.parameters.loc["b", "typed"] * 0.1**2 / 8
    assert ROUNDED < result.worst < 7 * once
    # what 1 mm does: a hundredth of 0.1 m, which leave 0.3 %
    check(result, set(), same=3e-5)


def test_the_field_s_krauss_differs_from_sumo_s_in_the_last_metre_behind_who_stands(
    sumo: Path,
) -> None:
    # there SUMO drives at b dt until a centimetre is left, here the gap shrinks at its own rate
    # 1/T: at most the stretch itself, b dt (1 s)
    result = recovered("krauss_stopping")
    stretch = result.parameters.loc["b", "typed"] * 0.1
    assert 1e-3 < result.worst < stretch
    assert (result.parameters["off"] < 0.01).all()


def test_sumo_s_krauss_in_ballistic_steps_is_a_formula(sumo: Path) -> None:
    result = recovered("krauss_ballistic")
    assert result.worst < 1e-4  # as they start: a hundredth of a millimetre
    check(result, set(), same=1e-6)


def test_jupedsim_s_social_force_is_the_same(jupedsim: ModuleType) -> None:
    result = recovered("force_contact")
    assert result.worst < 1e-12
    check(result, set())


def test_forces_of_contact_are_not_identified_where_nobody_touches(jupedsim: ModuleType) -> None:
    result = recovered("force_default")
    assert result.worst < 1e-12
    check(result, {"k", "kappa"})


def test_jupedsim_s_collision_free_speeds_are_the_same(jupedsim: ModuleType) -> None:
    result = recovered("collision_free")
    # directions here have 1e-6 m and 1e-12 added within their lengths
    assert result.worst < 1e-9
    # with errors of measurement the cost has many minima, and intervals are those of one of them
    assert result.parameters["identified"].all()
    assert (result.parameters["off"] < SAME).all()


def test_jupedsim_s_centrifugal_force_is_the_same_but_for_who_stands(jupedsim: ModuleType) -> None:
    # the ellipse of somebody at 3 mm/s turns with any rounding: 1e-7 m become millimetres
    result = recovered("centrifugal")
    assert result.forward < 0.01
    assert result.parameters["identified"].all()
    assert (result.parameters["off"] < 0.01).all()
