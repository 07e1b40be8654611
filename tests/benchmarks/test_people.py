"""Crowds of people who differ, with hidden effects."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import nnode
from benchmarks.people import (
    HIDDEN,
    LAW,
    PEOPLE,
    SAMPLES,
    TAU,
    WALLS,
    _by_others,
    _by_walls,
    _hidden,
    cases,
    crowds,
    spread_in_streams,
)
from nnode.data.sequence import Batch, collate
from nnode.model import Crowd, make_law
from nnode.model.effects import CATALOGUE
from nnode.model.term import Term


def crowd(*effects: Term) -> Crowd:
    return Crowd([make_law("esf", tau=TAU, **LAW), *effects], desired="exit").double()


def batch() -> Batch:
    sequences = nnode.sequences(crowds("none", 3, sequences=2, push=0.0))
    return collate([replace(s, walls=WALLS.to_numpy()) for s in sequences])


def rates(system: Crowd, batch: Batch, sample: int = 0) -> np.ndarray:
    """``(S, N, 2)`` accelerations at a sample, m/s²."""
    state = torch.cat([batch.x[sample], batch.v[sample]], -1)
    return system(torch.tensor(0.0), state, system.scene(batch))[..., 2:].detach().numpy()


def test_directions_differ_from_those_of_the_streams_of_the_model() -> None:
    turn = 0.15
    table = crowds("none", 4, sequences=6, push=0.1, turn=turn)
    measured = collate(nnode.sequences(table.drop(columns="angle")))
    mean = (measured.x[-1] - measured.x[0]) / (measured.dt * (SAMPLES - 1))
    scene = Crowd([make_law("esf", tau=TAU, **LAW)], desired="direction").scene(
        replace(measured, preferred=mean)
    )
    x, y = (scene.destination - measured.x[0]).numpy().transpose(2, 0, 1)
    first = table.groupby(["sequence", "agent"])["angle"].first().to_numpy().reshape(x.shape)
    # angles are those from the way along the corridor, positive towards growing y
    turned = np.arctan2(y, np.abs(x)) - first
    streams = np.stack([turned[:, x[0] > 0].mean(1), turned[:, x[0] < 0].mean(1)])
    expected = np.sqrt(0.75 * turn**2 + (streams**2).mean())
    assert spread_in_streams(table, turn) == pytest.approx(expected, rel=0.01)
    # pushes and others turn streams
    assert (streams**2).mean() > 0.02**2


@pytest.mark.parametrize("sample", [0, SAMPLES - 1])
def test_law_is_that_of_the_formulas(sample: int) -> None:
    # people who walk along a wall at the end of a sequence meet it there, too
    measured = batch()
    x, v = measured.x[sample].numpy(), measured.v[sample].numpy()
    speed = np.hypot(*np.moveaxis(measured.v[0].numpy(), -1, 0))[..., None]
    way = measured.destination.numpy() - x
    drive = (speed * way / np.hypot(*np.moveaxis(way, -1, 0))[..., None] - v) / TAU
    expected = drive + _by_others(x, v) + _by_walls(x)
    np.testing.assert_allclose(rates(crowd(), measured, sample), expected, atol=1e-6)
    assert np.abs(_by_others(x, v)).max() > 0.1


@pytest.mark.parametrize("name", HIDDEN)
def test_hidden_accelerations_are_those_of_the_catalogue(name: str) -> None:
    start, (size, value, settings) = batch(), HIDDEN[name]
    effect = CATALOGUE.effects[name](**{size: value}, **settings)
    added = rates(crowd(effect), start) - rates(crowd(), start)
    np.testing.assert_allclose(
        _hidden(name)(start.x[0].numpy(), start.v[0].numpy()), added, atol=1e-6
    )
    assert np.abs(added).max() > 0.01


def test_people_differ_and_pushes_last() -> None:
    plain, pushed = (crowds("none", 5, spread=0.0, push=push, sequences=3) for push in (0.0, 0.2))
    assert len(plain) == 3 * PEOPLE * SAMPLES
    moved = (pushed[["x", "y"]] - plain[["x", "y"]]).to_numpy()
    assert np.abs(moved).max() > 0.1
    alone = crowds("none", 5, spread=0.15, push=0.0, sequences=3)
    assert np.abs(alone["x"] - plain["x"]).max() > 0.3
    assert crowds("none", 5, sequences=3).equals(crowds("none", 5, sequences=3))


def test_cases_of_a_run_are_fixed_by_its_seed() -> None:
    chosen = cases(7, 4, spread=0.1)
    assert [case["effect"] for case in chosen] == ["none", "alignment", "none", "density_slowdown"]
    assert [case["seed"] for case in chosen] == [7, 8, 9, 10]
    assert [case["effect"] for case in cases(1, 3, ["drift"])] == ["drift"] * 3
    assert {case["effect"] for case in cases(1, 3, ["drift"], nothing=True)} == {"none"}
