"""Windows of people that continue each other."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from torch import Tensor

import nnode
from benchmarks.people import LAW, TAU, WALLS, crowds
from nnode.calibrate.parameters import ParameterVector
from nnode.diagnosis.crowds.continuation import GROWN, Continuation, not_grown
from nnode.diagnosis.crowds.people import CrowdPopulation, People
from nnode.diagnosis.crowds.windows import Windows
from nnode.model import Crowd, make_law

#: s; the sequences are as long as a long window, and as four short ones.
LONG, SHORT = 4.0, 1.0


def people_of(window: float, *, walls: bool = True) -> People:
    table = crowds("none", 5, sequences=4, push=0.05)
    measured = nnode.sequences(table[table["time"] % 100 < LONG - 1e-6])
    sequences = [replace(s, walls=WALLS.to_numpy() if walls else None) for s in measured]
    return People(Windows(sequences, window))


def law(**changed: float) -> Crowd:
    return Crowd([make_law("esf", tau=TAU, **(LAW | changed))], desired="exit").double()


def row(system: Crowd) -> Tensor:
    return ParameterVector(system).row[None]


def estimated(window: float, system: Crowd) -> CrowdPopulation:
    people = people_of(window)
    return people.estimated(system, variances=people.initial_variances(["desired_speed", "tau"]))


def own(people: People) -> np.ndarray:
    return np.zeros((len(people.pairs), 0))


def root_mean_square(difference: np.ndarray) -> float:
    return float(np.sqrt(np.mean(difference**2)))


def test_windows_of_a_linear_law_are_one_simulation() -> None:
    """Without walls, and without forces between people."""
    people = [people_of(window, walls=False) for window in (LONG, SHORT)]
    assert [each.windows.number.max() for each in people] == [0, 3]
    windows = [each._linearised(law(A=0.0), [], each.measured) for each in people]
    expected, continued = (
        each._continued(part, own(each), np.ones(len(each.unit)))[0]
        for each, part in zip(people, windows, strict=True)
    )
    assert expected.restart is not None
    assert continued.restart is not None
    np.testing.assert_array_equal(continued.restart, expected.restart)
    np.testing.assert_allclose(continued.residual, expected.residual, atol=1e-4)
    # windows by themselves begin with small residuals
    alone = people[1].joined(windows[1].difference.position)[..., 0]
    assert np.abs(alone - expected.residual).max() > 0.1


def test_start_of_a_later_window_does_not_change_residuals() -> None:
    """The smoothed states at starts have errors, which one window adds and the next one removes."""
    people, system = people_of(SHORT), law()
    batch, first = people.windows.batch, people.windows.number == 0

    def residual() -> np.ndarray:
        windows = people._linearised(system, [], people.measured)
        return people._continued(windows, own(people), np.ones(len(people.unit)))[0].residual

    before = residual()
    by_itself = people.differences(people.states(system, row(system), people.measured)).position
    batch.x[0, ~first] += 0.01
    batch.x[-1, people.windows.number < 3] += 0.01
    moved = people.differences(people.states(system, row(system), people.measured)).position
    change = root_mean_square(residual() - before)
    assert change < 0.1 * root_mean_square(moved - by_itself)


def test_short_windows_are_nearly_as_likely_as_a_long_one() -> None:
    long, short = (estimated(window, law()) for window in (LONG, SHORT))
    # 5,120 samples
    assert short.posterior.loglik == pytest.approx(long.posterior.loglik, abs=60)


def test_continuation_ends_where_changes_grow() -> None:
    rate = 30.0
    end = np.broadcast_to(rate * np.eye(4), (1, 8, 4, 4))
    continues = np.ones((1, 8), dtype=bool)
    continues[:, 0] = False
    kept = not_grown(end, continues)
    at_once = int(np.log(GROWN) / np.log(rate))
    assert kept[0, 1 : at_once + 1].all()
    assert not kept[0, at_once + 1]
    assert kept[0, at_once + 2 :].all()


def test_changes_continue_by_the_response_to_starts() -> None:
    position = np.array([[[[1.0, 0.0, 0.5, 0.0]]] * 3])  # (D, W, K, 4)
    continuation = Continuation(
        position=position,
        end=np.broadcast_to(0.5 * np.eye(4), (1, 3, 4, 4)),
        continues=np.array([[False, True, True]]),
    )
    end = np.zeros((1, 3, 4, 1))
    end[0, 0, 0, 0], end[0, 1, 2, 0] = 2.0, 4.0
    change = continuation(np.zeros((1, 3, 1, 1)), end)
    # the second window starts 2 m ahead, of which the third one keeps a half, with 4 m/s more
    assert change[0, :, 0].tolist() == [0.0, 2.0, 1.0 + 0.5 * 4.0]
