"""A new law is one YAML file, and a new effect is one class with one rule: with nothing else
written, both work in every engine, in training, in the diagnosis, on its page and in a drive."""

from __future__ import annotations

import html
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
import yaml

import nnode
from nnode.data.sequence import collate
from nnode.discover.options import DiscoverOptions
from nnode.exchange.drivers import Drivers, Seen
from nnode.model import System, build_model
from nnode.model.effects import CATALOGUE
from nnode.model.effects.own import load_own
from nnode.simulation import FusedSolver, TorchdiffeqSolver
from tests.app.conftest import Script
from tests.discover.platoons import platoons
from tests.model.test_forces import people

LANE = """
defaults: [formula_schema, _self_]
name: saturating
leader: measured
law:
  parameters: {v0: {value: 25 m/s, low: 1 m/s}, reach: {value: 15 m, low: 1 m}}
  rate: {x: v0*(1 - exp(-gap/reach))}
"""
CROWD = """
defaults: [formula_schema, _self_]
name: polite
law:
  parameters: {A: 2 m/s², B: 40 cm, tau: 0.7 s}
  where: {push: A*exp((2*r - d)/B)}
  others: {push_x: push*n_x, push_y: push*n_y}
  rate: {vx: (speed*way_x - vx)/tau + push_x, vy: (speed*way_y - vy)/tau + push_y}
"""
EFFECTS = """
from nnode.model.effects import CATALOGUE, Effect, Strength
from nnode.model.term import Interval
from nnode.model.terms import Rule


@CATALOGUE.add
class Hills(Effect):
    name, domain, source, rank = "hills", "traffic", "none", 20
    rules = {1: Rule(rate="W + w*sin(x/long)", constants={"long": (60.0, "m")})}
    strengths = {"w": Strength(0.0, 0.2, Interval(-6.0, 6.0), "m/s", min_effect_size=1.0)}


@CATALOGUE.add
class Current(Effect):
    name, domain, source, rank = "current", "crowd", "none", 20
    rules = {2: Rule(rate=("c*vy", "-c*vx"))}
    strengths = {"c": Strength(0.0, 0.05, Interval(-2.0, 2.0), "1/s", min_effect_size=0.2)}
"""
NAMES = ("hills", "current")
#: What the made-up drivers do.
V0, REACH, W = 27.0, 14.0, 2.5


def speeds(x: np.ndarray) -> np.ndarray:
    """Of followers, m/s, by law and effect; ``x`` with the leader's place behind."""
    law: np.ndarray = V0 * (1 - np.exp(-np.diff(x) / REACH))
    return law + W * np.sin(x[:-1] / 60)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with both laws, the effects, and a table of platoons; the effects are known."""
    folder = tmp_path_factory.mktemp("own")
    (folder / "conf" / "model").mkdir(parents=True)
    for name, text in (("saturating", LANE), ("polite", CROWD)):
        (folder / "conf" / "model" / f"{name}.yaml").write_text(text)
    (folder / "effects.py").write_text(EFFECTS)
    found = platoons(lambda x, *_: speeds(x), number=20, seconds=25.0, seed=4)
    frames = [
        pd.DataFrame(
            {
                "sequence": i,
                "time": np.repeat(one.time, 5),
                "agent": np.tile(np.arange(5) + 5 * i, len(one.time)),
                "x": one.x.ravel(),
            }
        )
        for i, one in enumerate(found)
    ]
    pd.concat(frames).to_csv(folder / "table.csv", index=False)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NNODE_EFFECTS", str(folder / "effects.py"))
        load_own()
        yield folder
    for name in NAMES:
        del CATALOGUE.effects[name]


def options(text: str, *effects: dict[str, Any]) -> dict[str, Any]:
    """Of the model that a file describes."""
    found = yaml.safe_load(text)
    del found["defaults"]
    return {"term": "formula", "leader": "measured", **found, "effects": list(effects)}


@pytest.mark.usefixtures("written")
@pytest.mark.parametrize("text", [LANE, CROWD], ids=["lane", "crowd"])
@pytest.mark.parametrize("own", [False, True], ids=["law", "effect"])
def test_compiled_code_is_pytorch(text: str, own: bool) -> None:
    lane = text == LANE
    effect = {"name": "hills", "w": 1.5} if lane else {"name": "current", "c": 0.3}
    model = build_model(options(text, *[effect] * own)).double()
    batch = collate(platoons(number=2, seconds=1.0) if lane else [people(5, 1), people(3, 2)])
    found = []
    for solver in (TorchdiffeqSolver("euler", "discrete", 0.02), FusedSolver(0.02, method="euler")):
        x = solver(model, batch).x[batch.valid]
        slopes = torch.autograd.grad(x.square().sum(), list(model.parameters()))
        found.append((x.detach(), torch.stack(slopes)))
        assert not getattr(solver, "uncompiled", "")
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(other, one, rtol=1e-9, atol=1e-9)
    assert (found[0][1] != 0).all()


def test_a_calibration_by_tangents_recovers_the_truth(written: Path) -> None:
    model = {k: v for k, v in options(LANE).items() if k not in ("effects", "leader")}
    run = nnode.Calibrator(model, effects=["hills"], leader="measured", optimizer="gauss_newton")
    run.fit(written / "table.csv")
    estimate = run.parameters_["estimate"]
    truth = {"saturating.v0": V0, "saturating.reach": REACH, "hills.w": W}
    for name, value in truth.items():
        assert estimate[name] == pytest.approx(value, rel=0.02), name


def test_it_is_trained_by_the_command(written: Path, script: Script, tmp_path: Path) -> None:
    done = script(
        "train", "--config-dir", str(written / "conf"), "model=saturating", "data=table",
        "data.domain=traffic", f"data.path={written / 'table.csv'}", "solver=fused",
        "optimizer=lbfgs", "model.effects=[{name: hills, w: 0.1}]", "trainer.max_epochs=4",
        f"hydra.run.dir={tmp_path}", NNODE_EFFECTS=str(written / "effects.py"),
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    result = json.loads((tmp_path / "result.json").read_text())
    assert result["solver"] == {"name": "fused", "uncompiled": None}
    assert {"saturating.v0", "saturating.reach", "hills.w"} <= set(result["summary"])
    again = nnode.load(tmp_path / "checkpoints" / "best.pt")
    assert set(again.physical()) == {"saturating.v0", "saturating.reach", "hills.w"}


def test_it_is_found_and_shown(written: Path, tmp_path: Path) -> None:
    model = {k: v for k, v in options(LANE).items() if k not in ("effects", "leader")}
    chosen = DiscoverOptions(compare=[], structure=False, replay=False)
    found = nnode.diagnose(
        written / "table.csv", "traffic", model=model, folder=tmp_path, options=chosen
    )
    assert (found.verdict, [effect.name for effect in found.effects]) == ("named", ["hills"])
    coefficient = found.effects[0].coefficients["w"]
    assert coefficient.low < W < coefficient.high
    page = html.unescape((tmp_path / "report.html").read_text())
    assert "hills" in page
    assert "sin" in found.effects[0].formula
    assert found.effects[0].formula in page


@pytest.mark.usefixtures("written")
def test_it_drives() -> None:
    """What SUMO's vehicles are given in a step, without SUMO."""
    model: System = build_model(options(LANE, {"name": "hills", "w": W})).double()
    with torch.no_grad():
        for name, value in (("v0", V0), ("reach", REACH)):
            getattr(model.terms[0], name).fill_(value)
    drivers = Drivers(model, 0.1, "euler")
    drivers.enter([(), ()])
    x, gap, nobody = np.array([35.0, 80.0]), np.array([20.0, 30.0]), np.full(2, np.inf)
    seen = Seen(
        v=np.full(2, 9.0), gap=gap, v_1=np.full(2, 9.0), length_1=np.full(2, 5.0),
        lead=np.full(2, -1), gap_1=nobody, v_2=np.full(2, 9.0), x=x,
    )  # fmt: skip
    wanted = V0 * (1 - np.exp(-gap / REACH)) + W * np.sin(x / 60)
    np.testing.assert_allclose(drivers.speeds(0.0, seen), wanted, rtol=1e-6)
