"""Compiled simulations of followers behind measured paths, against formulas in NumPy."""

from __future__ import annotations

import numpy as np
import pytest

import nnode
from benchmarks.drivers import platoons
from nnode.model import Traffic, make_law
from nnode.model.effects import CATALOGUE
from nnode.population.followers import Followers, paths_of
from nnode.simulation.kernels.followers import WIDTH


@pytest.mark.parametrize(
    ("law", "effects", "step"),
    [
        ("lin", {}, 0.4),  # two sampling intervals per step
        ("idm", {"speed_zone": {}, "multi_anticipation": {}}, 0.2),
        ("gipps", {}, 0.05),  # four steps per sampling interval
        ("lin", {"inertia": {"tau_v": 0.5}}, 0.2),  # a state that starts at a rate
        ("lin", {"reaction_delay": {"T": 0.5}}, 0.2),
    ],
)
def test_compiled_simulation_equals_formulas(
    law: str, effects: dict[str, dict[str, float]], step: float
) -> None:
    table = platoons("lin", "none", 0.1, 1, number=4, vehicles=4)
    terms = [
        make_law(law),
        *(CATALOGUE.effects[name](**values) for name, values in effects.items()),
    ]
    model = Followers(
        Traffic(terms, leader="measured").double(), paths_of(list(nnode.sequences(table)), step)
    )
    followers, rng = len(model.paths.agent), np.random.default_rng(2)
    runs = WIDTH // followers + 1  # more than one block
    theta = model.start[:, None] + 0.01 * rng.normal(size=(runs, len(model.names), followers))
    start = 0.1 * rng.normal(size=(runs, model.starts, followers))
    push = 0.05 * rng.normal(size=(len(model.paths.ahead), followers))
    compiled = model.simulate(theta, start, push)
    formulas = model.simulate(theta, start, lambda at, *_: push[at])
    moved = compiled[1:, 0] - compiled[:-1, 0]
    stable = (np.abs(formulas) < 1e4).all((0, 1))  # runs that diverge amplify rounding errors
    assert stable.mean() > 0.5
    assert np.ptp(moved[..., stable]) > 1.0
    np.testing.assert_allclose(compiled[..., stable], formulas[..., stable], rtol=1e-9, atol=1e-9)
    assert ((np.abs(compiled) < 1e4).all((0, 1)) == stable).all()
    alone = model.simulate(theta[1:2], start[1:2], push)
    assert (alone[..., stable[1:2]] == compiled[:, :, 1:2][..., stable[1:2]]).all()
