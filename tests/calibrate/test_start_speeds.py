"""First speeds as a nuisance: fitted where they are wrong, and derivatives of what is left."""

from __future__ import annotations

import numpy as np
import pytest
import torch

import nnode
from nnode.calibrate.cost import Convention
from nnode.calibrate.gauss_newton.method import TangentCost, pooled
from nnode.calibrate.gauss_newton.start_speeds import StartSpeedCost
from nnode.data.sequence import Batch, Sequence, collate
from nnode.data.smooth import start_smoothed
from nnode.errors import ConfigError
from nnode.models import System
from nnode.solvers import FusedSolver
from nnode.study.following.candidates import EVERY
from tests.app.following import pairs
from tests.study.following.test_fit import HELLY, driven


def known(name: str = "helly") -> System:
    system = EVERY[name].system()
    with torch.no_grad():
        for own, value in HELLY.items():
            getattr(system.terms[0], own).fill_(value)
    return system


def wrong_starts(sequences: list[Sequence]) -> Batch:
    """True paths, whose first speeds are off by 1 m/s to and fro."""
    batch = collate(sequences)
    batch.v[0, ::2, 0] += 1.0
    batch.v[0, 1::2, 0] -= 1.0
    return batch


def test_wrong_first_speeds_are_found_beside_the_parameters() -> None:
    sequences = driven()
    batch = wrong_starts(sequences)
    given = TangentCost(known(), batch, FusedSolver(), Convention.spacing)
    fitted = StartSpeedCost(known(), batch, FusedSolver(), Convention.spacing)
    row = np.array(list(HELLY.values()))
    assert pooled(given, row * 1.2).cost > 0.1
    found = pooled(fitted, row * 1.2)
    assert found.cost < 1e-3
    np.testing.assert_allclose(found.row, row, rtol=1e-3)
    starts = fitted.starts(found.row)
    for s in sequences:
        np.testing.assert_allclose(starts[s.name], s.velocity()[0, :, 0], atol=1e-3)
    assert float(batch.v[0, 0, 0]) == pytest.approx(10.0)  # what was given is not changed


@pytest.mark.parametrize("name", ["helly", "helly + memory"])
@pytest.mark.parametrize("kind", [Convention.integral, Convention.spacing, Convention.log_gap])
def test_the_gradient_is_that_of_the_least_cost(name: str, kind: Convention) -> None:
    cost = StartSpeedCost(known(name), wrong_starts(driven()), FusedSolver(), kind)
    row = cost.row(cost.system) * 1.1
    curved = cost(row)
    for i, value in enumerate(row):
        h = 1e-5 * value
        up, down = (cost.costs(row + s * h * np.eye(len(row))[i]) for s in (1, -1))
        wanted = (up - down) / (2 * h)
        np.testing.assert_allclose(curved.gradient[:, i], wanted, rtol=2e-3, atol=1e-5)


def test_every_follower_of_a_platoon_has_its_own() -> None:
    time = 0.1 * np.arange(80)
    lead = 12 * time + np.sin(time)
    x = np.stack([lead - 45, lead - 20, lead], 1)[..., None]
    v = np.stack([12 + np.cos(time)] * 3, 1)[..., None]
    one = Sequence(name="a", recording="a", time=time, x=x, v=v)
    with torch.no_grad():
        run = FusedSolver()(known(), collate([one]))
    batch = collate([one])
    batch.x = run.x
    batch.v[0, 0, :2, 0] += torch.tensor([0.7, -0.4])
    cost = StartSpeedCost(known(), batch, FusedSolver(), Convention.gap)
    row = cost.row(cost.system)
    assert TangentCost(known(), batch, FusedSolver(), Convention.gap).costs(row)[0] > 1e-2
    np.testing.assert_allclose(cost.starts(row)["a"], [13.0, 13.0, 13.0], atol=1e-4)
    assert cost.costs(row)[0] < 1e-8


def test_it_is_said_and_refused_where_there_is_no_speed() -> None:
    table = pairs(number=4, seconds=12.0)
    table.loc[table.time == 0, "v_follower"] += 0.8
    own = {"method": "ballistic", "cost": "gap"}  # that the pairs are made with
    found = nnode.Calibrator("idm", start_speeds="fitted", **own).fit(table)
    assert found.result_.start_speeds["kind"] == "fitted"
    assert found.result_.start_speeds["change"] == pytest.approx(0.8, rel=1e-3)
    assert found.cost_ < 1e-6
    assert "first speeds of training sequences are fitted" in found.result_.summary()
    given = nnode.Calibrator("idm", **own).fit(table).result_
    assert given.start_speeds == {"kind": "measured"}
    assert given.cost > 1e-3
    with pytest.raises(ConfigError, match="needs optimizer=gauss_newton"):
        nnode.Calibrator("idm", optimizer="lbfgs", start_speeds="fitted").fit(table)
    with pytest.raises(ConfigError, match="second order"):
        nnode.Calibrator("lin", optimizer="gauss_newton", start_speeds="fitted").fit(table)


def test_parabolas_tell_first_speeds() -> None:
    rng = np.random.default_rng(3)
    time = 5.0 + 0.1 * np.arange(60)
    t = time - 5.0
    x = np.stack([3 + 8 * t - 0.5 * t**2, 30 + 10 * t], 1)[..., None]
    exact = start_smoothed(Sequence(name="a", recording="a", time=time, x=x))
    np.testing.assert_allclose(exact.velocity()[0, :, 0], [8.0, 10.0], rtol=1e-9)
    np.testing.assert_allclose(exact.velocity()[1:-1], np.diff(x, axis=0)[1:] / 0.1)
    assert (exact.x == x).all()
    away = []
    for _ in range(300):
        noisy = Sequence(name="a", recording="a", time=time, x=x + 0.3 * rng.normal(size=x.shape))
        away.append(start_smoothed(noisy).velocity()[0, :, 0] - [8.0, 10.0])
    # 0.3 m at every 0.1 s over 2 s: 0.43 m/s, where a difference of two samples has 4.2 m/s
    assert np.std(away) == pytest.approx(0.43, rel=0.15)
    short = Sequence(name="a", recording="a", time=time[:3], x=x[:3])
    assert start_smoothed(short) is short
    found = nnode.sequences(pairs(number=2, seconds=5.0), data="pairs", start_speeds="smoothed")
    assert found.manifest["options"]["start_speeds"] == "smoothed"
